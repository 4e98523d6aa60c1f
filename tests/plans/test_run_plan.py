"""Plans with synthetic episodes: the dataset depends only on the plan, also after crashes and interruptions."""

import json
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest
from plan_stages import (
    PLAN,
    FailingStage,
    assert_same,
    crashes_of,
    plan_faults,
    run_here,
    seeds_done,
    stub_stages,
)

from robocas_ms3.core.checks import parse_shard
from robocas_ms3.core.errors import OutputExistsError, PlanError, RobocasError
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.demos.recordings.trajectory_file import TrajectoryFile
from robocas_ms3.demos.recordings.trajectory_json import package_versions
from robocas_ms3.plans.executors import LocalExecutor
from robocas_ms3.plans.folder import Outcome, PlanFolder, WorkUnit
from robocas_ms3.plans.run import join_plan, run_shard
from robocas_ms3.plans.status import read_status
from robocas_ms3.plans.worker import Recorder, WorkUnitWorker
from robocas_ms3.robots.cameras import STANDARD_CAMERA_NAMES

SUPPORT = Path(__file__).resolve().parents[1] / "support"


def shard(out, text, plan=PLAN):
    return run_shard(LocalExecutor(PlanFolder(plan, out)), parse_shard(text, PlanError))


def test_demonstrations_and_one_dataset_of_all_parts(undisturbed):
    report = json.loads((undisturbed / "report.json").read_text())
    assert report["episodes"] == 7
    assert report["parts"]["a"]["seeds"] == [10, 11, 12, 13, 14]
    assert report["parts"]["b"]["seeds"] == [3, 4]
    dataset = Dataset(undisturbed / "datasets" / "robocas")
    assert dataset.numbers == list(range(7))
    assert [dataset.conversion_entry(number)["seed"] for number in range(7)] == [10, 11, 12, 13, 14, 3, 4]
    assert validate(dataset.root).violations == []
    with TrajectoryFile(undisturbed / "demos" / "a" / "trajectory.h5") as file:
        assert [entry["episode_seed"] for entry in file.episodes] == [10, 11, 12, 13, 14]
    for number, (part, place) in enumerate([("a", i) for i in range(5)] + [("b", 0), ("b", 1)]):
        # where its recording is now, not the file of one seed that it was rendered from
        trajectory = f"demos/{part}/trajectory.h5"
        entry, source = dataset.conversion_entry(number), dataset.episode(number).scene["source"]
        assert (entry["trajectory"], entry["trajectory_episode"]) == (trajectory, place)
        assert (source["trajectory"], source["episode_id"]) == (trajectory, place)
        with TrajectoryFile(undisturbed / trajectory) as file:
            assert file.episodes[place]["episode_seed"] == entry["seed"]
    assert not list((undisturbed / "units").rglob("*.h5"))  # nothing is kept twice


