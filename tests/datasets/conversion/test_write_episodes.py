"""Writing of episodes in this process or in workers, with failures."""

import errno
import os
from dataclasses import dataclass, field, replace
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from synthetic import RayCaster, write_trajectory

from robocas_ms3.core.errors import DatasetError, MissingExtraError
from robocas_ms3.datasets.conversion.settings import ConversionSettings, WrittenEpisode
from robocas_ms3.datasets.conversion.workers import PendingEpisodes, write_episodes


@dataclass
class Writer:
    """Writes nothing, and returns the state of its process."""

    errors: dict[int, Exception] = field(default_factory=dict)

    def write(self, number, conversion_input, source):
        if number in self.errors:
            raise self.errors[number]
        about = os.getpid(), torch.get_num_threads(), os.environ.get("LP_NUM_THREADS")
        return WrittenEpisode(number, source, 0, about)


class Deadly(Writer):
    def write(self, number, conversion_input, source):
        return os._exit(9) if number == 2 else super().write(number, conversion_input, source)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return write_trajectory(tmp_path_factory.mktemp("recorded") / "F.h5", seeds=(1,))


@pytest.fixture
def job(file, tmp_path):
    def make(writer, numbers, continued=False, **settings):
        settings = ConversionSettings(file, tmp_path / "out", open_renderer=RayCaster, **settings)
        return PendingEpisodes(settings, writer, [(number, number + 10) for number in numbers], continued, "Repair it.")

    return make


@pytest.fixture(autouse=True)
def two_threads(monkeypatch):
    monkeypatch.delenv("LP_NUM_THREADS", raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "2")  # of torch where it is new
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def odd(numbers):
    """Every odd number fails."""
    return {
        n: LookupError(f"{n} is odd") if n % 3 else DatasetError(f"{n} is odd", fix="Don't.") for n in numbers if n % 2
    }


def write(job):
    """Return the written episodes by number, and the error that names the others."""
    return write_episodes(job, SimpleNamespace(check_exists=lambda: None), None)


def test_torch_has_one_thread_during_rendering(job):
    written, incomplete = write(job(Writer(), [1, 2]))
    assert incomplete is None
    found = [(one.number, one.steps, one.row) for one in written]
    assert found == [(1, 11, (os.getpid(), 1, None)), (2, 12, (os.getpid(), 1, None))]
    assert torch.get_num_threads() == 2
    with pytest.raises(ValueError, match="7"):
        write(job(Writer({7: ValueError(7)}), [7]))
    assert torch.get_num_threads() == 2


def test_torch_keeps_its_threads_without_rendering(job, made):
    writing = job(Writer(), [1])
    writing = replace(writing, settings=ConversionSettings(made, writing.settings.out))
    assert [one.row for one in write(writing)[0]] == [(os.getpid(), 2, None)]


def test_failures_and_crashes_in_workers_are_one_error_at_the_end(job):
    writer = Deadly({5: LookupError("5 is odd")})
    written, incomplete = write(job(writer, [1, 2, 3, 4, 5], jobs=2, episode_seconds=60, memory_gb=8))
    assert [one.number for one in written] == [1, 3, 4]
    assert incomplete.reasons == {
        "episode_0000002": "episode_0000002: its worker process crashed twice: exit status 9",
        "episode_0000005": "LookupError: 5 is odd",
    }
    assert os.getpid() not in {one.row[0] for one in written}
    assert {one.row[1:] for one in written} == {(1, "1")}


def test_failed_episode_does_not_stop_others(job):
    written, incomplete = write(job(Writer(odd(range(16))), range(16)))
    assert [one.number for one in written] == list(range(0, 16, 2))
    reasons = {n: f"{n} is odd. Don't" if n % 3 == 0 else f"LookupError: {n} is odd" for n in range(1, 16, 2)}
    assert incomplete.reasons == {f"episode_{n:07d}": why for n, why in reasons.items()}
    listed = "; ".join(f"episode_{n:07d}: {why}" for n, why in list(reasons.items())[:5])
    assert incomplete.found == f"{listed}; and 3 more"


@pytest.mark.parametrize(("numbers", "tried"), [([1], 1), ([1, 3], 2), ([1, 3, 5, 2], 3)])
def test_error_of_the_first_episodes_is_raised(job, numbers, tried):
    attempts = []

    class Counting(Writer):
        def write(self, number, conversion_input, source):
            attempts.append(number)
            return super().write(number, conversion_input, source)

    make = partial(job, Counting(odd(numbers)), numbers)
    with pytest.raises(LookupError, match="1 is odd"):
        write(make())
    assert len(attempts) == tried
    assert write(make(continued=True))[1]  # others are there already, so not all share it
    assert len(attempts) == tried + len(numbers)


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "full"), FileNotFoundError(errno.ENOENT, "gone"), MissingExtraError("no extra")]
)
def test_system_error_is_raised_at_once(job, error):
    with pytest.raises(type(error)):
        write(job(Writer({2: error}), [1, 2, 3]))
