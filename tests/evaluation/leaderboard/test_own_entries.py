"""The entries in ``leaderboard/`` are valid, and model cards of bundled weights are those of the runs."""

from pathlib import Path

import pytest

from robocas_ms3.baselines.training.record import BUNDLED
from robocas_ms3.evaluation.leaderboard.entries import CARD, find_result_violations, find_results
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.results.result_files import read_result

ENTRIES = Path(__file__).resolve().parents[3] / "leaderboard"


@pytest.mark.parametrize("folder", find_results(ENTRIES), ids=lambda folder: f"{folder.parent.name}-{folder.name}")
def test_results_are_valid(folder):
    result = read_result(folder)
    assert find_result_violations(result, load_protocol(result.run.protocol)) == []
    if (BUNDLED / folder.parent.name).is_dir():
        assert result.run.policy.name == folder.parent.name


@pytest.mark.parametrize("entry", sorted(path for path in ENTRIES.iterdir() if (BUNDLED / path.name).is_dir()))
def test_model_cards_are_those_of_the_bundled_weights(entry):
    assert (entry / CARD).read_text() == (BUNDLED / entry.name / CARD).read_text()
