"""Plans over made-up episodes: the outcome follows from the plan, whoever does the units and whatever befalls them."""

import json
import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
from faults import running
from plan_stages import PLAN, MadeUp, assert_same, cannot_begin, plan_faults, stages

from robocas_ms3.core.errors import MissingExtraError, OutputExistsError, PlanError, RobocasError
from robocas_ms3.core.files import write_json
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.demos.recordings.reading import TrajectoryFile
from robocas_ms3.demos.recordings.versions import versions
from robocas_ms3.plans.begun import content_of
from robocas_ms3.plans.engines.local import LocalEngine
from robocas_ms3.plans.run import _Part, run_plan
from robocas_ms3.plans.slot import Slot, Stages
from robocas_ms3.plans.status import status
from robocas_ms3.plans.units import Outcome, Unit, deaths

SUPPORT = Path(__file__).resolve().parents[1] / "support"


def run(out, plan=PLAN, jobs=1, stop_before_join=False, **more):
    if stop_before_join:
        with pytest.MonkeyPatch.context() as patch, pytest.raises(ZeroDivisionError):
            patch.setattr("robocas_ms3.plans.run.join", lambda *_, **__: 1 / 0)
            run(out, plan, jobs, **more)
        return None
    return run_plan(plan, out, lambda plan, out: LocalEngine(plan, out, jobs, stages=stages()), jobs=1, **more)


def test_a_plan_makes_demonstrations_and_one_dataset_of_all_parts(undisturbed):
    report = json.loads((undisturbed / "report.json").read_text())
    assert report["episodes"] == 7
    assert report["parts"]["a"]["seeds"] == [10, 11, 12, 13, 14]
    assert report["parts"]["b"]["seeds"] == [3, 4]
    dataset = Dataset(undisturbed / "datasets" / "robocas")
    assert dataset.numbers == list(range(7))
    assert [dataset.entry(number)["seed"] for number in range(7)] == [10, 11, 12, 13, 14, 3, 4]
    assert validate(dataset.root).violations == []
    with TrajectoryFile(undisturbed / "demos" / "a" / "trajectory.h5") as file:
        assert [entry["episode_seed"] for entry in file.episodes] == [10, 11, 12, 13, 14]
    for number, (part, place) in enumerate([("a", i) for i in range(5)] + [("b", 0), ("b", 1)]):
        # where its recording is now, not the file of one seed that it was rendered from
        trajectory = f"demos/{part}/trajectory.h5"
        entry, source = dataset.entry(number), dataset.episode(number).scene["source"]
        assert (entry["trajectory"], entry["trajectory_episode"]) == (trajectory, place)
        assert (source["trajectory"], source["episode_id"]) == (trajectory, place)
        with TrajectoryFile(undisturbed / trajectory) as file:
            assert file.episodes[place]["episode_seed"] == entry["seed"]
    assert not list((undisturbed / "units").rglob("*.h5"))  # nothing is kept twice


