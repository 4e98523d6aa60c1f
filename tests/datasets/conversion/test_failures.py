import json

from managing import convert_made_up as convert
from managing import edit
from synthetic import write_trajectory

from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.conversion.data_info import copy_failures
from robocas_ms3.datasets.manage.merge import merge
from robocas_ms3.datasets.sources.provenance import compute_environment_id
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.demos.failures import FailedAttempt

SLIPPED = FailedAttempt(3, 0, "grasp", "slipped", 2.5)
LOST = FailedAttempt(4, -1, "episode", "skipped", 0.0)
OTHER = FailedAttempt(9, 1, "reach", "unreachable", 1.0)


def run_of(folder, failures, seeds=(3, 5), **kwargs):
    """A trajectory file with its failures."""
    folder.mkdir()
    JsonLinesFile(folder / "failures.jsonl", FailedAttempt).append(failures)
    return write_trajectory(folder / "trajectory.h5", seeds=seeds, **kwargs)


def failures_of(out, task=None):
    """Failures of a dataset, of one task or all."""
    lines = [json.loads(line) for line in (out / "failures.jsonl").read_text().splitlines()]
    assert all(set(line) == {*vars(SLIPPED), "task", "environment"} for line in lines)
    return [FailedAttempt(*(line[key] for key in vars(SLIPPED))) for line in lines if task in (None, line["task"])]


def test_failures_are_copied_to_the_dataset(tmp_path):
    trajectory, out = run_of(tmp_path / "run", [SLIPPED, LOST]), tmp_path / "out"
    convert(trajectory, out)
    assert failures_of(out) == [SLIPPED, LOST]
    assert validate(out).violations == []
    # appended: what is not there yet, once
    more = run_of(tmp_path / "more", [LOST, OTHER], seeds=(7,))
    for _ in range(2):
        convert(more, out, append=True)
        assert failures_of(out) == [SLIPPED, LOST, OTHER]
    assert validate(out).violations == []
    merge([out], tmp_path / "merged")
    assert validate(tmp_path / "merged").violations == []
    convert(more, out, overwrite=True)
    assert failures_of(out) == [LOST, OTHER]


def test_failures_of_two_tasks_are_distinct(tmp_path):
    """Equal lines of two runs are two failures."""
    first, out = run_of(tmp_path / "run", [SLIPPED, LOST]), tmp_path / "out"
    second = run_of(tmp_path / "more", [LOST], seeds=(3, 7), steps=24)
    edit(second.with_suffix(".json"), lambda c: c["env_info"].update(env_id="robocas_ms3:RoboCASOpenPick-v1"))
    third = run_of(tmp_path / "third", [LOST], seeds=(9,))
    edit(third.with_suffix(".json"), lambda c: c["env_info"]["env_kwargs"].update(config="pick_shelf_scattered"))
    convert(first, out)
    for more in (second, second, third):
        convert(more, out, append=True)
    assert failures_of(out, "pick") == [SLIPPED, LOST, LOST]
    assert failures_of(out, "open_pick") == [LOST]
    made_in = [json.loads(line)["environment"] for line in (out / "failures.jsonl").read_text().splitlines()]
    assert made_in[0] == made_in[1]
    assert len(set(made_in)) == 3
    scenes = [Dataset(out).episode(n).scene for n in Dataset(out).numbers]
    assert [compute_environment_id(scene["env_info"]) for scene in scenes] == [made_in[i] for i in (0, 0, 2, 2, 3)]


def test_lines_of_an_earlier_version_are_not_added_again(tmp_path):
    trajectory, out = run_of(tmp_path / "run", [SLIPPED, LOST]), tmp_path / "out"
    convert(trajectory, out)
    before = (tmp_path / "run" / "failures.jsonl").read_bytes()
    (out / "failures.jsonl").write_bytes(before)
    convert(trajectory, out, append=True)
    assert (out / "failures.jsonl").read_bytes() == before


def test_truncated_failures_file(tmp_path):
    """A truncated line is ignored; appended lines start on a new line."""
    for name, text in (("run", json.dumps(vars(SLIPPED)) + '\n{"seed": 1, "att'), ("more", json.dumps(vars(LOST)))):
        (tmp_path / name).mkdir()
        (tmp_path / name / "failures.jsonl").write_text(text)
    (tmp_path / "out").mkdir()
    for name in ("more", "run"):
        copy_failures(tmp_path / name, tmp_path / "out", {"env_id": "robocas_ms3:RoboCASPick-v1"})
    assert failures_of(tmp_path / "out", "pick") == [LOST, SLIPPED]
