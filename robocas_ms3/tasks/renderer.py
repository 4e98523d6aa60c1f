"""One render system that stays in a process that renders in software."""

from __future__ import annotations

import atexit

import sapien
from mani_skill.render.utils import can_render

_kept: list[sapien.render.RenderSystem] = []


def keep_renderer(device: sapien.Device | None) -> None:
    """Keep SAPIEN's tables, shaders and meshes from one scene to the next, until the process ends.

    With its last render system SAPIEN forgets them all, and makes them anew for the next: 6 s of CPU time for the first
    picture of an environment that is made after another was closed, 0.1 s for each scene that is built anew.

    Args:
        device: that is rendered on, if any; nothing is kept on a GPU, whose memory is others' too.
    """
    if device is not None and device.is_cpu() and can_render(device) and not _kept:
        _kept.append(sapien.render.RenderSystem(device))
        atexit.register(_kept.clear)  # before the library is unloaded
