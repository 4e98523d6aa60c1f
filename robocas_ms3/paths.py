"""Where things lie: shipped data, the user's data, caches."""

from __future__ import annotations

import logging
import os
import tempfile
from functools import lru_cache
from pathlib import Path

import platformdirs

PACKAGE_DIR = Path(__file__).resolve().parent
CACHE, DATA = "ROBOCAS_CACHE", "ROBOCAS_DATA"  # environment variables that choose folders
_log = logging.getLogger(__name__)


def data_dir() -> Path:
    """Asset packs the user made: ``$ROBOCAS_DATA``, by default the user's data folder."""
    return Path(os.environ.get(DATA) or platformdirs.user_data_dir("robocas"))


def cache_dir() -> Path:
    """Files that can be made again at any time: ``$ROBOCAS_CACHE``, by default the user's cache folder.

    Where nobody chose one and the user's can't be written to, it is a private one among the temporary files.
    """
    chosen = os.environ.get(CACHE)
    return Path(chosen) if chosen else _cache_of_user(Path(platformdirs.user_cache_dir("robocas")))


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
    """Environment variable that chooses where a path is: of the cache, or of the user's data; empty if none does."""
    path = Path(path).absolute()
    folders = ((CACHE, cache_dir()), (DATA, data_dir()))
    return next((name for name, folder in folders if path.is_relative_to(folder.absolute())), "")


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