def test_two_jobs_and_a_lerobot_dataset(undisturbed, tmp_path):
    out, lerobot = tmp_path / "out", tmp_path / "out" / "datasets" / "lerobot"
    run_here(out, PLAN.model_copy(update={"formats": ["robocas", "lerobot"], "lerobot_version": "2.1"}), jobs=2)
    info = json.loads((lerobot / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["total_episodes"]) == ("v2.1", 7)
    shutil.rmtree(lerobot)
    assert_same(undisturbed, out)


def test_shards_in_any_order_write_the_same_dataset(undisturbed, tmp_path):
    out = tmp_path / "out"
    assert not shard(out, "1/2")
    assert not (out / "units" / "a" / "00000").exists()
    with pytest.raises(PlanError, match="work units are missing") as error:
        join_plan(out)
    assert error.value.where == out
    assert shard(out, "0/2")
    assert not (out / "datasets").exists()
    assert join_plan(out)["episodes"] == 7
    assert_same(undisturbed, out)


@pytest.mark.parametrize("text", ["2/2", "1", "-1/2", "1/2/3"])
def test_invalid_shard_is_an_error(text):
    with pytest.raises(PlanError):
        parse_shard(text, PlanError)


def test_same_shard_may_run_twice_at_the_same_time(undisturbed, tmp_path):
    out = tmp_path / "out"
    with ThreadPoolExecutor(2) as threads:
        assert list(threads.map(lambda text: shard(out, text), ["0/1", "0/1"])) == [True, True]
    join_plan(out)
    assert_same(undisturbed, out)


def test_first_folder_of_a_seed_is_kept(tmp_path):
    files = PlanFolder(PLAN, tmp_path).seed_files(WorkUnit(0, 0), 10)
    with files.temporary_files() as late, files.temporary_files() as first:
        for tmp in (late, first):
            tmp.recording_path.write_text("late" if tmp is late else "first")
            tmp.write_outcome(Outcome(10, True))
    assert files.recording_path.read_text() == "first"
    assert [path.name for path in files.folder.parent.iterdir()] == [files.folder.name]


def test_seed_with_damaged_outcome_runs_again(undisturbed, out):
    unit = PlanFolder(PLAN, out).unit_folder(WorkUnit(0, 0))
    (unit / "seeds.jsonl").unlink()
    os.truncate(unit / "0000000011" / "outcome.json", 20)
    run_here(out)
    assert_same(undisturbed, out)


def test_process_that_crashes_once_loses_no_episode(undisturbed, tmp_path):
    out = tmp_path / "out"
    plan_faults(out, {10: ["crash"], 12: ["grow"], 13: ["bug"], 3: ["hang"]})
    limits = PLAN.limits.model_copy(update={"record_seconds": 8, "memory_gb": 0.5})
    run_here(out, PLAN.model_copy(update={"limits": limits}))
    assert_same(undisturbed, out)
    assert crashes_of(out) == [
        (10, "record: SIGSEGV"),
        (12, "record: memory limit exceeded"),
        (13, "record: ValueError: a bug of two lines"),
        (3, "record: time limit exceeded"),
    ]


def test_seed_that_crashes_twice_is_skipped_and_replaced(tmp_path):
    out = tmp_path / "out"
    plan_faults(out, {11: ["crash", "crash", "crash"], 12: ["fail"], 13: ["damaged", "damaged"]})
    report = run_here(out)
    assert report["parts"]["a"]["seeds"] == [10, 14, 15, 16, 17]
    found, damaged = read_status(out), "record: this recording is damaged"
    assert found.parts[0].failed == {"record: SIGSEGV": 1, "grasp: slipped": 1, damaged: 1}
    assert (found.parts[0].done, found.parts[0].requested) == (5, 5)
    assert found.finished
    assert crashes_of(out) == [(11, "record: SIGSEGV")] * 2 + [(13, damaged)] * 2


def test_machine_that_cannot_open_a_part_fails_no_seed(tmp_path):
    plan = PLAN.model_copy(update={"parts": [PLAN.parts[0].model_copy(update={"pack": "mine"})]})
    shard(tmp_path / "out", "4/5")
    (tmp_path / "out" / "plan.json").write_text(
        json.dumps({"plan": plan.model_dump(mode="json"), "versions": package_versions()})
    )
    with stub_stages(Recorder), closing(WorkUnitWorker(PlanFolder(plan, tmp_path / "out"))) as worker:
        with pytest.raises(PlanError) as error:
            worker.run(WorkUnit(0, 0))
        assert error.value.where == "plan part a"
    assert seeds_done(tmp_path / "out") == 0


def test_too_many_failures_are_an_error(tmp_path):
    plan = PLAN.model_copy(update={"block": 8})
    plan_faults(tmp_path / "out", {seed: ["fail"] for seed in range(200)})
    with pytest.raises(PlanError) as error:
        run_here(tmp_path / "out", plan)
    assert error.value.found == "25 of 25 skipped, most often with grasp: slipped"


def test_episodes_with_truncated_files_are_recorded_again(undisturbed, out):
    folders = [PlanFolder(PLAN, out).seed_files(WorkUnit(0, 0), seed).folder for seed in (10, 11, 12)]
    image = sorted(folders[1].rglob("*.png"))[0]
    for path, length in ((folders[0] / "recording.h5", 1000), (image, 50), (folders[2] / "recording.json", 0)):
        os.truncate(path, length)
    with pytest.raises(PlanError, match="work units are missing"):
        join_plan(out)
    run_here(out)
    assert_same(undisturbed, out)


def test_disk_that_damages_files_twice_ends_the_run(out, monkeypatch):
    monkeypatch.setattr(
        "robocas_ms3.plans.progress.PlanProgress.delete_damaged_episodes", lambda _: {WorkUnit(1, 0): [4]}
    )
    with pytest.raises(PlanError, match="the size of files changes") as error:
        run_here(out)
    assert error.value.where == PlanFolder(PLAN, out).unit_folder(WorkUnit(1, 0))
    assert not (out / "datasets").exists()


def test_folder_with_other_files_is_an_error(tmp_path):
    (tmp_path / "thesis").write_text("")
    for flags in ({}, {"overwrite": True}):
        with pytest.raises(OutputExistsError):
            run_here(tmp_path, **flags)
    with pytest.raises(OutputExistsError):
        shard(tmp_path, "0/2")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis"]


def test_other_plan_needs_overwrite_except_for_limits_and_description(undisturbed, out):
    other = PLAN.model_copy(update={"block": 4})
    for start in (run_here, lambda out, plan: shard(out, "1/2", plan)):
        with pytest.raises(RobocasError, match="block: 3 -> 4"):
            start(out, other)
    limits = PLAN.limits.model_copy(update={"memory_gb": 3.0})
    images = PLAN.images.model_copy(update={"cameras": list(STANDARD_CAMERA_NAMES)})  # none are in older plans
    run_here(out, PLAN.model_copy(update={"limits": limits, "description": "another", "images": images}))
    assert_same(undisturbed, out)
    assert json.loads((out / "plan.json").read_text())["plan"]["limits"]["memory_gb"] == 3.0
    before = (out / "report.json").stat().st_mtime_ns
    run_here(out)  # nothing is left to do
    assert (out / "report.json").stat().st_mtime_ns == before
    run_here(out, other, overwrite=True)
    assert PlanFolder(other, out).read_outcomes(WorkUnit(0, 1))[0].seed == 14


def record_other_versions(out):
    record = json.loads((out / "plan.json").read_text())
    record["versions"]["sapien"] = "2.2.2"
    (out / "plan.json").write_text(json.dumps(record))


def test_machine_with_other_versions_cannot_join(out):
    record_other_versions(out)
    with pytest.raises(OutputExistsError, match=r"versions\.sapien: .*2\.2\.2"):
        join_plan(out)
    assert not (out / "report.json").exists()


def test_machine_with_other_versions_runs_no_work_unit(tmp_path):
    out = tmp_path / "out"
    shard(out, "4/5")
    record_other_versions(out)
    worker = WorkUnitWorker(PlanFolder(PLAN, out))
    for start in (lambda: worker.run(WorkUnit(0, 0)), lambda: shard(out, "0/2")):
        with pytest.raises(OutputExistsError, match=r"versions\.sapien: .*2\.2\.2"):
            start()
    assert not (out / "units").exists()


def test_worker_of_a_replaced_plan_writes_nothing(tmp_path):
    out = tmp_path / "out"
    shard(out, "4/5")
    worker = WorkUnitWorker(PlanFolder(PLAN, out))
    seeds = worker.run_seeds(WorkUnit(0, 0))
    next(seeds)
    run_here(out, PLAN.model_copy(update={"block": 2}), overwrite=True)
    with pytest.raises(OutputExistsError):
        next(seeds)
    worker.close()
    assert seeds_done(out) == 8


def test_process_that_cannot_start_ends_the_run_and_fails_no_seed(tmp_path):
    with pytest.raises(PlanError, match="no such library"):
        run_here(tmp_path / "out", render=FailingStage)
    assert seeds_done(tmp_path / "out") == 0
