"""Candidates of decisions in a plan: recorded per seed, joined per plan part."""

import pytest
from plan_stages import run_here
from synthetic_candidates import write_episodes

from robocas_ms3.demos.candidates.candidates_file import FILE_NAME, CandidateFile
from robocas_ms3.plans import worker
from robocas_ms3.plans.plan import PartConfig, Plan

RECORDER = worker.Recorder  # before the stub of this folder replaces it


class CandidateRecorder:
    """Stage that writes synthetic recordings and candidates."""

    def __init__(self, plan):
        from plan_stages import StubRecorder

        self.recorder = StubRecorder(plan)

    def run(self, files):
        write_episodes(files.candidates_path, seeds=(files.seed,))
        return self.recorder.run(files)

    def close(self):
        pass


def make_plan(**recording):
    part = PartConfig(task="pick", config="pick_table_scattered", episodes=2, seed=3, name="a")
    plan = {"parts": [part], "stages": ["demonstrations"], "recording": {"record_candidates": True, **recording}}
    return Plan.model_validate(plan, strict=False)


def read_seeds(path):
    return list(dict.fromkeys(CandidateFile(path).decisions["seed"].tolist()))


def test_candidates_are_joined_in_the_order_of_their_seeds(tmp_path):
    run_here(tmp_path / "out", make_plan(), record=CandidateRecorder)
    joined = tmp_path / "out" / "demos" / "a" / FILE_NAME
    assert read_seeds(joined) == [3, 4]
    assert not list((tmp_path / "out" / "units").rglob("*.h5"))


@pytest.mark.parametrize("content", [b"", b"damaged"])
def test_damaged_file_is_joined_again(tmp_path, monkeypatch, content):
    out = tmp_path / "out"
    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr("robocas_ms3.plans.run.join_episodes", lambda *_, **__: 1 / 0)
        run_here(out, make_plan(), record=CandidateRecorder)
    (out / "demos" / "a").mkdir(parents=True)
    (out / "demos" / "a" / FILE_NAME).write_bytes(content)
    run_here(out, make_plan(), record=CandidateRecorder)
    assert read_seeds(out / "demos" / "a" / FILE_NAME) == [3, 4]


@pytest.mark.slow
def test_worker_records_candidates(tmp_path):
    run_here(tmp_path / "out", make_plan(candidates=3), record=RECORDER)
    file = CandidateFile(tmp_path / "out" / "demos" / "a" / FILE_NAME)
    assert set(file.decisions["candidate_count"]) == {3}
    assert read_seeds(tmp_path / "out" / "demos" / "a" / FILE_NAME) == [3, 4]
