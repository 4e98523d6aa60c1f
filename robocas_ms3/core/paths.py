"""Where things lie: shipped data, the user's data, caches."""

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
CACHE, DATA = "ROBOCAS_CACHE", "ROBOCAS_DATA"  # environment variables that choose folders
_log = logging.getLogger(__name__)


def data_dir() -> Path:
    """Return the folder of asset packs the user made: ``$ROBOCAS_DATA``, by default the user's data folder.

    Raises:
        RobocasError: the variable is not set, and the user has no home folder.
    """
    return Path(os.environ.get(DATA) or _of_user(platformdirs.user_data_path))


def cache_dir() -> Path:
    """Return the folder of files that can be made again: ``$ROBOCAS_CACHE``, by default the user's cache folder.

    Where nobody chose one and the user's can't be written to, it is a private one among the temporary files.

    Raises:
        RobocasError: the variable is not set, and the user has no home folder.
    """
    chosen = os.environ.get(CACHE)
    return Path(chosen) if chosen else _cache_of_user(_of_user(platformdirs.user_cache_path))


def _of_user(find: Callable[[str], Path]) -> Path:
    folder = Path()
    with suppress(RuntimeError):  # without a home folder some versions raise, others return "~/.cache/robocas"
        folder = find("robocas")
    if not folder.is_absolute():
        found, fix = os.environ.get("HOME") or "nothing", f"Set {CACHE} and {DATA} to folders that can be written to."
        raise RobocasError("the user has no home folder", where="HOME", expected="a path", found=found, fix=fix)
    return folder


def ensure_home() -> None:
    """Set ``HOME`` to an absolute path, which libraries need: the user's home folder, or one in the cache.

    Raises:
        RobocasError: the user has no home folder, and the variables do not choose both cache and data.
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
def _cache_of_user(usual: Path) -> Path:
    if is_writable(usual) or (instead := temporary_cache()) is None:
        return usual
    _log.warning("%s can't be written to: %s is the cache instead; set %s to choose one", usual, instead, CACHE)
    return instead


def temporary_cache() -> Path | None:
    """A cache among the temporary files that is this user's alone; none if somebody else has put something there."""
    folder = Path(tempfile.gettempdir()) / f"robocas-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        about = folder.lstat()
    except OSError:
        return None
    private = about.st_uid == os.getuid() and not about.st_mode & 0o077
    return folder if private and folder.is_dir() and not folder.is_symlink() else None


def is_writable(folder: Path) -> bool:
    """Whether a folder can be written to, or be made. Makes none."""
    there = next(parent for parent in (folder, *folder.parents) if os.path.lexists(parent))
    return there.is_dir() and os.access(there, os.W_OK | os.X_OK)


def variable_of(path: Path | str) -> str:
    """Return the environment variable that chooses where a path is, of cache or user's data; empty if none does."""
    path = Path(path).absolute()
    for name, folder_of in ((CACHE, cache_dir), (DATA, data_dir)):
        with suppress(RobocasError):  # no home folder
            if path.is_relative_to(folder_of().absolute()):
                return name
    return ""


def task_configs_dir() -> Path:
    """The shipped task configurations: in the wheel inside the package, in a checkout at its top level."""
    shipped = PACKAGE_DIR / "data" / "task_configs"
    return shipped if shipped.is_dir() else PACKAGE_DIR.parent / "task_configs"


def builtin_packs_dir() -> Path:
    """The asset packs that travel with the package."""
    return PACKAGE_DIR / "data" / "packs"


def protocols_dir() -> Path:
    """The evaluation protocols that travel with the package."""
    return PACKAGE_DIR / "data" / "protocols"


def plans_dir() -> Path:
    """The plans that travel with the package."""
    return PACKAGE_DIR / "data" / "plans"
