"""Where things lie: shipped data, the user's data, caches."""

from __future__ import annotations

import os
from pathlib import Path

import platformdirs

PACKAGE_DIR = Path(__file__).resolve().parent


def data_dir() -> Path:
    """Asset packs the user made: ``$ROBOCAS_DATA``, by default the user's data folder."""
    return Path(os.environ.get("ROBOCAS_DATA") or platformdirs.user_data_dir("robocas"))


def cache_dir() -> Path:
    """Files that can be made again at any time: ``$ROBOCAS_CACHE``, by default the user's cache folder."""
    return Path(os.environ.get("ROBOCAS_CACHE") or platformdirs.user_cache_dir("robocas"))


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
