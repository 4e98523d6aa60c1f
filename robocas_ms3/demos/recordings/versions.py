"""What an episode depends on besides its seed."""

from __future__ import annotations

from functools import cache
from importlib.metadata import version


@cache  # it reads the packages' descriptions
def versions() -> dict[str, str]:
    """Versions an episode depends on."""
    return {name: version(name) for name in ("robocas-ms3", "mani_skill", "sapien", "python-fcl", "torch", "numpy")}
