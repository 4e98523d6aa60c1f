"""Claims keep a second process out for as long as the first may live, and no longer."""

import errno
import json
import os
import subprocess
import sys
import threading
import time
from contextlib import ExitStack

import pytest

from robocas_ms3.core.errors import PlanError
from robocas_ms3.plans.claims import LEASE as DEFAULT_LEASE
from robocas_ms3.plans.claims import claimed, claims_of, lease_of, refuse_claimed
from robocas_ms3.plans.driver import sole
from robocas_ms3.plans.engines import open_engine
from robocas_ms3.plans.units import CLAIMS

LEASE = 2.0
HOLD = """
import json, sys, time
from pathlib import Path
from robocas_ms3.plans.claims import claimed
path, notes, lease, seconds = Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]), float(sys.argv[4])
with claimed(path, lease):
    with notes.open("a") as file:
        file.write(json.dumps(["in", time.time()]) + "\\n")
    time.sleep(seconds)
    with notes.open("a") as file:
        file.write(json.dumps(["out", time.time()]) + "\\n")
"""
SLOW = """
import os, time
utime = os.utime
def slow(*more):
    time.sleep(0.05)
    utime(*more)
os.utime = slow
"""


def holding(path, notes, seconds, lease=LEASE, before=""):
    """Another process that holds a claim for some seconds."""
    command = [sys.executable, "-c", before + HOLD, path, notes, str(lease), str(seconds)]
    return subprocess.Popen([str(word) for word in command], stderr=subprocess.DEVNULL)


def read(notes):
    return [json.loads(line)[0] for line in notes.read_text().splitlines()] if notes.exists() else []


def wait_for(what, seconds=30):
    until = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < until
        time.sleep(0.02)


def test_one_after_the_other(tmp_path):
    notes = tmp_path / "notes"
    processes = [holding(tmp_path / "claims" / "00000", notes, 0.3) for _ in range(4)]
    assert [process.wait(60) for process in processes] == [0] * 4
    assert read(notes) == ["in", "out"] * 4


def test_one_who_holds_it_for_longer_than_a_lease_is_waited_for(tmp_path):
    path, notes = tmp_path / "00000", tmp_path / "notes"
    process = holding(path, notes, 1.5 * LEASE)
    wait_for(lambda: read(notes) == ["in"])
    with claimed(path, LEASE):
        assert read(notes) == ["in", "out"]
    assert process.wait(10) == 0


def test_a_killed_holder_is_waited_for_until_its_lease_ends(tmp_path):
    path, notes = tmp_path / "00000", tmp_path / "notes"
    process = holding(path, notes, 1000)
    wait_for(lambda: read(notes) == ["in"])
    process.kill()
    process.wait()
    begun = time.monotonic()
    with claimed(path, LEASE):
        assert 0.5 * LEASE < time.monotonic() - begun < 3 * LEASE
    begun = time.monotonic()
    with claimed(path, LEASE):  # that one was given back
        assert time.monotonic() - begun < 0.5 * LEASE


def test_a_holder_that_wakes_after_its_lease_leaves_at_once(tmp_path):
    path, notes = tmp_path / "00000", tmp_path / "notes"
    process = holding(path, notes, 1000)
    wait_for(lambda: read(notes) == ["in"])
    process.send_signal(19)  # SIGSTOP: it neither renews nor notices
    with claimed(path, LEASE):
        process.send_signal(18)
        assert process.wait(LEASE) == 75
        mine = max(tmp_path.glob("00000.*"))
        assert time.time() - mine.stat().st_mtime < LEASE  # it did not give back what is not its own


def test_a_holder_that_was_halted_goes_on_if_nobody_came(tmp_path):
    notes = tmp_path / "notes"
    process = holding(tmp_path / "00000", notes, 3 * LEASE, before=SLOW)  # which does not renew in no time
    wait_for(lambda: read(notes) == ["in"])
    time.sleep(0.3 * LEASE)
    process.send_signal(19)  # SIGSTOP
    time.sleep(1.2 * LEASE)
    process.send_signal(18)
    assert process.wait(6 * LEASE) == 0
    assert read(notes) == ["in", "out"]


@pytest.mark.parametrize("number", [0, errno.EPERM, errno.EOPNOTSUPP])
def test_a_claim_has_its_text_from_the_first_moment(tmp_path, monkeypatch, number):
    link, texts = os.link, []

    def look(new, claim):
        texts.append(new.read_text())
        if number:
            raise OSError(number, os.strerror(number))
        link(new, claim)

    monkeypatch.setattr(os, "link", look)
    for count in (1, 2):
        with claimed(tmp_path / "00000", LEASE) as claim:
            assert claim.name == f"00000.{count}"
            assert claim.read_text() == texts[-1] != ""
    assert {path.name for path in tmp_path.iterdir()} == {"00000.1", "00000.2"}


