import json

from synthetic import RayCaster, write_trajectory

from robocas_ms3.datasets.convert import convert
from robocas_ms3.datasets.failures import add_failures
from robocas_ms3.datasets.manage.merging import merge
from robocas_ms3.datasets.validate import validate
from robocas_ms3.demos.ledger import Failure, Ledger

SLIPPED = Failure(3, 0, "grasp", "slipped", 2.5)
LOST = Failure(4, -1, "episode", "gave_up", 0.0)
OTHER = Failure(9, 1, "reach", "unreachable", 1.0)


def run_of(folder, failures, seeds=(3, 5)):
    """A trajectory and what went wrong with it."""
    folder.mkdir()
    Ledger(folder / "failures.jsonl").append(failures)
    return write_trajectory(folder / "trajectory.h5", seeds=seeds)


def test_lost_seeds_go_along(tmp_path):
    trajectory, out = run_of(tmp_path / "run", [SLIPPED, LOST]), tmp_path / "out"
    convert(trajectory, out, embeddings=False, open_source=RayCaster)
    assert (out / "failures.jsonl").read_bytes() == (tmp_path / "run" / "failures.jsonl").read_bytes()
    assert validate(out).violations == []
    # appended: what is not there yet, once
    more = run_of(tmp_path / "more", [LOST, OTHER], seeds=(7,))
    for _ in range(2):
        convert(more, out, embeddings=False, open_source=RayCaster, append=True)
        assert Ledger(out / "failures.jsonl").read() == [SLIPPED, LOST, OTHER]
    assert validate(out).violations == []
    merge([out], tmp_path / "merged")
    assert validate(tmp_path / "merged").violations == []
    convert(more, out, embeddings=False, open_source=RayCaster, overwrite=True)
    assert Ledger(out / "failures.jsonl").read() == [LOST, OTHER]


def test_nothing_went_wrong(tmp_path):
    trajectory = run_of(tmp_path / "run", [])
    convert(trajectory, tmp_path / "out", embeddings=False, open_source=RayCaster)
    assert not (tmp_path / "out" / "failures.jsonl").exists()


def test_a_run_that_was_cut_off(tmp_path):
    """Half a line stays out; a line without an end is not run into by what is appended later."""
    for name, text in (("run", json.dumps(vars(SLIPPED)) + '\n{"seed": 1, "att'), ("more", json.dumps(vars(LOST)))):
        (tmp_path / name).mkdir()
        (tmp_path / name / "failures.jsonl").write_text(text)
    (tmp_path / "out").mkdir()
    for name in ("more", "run"):
        add_failures(tmp_path / name, tmp_path / "out")
    expected = "".join(json.dumps(vars(failure)) + "\n" for failure in (LOST, SLIPPED))
    assert (tmp_path / "out" / "failures.jsonl").read_text() == expected
