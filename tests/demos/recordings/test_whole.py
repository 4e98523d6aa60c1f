"""A disk that fills up while HDF5 is written: an error, no crash when the file is freed, nothing left."""

import errno
import os
import resource
from contextlib import contextmanager

import h5py
import numpy as np
import pytest

from robocas_ms3.core.files import replacing
from robocas_ms3.demos.recordings.stored import reserved, write_whole

DATA = np.arange(50_000, dtype=np.float64)


@contextmanager
def files_of_at_most(size):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def fill(file):
    file.create_group("a", track_order=True).create_dataset("b", data=DATA)


@pytest.mark.parametrize("size", [1, 10_000_000])
def test_what_was_reserved_and_not_needed_is_given_back(tmp_path, size):
    with reserved(tmp_path / "x.h5", size) as file:
        fill(file)
    with h5py.File(tmp_path / "x.h5") as file:
        np.testing.assert_array_equal(file["a/b"], DATA)
    assert os.path.getsize(tmp_path / "x.h5") < DATA.nbytes + 10_000


def test_no_room_is_an_error_before_anything_is_lost(tmp_path):
    with files_of_at_most(100_000):
        with pytest.raises(OSError, match="x.h5") as error, replacing(tmp_path / "x.h5") as tmp:
            write_whole(tmp, fill)
        assert error.value.errno == errno.EFBIG
        with pytest.raises(OSError, match="y.h5"), replacing(tmp_path / "y.h5") as tmp, reserved(tmp, 500_000):
            raise AssertionError("it was opened")
    assert list(tmp_path.iterdir()) == []


def test_a_file_system_that_reserves_nothing(tmp_path, monkeypatch):
    def none(*_):
        raise OSError(errno.EOPNOTSUPP, "Operation not supported")

    monkeypatch.setattr("os.posix_fallocate", none)
    with reserved(tmp_path / "x.h5", 10) as file:
        fill(file)
    with h5py.File(tmp_path / "x.h5") as file:
        np.testing.assert_array_equal(file["a/b"], DATA)