def test_a_full_disk_leaves_no_claim(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(type(tmp_path), "write_text", full)
        with pytest.raises(OSError, match="No space"), claimed(tmp_path / "00000", LEASE):
            pass
    assert list(tmp_path.iterdir()) == []


def test_a_lost_claim_is_noticed(tmp_path):
    with ExitStack() as held:
        lost = {how: threading.Event() for how in ("taken", "gone", "not its own")}
        for how, event in lost.items():
            held.enter_context(claimed(tmp_path / how / "00000", LEASE, event.set))
        time.sleep(LEASE)
        assert not [how for how, event in lost.items() if event.is_set()]  # nothing is wrong yet
        (tmp_path / "taken" / "00000.2").touch()
        os.rename(tmp_path / "gone", tmp_path / "away")
        (tmp_path / "not its own" / "00000.1").write_text("another's")
        assert [how for how, event in lost.items() if not event.wait(LEASE)] == []


def test_a_claim_that_cannot_be_renewed_is_given_up_before_others_may_take_it(tmp_path, monkeypatch):
    lost, over, real = threading.Event(), threading.Event(), os.utime

    def hang(path, *more):
        if "00000.1" in str(path) and not more:
            over.wait()  # as a file server does that is gone
        real(path, *more)

    monkeypatch.setattr(os, "utime", hang)
    begun = time.monotonic()
    with claimed(tmp_path / "00000", LEASE, lost.set):
        assert lost.wait(LEASE)
        assert time.monotonic() - begun < LEASE
        over.set()


def test_what_claims_nothing_is_refused_where_somebody_is(tmp_path):
    folder = tmp_path / CLAIMS
    path = folder / "a" / "00003"
    refuse_claimed(folder)  # there is nothing yet
    with claimed(path, LEASE):
        for engine in ("local", "ray"):
            with pytest.raises(
                PlanError, match=r"00003\.1: jobs of Slurm are at this plan .* s ago\)\. Go on with"
            ) as error:
                open_engine(engine, None, tmp_path, 1, {})
            assert "\n" not in str(error.value)
    refuse_claimed(folder)  # it was given back
    with claimed(path, LEASE):
        os.utime(path.with_name("00003.2"), (time.time() - 200,) * 2)
        refuse_claimed(folder)  # its holder is long dead


def take_and_give_back(path, lease):
    with claimed(path, lease):
        pass


def test_a_claim_is_judged_by_the_lease_that_it_was_made_with(tmp_path):
    path = tmp_path / CLAIMS / "a" / "00003"
    with claimed(path, 600.0):
        claim = path.with_name("00003.1")
        os.utime(claim, (time.time() - 500,) * 2)  # renewed every 60 s, and a bad minute now and then
        with pytest.raises(PlanError, match="jobs of Slurm are at this plan"):
            refuse_claimed(tmp_path / CLAIMS)
        waiting = threading.Thread(target=take_and_give_back, args=(path, 0.1), daemon=True)
        waiting.start()
        waiting.join(1.0)
        assert waiting.is_alive()
    waiting.join(10)
    assert not waiting.is_alive()


@pytest.mark.parametrize("gone", [True, False])
def test_who_runs_a_plan_leaves_if_another_does_not_if_the_folder_is_gone(tmp_path, monkeypatch, gone):
    left = threading.Event()
    monkeypatch.setattr(os, "_exit", lambda code: left.set())
    out = tmp_path / "out"
    with sole(out / ".driver", 0.5):
        if gone:
            os.rename(out, tmp_path / "away")
        else:
            (out / ".driver.2").touch()
        assert left.wait(1.0) != gone


@pytest.mark.parametrize("lease", ["nan", "inf", "-1", "0", "1e308", "x"])
def test_a_lease_beyond_all_bounds_is_the_default(tmp_path, lease):
    claim = tmp_path / "unit.1"
    claim.write_text(f"host 1 token {lease} -")
    assert lease_of(claim) == DEFAULT_LEASE


def test_other_names_next_to_claims_are_none(tmp_path):
    units = tmp_path / "units"
    units.mkdir()
    for name in ("unit.2", "unit.2x", "unit.0\u00b2", "unit.9999999999"):
        (units / name).write_text("host 1 token 2.0 -")
    assert claims_of(units / "unit") == {2: units / "unit.2"}
    os.utime(units / "unit.2", (0, 0))
    refuse_claimed(tmp_path)  # given back
    with claimed(units / "unit", LEASE) as claim:
        assert claim.name == "unit.3"
