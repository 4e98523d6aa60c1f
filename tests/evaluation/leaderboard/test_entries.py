"""Results in entries of the leaderboard: all outcomes, and the actions of a sample that the protocol fixes."""

from dataclasses import replace

import pytest
from synthetic_results import of_protocol

from robocas_ms3.cli.leaderboard import Add, add
from robocas_ms3.core.errors import EvaluationError, OutputExistsError
from robocas_ms3.evaluation.leaderboard import entries
from robocas_ms3.evaluation.protocol import load_protocol
from robocas_ms3.evaluation.results import read_result


@pytest.fixture
def result(tmp_path):
    return of_protocol(tmp_path / "result", load_protocol("smoke"))


def test_an_entry_has_all_outcomes_and_the_actions_of_the_sample(result, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(entries, "SAMPLE_SIZE", 3)
    out = tmp_path / "entry" / "smoke"
    assert add(Add((result.folder,), out=out)) == 0
    assert "8 episodes, actions of 3" in capsys.readouterr().out
    copy, sample = read_result(out), entries.choose_sample(result)
    assert copy.outcomes == result.outcomes and copy.run == result.run
    assert sorted(path.stem for path in out.glob("actions/*")) == [f"{number:06d}" for number in sample]
    for number in sample:
        assert (copy.read_actions(number) == result.read_actions(number)).all()


def test_the_sample_depends_on_the_protocol_only(result, monkeypatch):
    monkeypatch.setattr(entries, "SAMPLE_SIZE", 3)
    sample = entries.choose_sample(result)
    failed = {number: replace(one, success=not one.success) for number, one in result.outcomes.items()}
    assert entries.choose_sample(replace(result, outcomes=failed)) == sample and len(set(sample)) == 3
    part = {number: one for number, one in result.outcomes.items() if number != sample[0]}
    assert set(sample[1:]) < set(entries.choose_sample(replace(result, outcomes=part)))
    other = replace(result, run=result.run.model_copy(update={"protocol_hash": "00" * 32}))
    assert entries.choose_sample(other) != sample


def test_bad_results_are_refused_and_nothing_is_written(result, tmp_path):
    out = tmp_path / "entry" / "smoke"
    add(Add((result.folder,), out=out))
    with pytest.raises(OutputExistsError):
        add(Add((result.folder,), out=out))
    assert add(Add((result.folder,), out=out, overwrite=True)) == 0
    (result.folder / "actions" / "000002.npz").unlink()
    with pytest.raises(EvaluationError, match="1 violation"):
        add(Add((result.folder,), out=tmp_path / "other"))
    assert not (tmp_path / "other").exists()
