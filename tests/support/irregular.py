"""Files whose plain read never ends, or takes all memory."""

import os
from pathlib import Path

KINDS = ("pipe", "device", "huge")


def replace_file(path: Path, kind: str) -> Path:
    """Put a named pipe, a link to an endless device or to itself, a folder, or a sparse file of 1 TB in its place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path)
    else:
        with path.open("wb") as file:
            file.truncate(2**40)
    return path
