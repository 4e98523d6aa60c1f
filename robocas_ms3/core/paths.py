"""Paths of bundled data, of the user's data folder and of the cache.

The functions raise RobocasError if the user has no home folder and the environment variable of the folder is not set.
"""

from __future__ import annotations

import logging
import os
import pwd
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import platformdirs

from robocas_ms3.core.errors import RobocasError

PACKAGE_DIR = Path(__file__).resolve().parents[1]
CACHE, DATA = "ROBOCAS_CACHE", "ROBOCAS_DATA"  # environment variables with the paths of the folders
_log = logging.getLogger(__name__)


def data_dir() -> Path:
    """Return the folder of the user's asset packs: ``$ROBOCAS_DATA``, by default the user's data folder."""
    return Path(os.environ.get(DATA) or _find_user_folder(platformdirs.user_data_path))


def cache_dir() -> Path:
    """Return the cache folder: ``$ROBOCAS_CACHE``, by default the user's cache folder.

    If the variable is not set and the user's folder is not writable, it is a private folder in the temporary directory.
    """
    chosen = os.environ.get(CACHE)
    return Path(chosen) if chosen else _choose_cache(_find_user_folder(platformdirs.user_cache_path))


def _find_user_folder(find: Callable[[str], Path]) -> Path:
    folder = Path()
    with suppress(RuntimeError):  # without a home folder some versions raise, others return "~/.cache/robocas"
        folder = find("robocas")
    if not folder.is_absolute():
        found, fix = os.environ.get("HOME") or "nothing", f"Set {CACHE} and {DATA} to writable folders."
        raise RobocasError("the user has no home folder", where="HOME", expected="a path", found=found, fix=fix)
    return folder


def ensure_home() -> None:
    """Set ``HOME``, which libraries need, if it is not an absolute path.

    The value is the user's home folder, or a folder in the cache if the user has none.
    """
    home = os.environ.get("HOME", "")
    if not os.path.isabs(home):
        with suppress(KeyError):  # a user id without an entry, as in many containers
            home = pwd.getpwuid(os.getuid()).pw_dir
    if not os.path.isabs(home):
        data_dir()
        home = str(cache_dir().absolute() / "home")
    os.environ["HOME"] = home


@lru_cache(maxsize=8)
def _choose_cache(usual: Path) -> Path:
    if is_writable(usual) or (instead := make_temporary_cache()) is None:
        return usual
    _log.warning(
        "the cache folder %s is not writable; %s is used instead. Set %s to choose a folder.", usual, instead, CACHE
    )
    return instead


def make_temporary_cache() -> Path | None:
    """Create a private cache folder in the temporary directory.

    Returns:
        The folder, or None if it cannot be created or is not private to this user.
    """
    folder = Path(tempfile.gettempdir()) / f"robocas-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError:
        return None
    private = status.st_uid == os.getuid() and not status.st_mode & 0o077
    return folder if private and folder.is_dir() and not folder.is_symlink() else None


def is_writable(folder: Path) -> bool:
    """Return whether files can be created in a folder; a folder that does not exist must be creatable."""
    existing = next(parent for parent in (folder, *folder.parents) if os.path.lexists(parent))
    return existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)


def find_path_variable(path: Path | str) -> str:
    """Return the environment variable that sets the cache or data folder which contains a path; empty if none does."""
    path = Path(path).absolute()
    for name, folder_of in ((CACHE, cache_dir), (DATA, data_dir)):
        with suppress(RobocasError):  # no home folder
            if path.is_relative_to(folder_of().absolute()):
                return name
    return ""


def task_configs_dir() -> Path:
    """Return the folder of bundled task configurations: in the package if installed, in the root of a checkout."""
    bundled = PACKAGE_DIR / "data" / "task_configs"
    return bundled if bundled.is_dir() else PACKAGE_DIR.parent / "task_configs"


def builtin_packs_dir() -> Path:
    """Return the folder of the bundled asset packs."""
    return PACKAGE_DIR / "data" / "packs"


def protocols_dir() -> Path:
    """Return the folder of the bundled protocols."""
    return PACKAGE_DIR / "data" / "protocols"


def published_results_file() -> Path:
    """Return the path of the bundled leaderboard with results of the RoboCAS paper."""
    return PACKAGE_DIR / "data" / "published_results.json"


def plans_dir() -> Path:
    """Return the folder of the bundled plans."""
    return PACKAGE_DIR / "data" / "plans"
