"""Files on which a plain read never ends, or takes all memory."""

import os
from pathlib import Path

KINDS = ("pipe", "device", "huge")


def replace_file(path: Path, kind: str) -> Path:
    """Put a named pipe, a link to an endless device, or a sparse file of 1 TB in place of a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        with path.open("wb") as file:
            file.truncate(2**40)
    return path
