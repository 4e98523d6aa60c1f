"""Small trials of things that may crash the process that tries them; run as a file, in a process of its own.

``python probes.py NAME`` prints one line that names what works, and exits with 0; otherwise the last line on stderr
says why not. As a file it needs nothing of this package, so it also answers where the package can't be imported.
"""

from __future__ import annotations

import sys


def render() -> str:
    """Open the render device that SAPIEN would take: its name."""
    from sapien import render as sapien_render

    return sapien_render.RenderSystem().device.name


PROBES = {"render": render}


if __name__ == "__main__":
    try:
        found = PROBES[sys.argv[1]]()
    except Exception as error:  # whatever the trial meets is its answer
        sys.exit(f"{type(error).__name__}: {error}")
    print(found)
