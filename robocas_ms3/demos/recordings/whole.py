"""HDF5 files that a full disk does no harm: HDF5 itself ends the process where it can't write what it holds."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py


def write_whole(path: Path, fill: Callable[[h5py.File], None]) -> None:
    """Make a file in memory and write it at once.

    Raises:
        OSError: it can't be written.
    """
    with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
        fill(file)
        file.flush()
        image = file.id.get_file_image()
    path.write_bytes(image)


@contextmanager
def reserved(path: Path, size: int) -> Iterator[h5py.File]:
    """Open a new file of which so many bytes have their place on the disk; what is not needed is given back.

    Raises:
        OSError: there is no room for them.
    """
    write_whole(path, lambda file: None)
    with path.open("r+b") as file:
        try:
            os.posix_fallocate(file.fileno(), 0, max(size, 1))
        except OSError as error:
            if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):  # a file system that reserves nothing
                raise
    with h5py.File(path, "r+") as file:
        yield file
