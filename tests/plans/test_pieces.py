"""Files of a unit arrive whole, however they are cut, and whenever it ends."""

import ctypes
import errno

import pytest
from plan_stages import PLAN

from robocas_ms3.core.files import flush_to_disk
from robocas_ms3.core.ledger import Ledger
from robocas_ms3.plans.engines.pieces import Arriving, sent
from robocas_ms3.plans.slot import Slot
from robocas_ms3.plans.units import DEATHS, DONE, LEDGER, Outcome, Unit, outcomes

FILES = {
    "seed_0000000007.h5": b"0123456789",
    "seed_0000000007.json": b"{}",
    "episodes/0000000007/episode_000000/empty": b"",
    "episodes/0000000007/episode_000000/rgb/0.png": b"abcdef" * 9,
    DEATHS: b"one\n",
}


@pytest.fixture
def here(tmp_path):
    for name, content in FILES.items():
        path = tmp_path / "here" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    (tmp_path / "here" / LEDGER).write_text("of this machine")
    return tmp_path / "here"


def contents(folder):
    return {f"{path.relative_to(folder)}": path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("piece", [1, 5, 10, 12, 1000])
def test_files_arrive_as_they_were_and_no_piece_is_larger_than_allowed(here, tmp_path, piece):
    arriving = Arriving(tmp_path / "there")
    for pieces in sent(here, piece):
        assert sum(len(data) for _, data in pieces) <= piece
        arriving.take(pieces)
        assert not outcomes(tmp_path / "there")
        assert not (tmp_path / "there" / "seed_0000000007.h5").exists()
    arriving.keep(Outcome(7, True))
    found = contents(tmp_path / "there")
    assert list(outcomes(tmp_path / "there")) == [7]
    assert {name: content for name, content in found.items() if name != LEDGER} == FILES
    assert set(contents(here)) == {LEDGER, DEATHS}  # the disk there is free again


def test_what_belongs_to_no_seed_arrives_too(here, tmp_path):
    arriving = Arriving(tmp_path / "there")
    for pieces in sent(here):
        arriving.take(pieces)
    arriving.keep(Outcome(7, True))
    (here / DONE).write_text("{}")
    (here / DEATHS).write_text("one\ntwo\n")
    for pieces in sent(here):
        arriving.take(pieces)
    arriving.keep()
    assert (tmp_path / "there" / DONE).read_text() == "{}"
    assert (tmp_path / "there" / DEATHS).read_text() == "one\ntwo\n"


def test_what_came_in_half_is_forgotten_and_what_was_moved_is_replaced(here, tmp_path):
    first = Arriving(tmp_path / "there")
    first.take([("seed_0000000007.h5", b"01"), ("episodes/0000000007/episode_000000/rgb/9.png", b"old")])
    for path in (tmp_path / "there" / ".arriving.tmp" / "episodes").iterdir():
        path.rename(tmp_path / "there" / "episodes" / path.name)  # killed here
    second = Arriving(tmp_path / "there")
    for pieces in sent(here):
        second.take(pieces)
    second.keep(Outcome(7, True))
    found = contents(tmp_path / "there")
    assert {name: content for name, content in found.items() if name != LEDGER} == FILES


@pytest.mark.parametrize("success", [True, False])
def test_files_are_on_the_disk_before_a_line_names_them(here, tmp_path, monkeypatch, success):
    said = []
    whole = Ledger.append
    monkeypatch.setattr("robocas_ms3.plans.engines.pieces.flush_to_disk", lambda folder: said.append(contents(folder)))
    monkeypatch.setattr(Ledger, "append", lambda *a, **k: (said.append(k["sync"]), whole(*a, **k)))
    arriving = Arriving(tmp_path / "there")
    for pieces in sent(here):
        arriving.take(pieces)
    arriving.keep(Outcome(7, success))
    assert said == ([FILES, True] if success else [True])


def test_a_slot_does_so_too(tmp_path, monkeypatch):
    said = []
    monkeypatch.setattr("robocas_ms3.plans.slot.check_versions", lambda out: None)
    monkeypatch.setattr("robocas_ms3.plans.slot.flush_to_disk", lambda folder: said.append(len(outcomes(folder))))
    slot = Slot(PLAN, tmp_path)
    monkeypatch.setattr(slot, "_seed", lambda task: Outcome(task.seed, task.seed != 11))
    assert [outcome.seed for outcome in slot.do(Unit(0, 0))] == [10, 11, 12]
    assert said == [0, 2]  # before the lines of 10 and 12


def test_a_flush_says_which_folder_it_could_not_write(tmp_path, monkeypatch):
    flush_to_disk(tmp_path)
    with pytest.raises(FileNotFoundError):
        flush_to_disk(tmp_path / "gone")

    class Full:
        @staticmethod
        def syncfs(descriptor):
            ctypes.set_errno(errno.EDQUOT)
            return -1

    monkeypatch.setattr("ctypes.CDLL", lambda *_, **__: Full)
    with pytest.raises(OSError, match="quota") as error:
        flush_to_disk(tmp_path)
    assert error.value.filename == str(tmp_path)