def test_the_lerobot_dataset_has_the_version_of_the_plan(tmp_path):
    plan = PLAN.model_copy(update={"formats": ["robocas", "lerobot"], "lerobot_version": "2.1"})
    run(tmp_path / "out", plan)
    info = json.loads((tmp_path / "out" / "datasets" / "lerobot" / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["total_episodes"]) == ("v2.1", 7)


def test_more_slots_make_the_same(undisturbed, tmp_path):
    run(tmp_path / "out", jobs=2)
    assert_same(undisturbed, tmp_path / "out")


def test_a_process_that_dies_once_costs_nothing(undisturbed, tmp_path):
    out = tmp_path / "out"
    plan_faults(out, {10: ["crash"], 12: ["grow"], 13: ["bug"], 3: ["hang"]})
    limits = PLAN.limits.model_copy(update={"record_seconds": 4, "memory_gb": 0.5})
    run(out, PLAN.model_copy(update={"limits": limits}))
    assert_same(undisturbed, out)
    died = [death for unit in (Unit(0, 0), Unit(0, 1), Unit(1, 0)) for death in deaths(unit.folder(PLAN, out)).read()]
    assert [(death.seed, death.stage, death.why) for death in died] == [
        (10, "record", "SIGSEGV"),
        (12, "record", "too much memory"),
        (13, "record", "ValueError: a bug"),
        (3, "record", "too slow"),
    ]


def test_a_seed_that_kills_twice_is_left_out_and_another_takes_its_place(tmp_path):
    out = tmp_path / "out"
    plan_faults(out, {11: ["crash", "crash", "crash"], 12: ["fail"]})
    report = run(out)
    assert report["parts"]["a"]["seeds"] == [10, 13, 14, 15, 16]
    found = status(out)
    assert found.parts[0].failed == {"record: SIGSEGV": 1, "grasp: slipped": 1}
    assert (found.parts[0].done, found.parts[0].wanted) == (5, 5)
    assert found.finished


def test_an_error_of_all_seeds_ends_the_run_which_goes_on_later(undisturbed, tmp_path):
    out = tmp_path / "out"
    plan_faults(out, {13: ["refuse"]})
    with pytest.raises(MissingExtraError, match="nothing to record with"):
        run(out)
    with pytest.raises(OutputExistsError):
        run(out)
    run(out, resume=True)
    assert_same(undisturbed, out)
    before = (out / "report.json").stat().st_mtime_ns
    run(out, resume=True)  # nothing is left to do
    assert (out / "report.json").stat().st_mtime_ns == before


def test_what_a_system_refuses_is_no_seed_s_fault(undisturbed, tmp_path):
    out = tmp_path / "out"
    plan_faults(out, {12: ["limit"]})
    with pytest.raises(RobocasError, match="can't start another process"):
        run(out)
    assert not list(out.rglob("deaths.jsonl"))
    run(out, resume=True)
    assert_same(undisturbed, out)


def test_a_damaged_recording_is_a_seed_s_own(tmp_path):
    plan_faults(tmp_path / "out", {11: ["damaged", "damaged"]})
    assert run(tmp_path / "out")["parts"]["a"]["seeds"] == [10, 12, 13, 14, 15]


def test_a_machine_that_cannot_open_a_part_does_no_seed(tmp_path, monkeypatch):
    plan = PLAN.model_copy(update={"parts": [PLAN.parts[0].model_copy(update={"pack": "mine"})]})
    monkeypatch.setattr("robocas_ms3.plans.slot.check_versions", lambda out: None)
    slot = Slot(plan, tmp_path)
    try:
        with pytest.raises(PlanError, match="part a: what this part needs .*AssetError: mine: no such asset pack"):
            slot.do(Unit(0, 0))
    finally:
        slot.close()
    assert not list(tmp_path.rglob("*.jsonl"))


def test_hardly_any_success_is_an_error(tmp_path):
    plan = PLAN.model_copy(update={"block": 8})
    plan_faults(tmp_path / "out", {seed: ["fail"] for seed in range(200)})
    with pytest.raises(PlanError, match="far too many seeds fail .found 25 of 25, most of them: grasp: slipped"):
        run(tmp_path / "out", plan)


def test_the_verdict_on_failures_does_not_depend_on_who_is_first(tmp_path):
    plan = PLAN.model_copy(update={"block": 24})
    bad = [Outcome(seed, False) for seed in range(24)]
    good = [Outcome(seed, True) for seed in range(24, 48)]
    part = _Part(plan, 0)
    part.take(Unit(0, 1), good, tmp_path)
    with pytest.raises(PlanError, match="far too many seeds fail .found 24 of 24"):
        part.take(Unit(0, 0), bad, tmp_path)


def test_a_line_of_a_ledger_that_was_damaged_is_done_again(undisturbed, tmp_path):
    out = tmp_path / "out"
    run(out, stop_before_join=True)
    path = Unit(0, 0).folder(PLAN, out) / "seeds.jsonl"
    first, _, third = path.read_text().splitlines()
    path.write_text(f"{first}\n{{garbage\n{third}\n")
    run(out, resume=True)
    assert_same(undisturbed, out)


def test_episodes_whose_files_were_cut_off_are_made_again(undisturbed, tmp_path):
    out = tmp_path / "out"
    run(out, stop_before_join=True)
    files = Unit(0, 0).folder(PLAN, out)
    picture = sorted((files / "episodes").glob("*11/episode_*/**/*.png"))[0]
    cut = [*files.glob("seed_*10.h5"), picture, *files.glob("seed_*12.json")]
    for path, length in zip(cut, (1000, 50, 0), strict=True):
        os.truncate(path, length)
    said = []
    run(out, resume=True, on_stage=said.append)
    assert said[0] == "3 episodes again: their files are not what was written"
    assert_same(undisturbed, out)


def test_a_disk_that_keeps_nothing_ends_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr("robocas_ms3.plans.run._damaged", lambda *_: {Unit(1, 0): [4]})
    with pytest.raises(PlanError, match=r"b/00000: files don't keep the sizes .*found seed 4, made 3 times"):
        run(tmp_path / "out")
    assert not (tmp_path / "out" / "datasets").exists()


def test_a_plan_on_another_machine_is_left_alone(undisturbed, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    write_json(out / "plan.json", content_of(PLAN))
    claim = out / ".driver.3"
    claim.write_text("node7 4242 abc")
    for flag in ("resume", "overwrite"):
        with pytest.raises(PlanError, match=r"another machine runs this plan .found node7, \d s ago"):
            run(out, **{flag: True})
    assert {path.name for path in out.iterdir()} == {".driver.3", "plan.json"}
    os.utime(claim, (0, 0))  # it was given back
    run(out, resume=True)
    assert_same(undisturbed, out)
    assert not list(out.glob(".driver*"))


def test_a_folder_of_something_else_is_not_gone_on_with(tmp_path):
    (tmp_path / ".bashrc.old").write_text("")
    for how in ({"resume": True}, {}):
        with pytest.raises(PlanError, match="this is no plan's folder"):
            run(tmp_path, **how)
    (tmp_path / "plan.json").write_text("{}")
    with pytest.raises(PlanError, match="refusing to write over what `robocas plan run` has not made"):
        run(tmp_path, overwrite=True)
    assert {path.name for path in tmp_path.iterdir()} == {".bashrc.old", "plan.json"}


def in_a_process(out):
    """A run of two slots, in a process of its own and a group of processes of their own."""
    return running([sys.executable, SUPPORT / "plan_runner.py", out])


def wait_until(what, process):
    until = time.monotonic() + 60
    while not what():
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < until
        time.sleep(0.02)


def seeds_done(out):
    return sum(len(path.read_text().splitlines()) for path in out.glob("units/*/*/seeds.jsonl"))


def alive(group):
    """The commands of the processes of a group that run: an orphan that ended may wait for long to be reaped."""
    return [command for one in psutil.process_iter() if of_group(one, group) and (command := command_of(one))]


def command_of(process):
    with suppress(psutil.NoSuchProcess, psutil.ZombieProcess):
        return process.cmdline()


def of_group(process, group):
    try:
        return os.getpgid(process.pid) == group
    except ProcessLookupError:
        return False


def interrupt(out, seeds):
    """Press Ctrl-C once so many seeds are done; seconds until all processes are gone."""
    with in_a_process(out) as process:
        wait_until(lambda: (out / "plan.json").is_file() and seeds_done(out) >= seeds, process)
        time.sleep(0.3)  # processes that record or render are starting
        begun = time.monotonic()
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=30)
        assert process.returncode != 0
        assert said.count("Traceback") <= 1  # the runner's own
        assert "KeyboardInterrupt" in said
        while alive(process.pid):  # an ending one of Python's own, which keeps track of semaphores, is the last
            assert time.monotonic() - begun < 30, alive(process.pid)
        took = time.monotonic() - begun
    assert not list(out.rglob("deaths.jsonl"))
    return took


@pytest.mark.parametrize("seeds", [0, 2])
def test_ctrl_c_ends_all_processes_soon_and_blames_no_seed(tmp_path, seeds):
    # alone it takes 1.4 s; a machine that is busy for a moment has two more goes
    assert any(interrupt(tmp_path / f"{attempt}", seeds) < 3 for attempt in range(3))


def test_a_process_that_cannot_begin_ends_the_run_and_blames_no_seed(tmp_path):
    def open_engine(plan, out):
        return LocalEngine(plan, out, 1, stages=Stages(MadeUp, cannot_begin))

    with pytest.raises(PlanError, match="a process could not begin .found no such device"):
        run_plan(PLAN, tmp_path / "out", open_engine)
    assert not list(tmp_path.rglob("deaths.jsonl"))
    assert not Unit(0, 0).is_done(PLAN, tmp_path / "out")


def test_another_plan_or_run_in_the_folder_is_refused(undisturbed, tmp_path):
    other = PLAN.model_copy(update={"block": 4})
    with pytest.raises(PlanError, match="begun with another plan"):
        run(undisturbed, other, resume=True)
    (tmp_path / "thesis").write_text("")
    with pytest.raises(PlanError, match="refusing to overwrite"):
        run(tmp_path, overwrite=True)


def test_a_machine_with_other_versions_does_no_unit(tmp_path):
    about = {"plan": {}, "versions": {**versions(), "sapien": "2.2.2"}}
    (tmp_path / "plan.json").write_text(json.dumps(about))
    slot = Slot(PLAN, tmp_path, stages())
    with pytest.raises(PlanError, match=r"this machine has other versions .expected sapien 2\.2\.2, found sapien 3"):
        slot.do(Unit(0, 0))
    assert not (tmp_path / "units").exists()


def test_killed_at_any_moment_it_goes_on_and_ends_the_same(undisturbed, tmp_path):
    out = tmp_path / "out"
    for seeds in (0, 1, 4):
        with in_a_process(out) as process:
            wait_until(lambda seeds=seeds: (out / "plan.json").is_file() and seeds_done(out) >= seeds, process)
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        assert not (out / "report.json").exists()
    assert 4 <= seeds_done(out) < 8  # two units of three, one of two
    run(out, resume=True)
    assert_same(undisturbed, out)
    assert seeds_done(out) == 8
