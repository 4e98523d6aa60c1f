"""Descriptions of policies are checked at the start, and their texts are escaped in reports."""

import re
from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic_results import actions_of, outcome, write

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.policy import EpisodeSpec, PolicySpec, describe_policy
from robocas_ms3.evaluation.remote.server import PolicyServer
from robocas_ms3.evaluation.report import write_report
from robocas_ms3.evaluation.report.comparison import compare_results
from robocas_ms3.evaluation.results.outcomes import EvaluatedEpisode
from robocas_ms3.evaluation.results.result_files import append_episode, open_result, read_result
from robocas_ms3.evaluation.rollouts.rollout import Rollout
from robocas_ms3.evaluation.rollouts.session import EvaluationSession
from robocas_ms3.evaluation.settings import EvaluationSettings

HOSTILE = "\x1b]0;t\x07\x9b\u202e<script>alert(1)</script>|`a`\n[b](http://c)"


class Policy:
    """Policy with a given description."""

    spec = PolicySpec(rate_hz=5.0)

    def __init__(self, description):
        self.describe = lambda: description


@pytest.mark.parametrize(
    ("description", "key"),
    [
        ({"weights": {"scale": float("nan")}}, ", weights.scale"),
        ({"weights": [1.0, float("-inf")]}, ", weights.1"),
        ({"steps": 10**400}, ", steps"),
        ({"seed": np.int64(1)}, ", seed"),
        ({"file": "\udcff"}, ", file"),
        (["weights"], ""),
        (None, ""),
    ],
)
def test_descriptions_that_cannot_be_recorded_are_refused(description, key):
    for use in (describe_policy, PolicyServer):
        with pytest.raises(EvaluationError) as error:
            use(Policy(description))
        assert error.value.where == f"policy {__name__}:Policy, describe(){key}"
    policy = Policy({})
    policy.spec = PolicySpec(rate_hz=float("nan"))
    with pytest.raises(EvaluationError, match=r"spec\.rate_hz"):
        describe_policy(policy)


def test_description_round_trips_and_does_not_rename_the_policy(tmp_path):
    policy = Policy({"name": 5, "sizes": (1, 2), "note": HOSTILE})
    run = EvaluationSession(policy, EvaluationSettings(policy="mine", protocol="smoke", backend="processes")).run_record
    with open_result(tmp_path / "out", run):
        append_episode(tmp_path / "out", EvaluatedEpisode(outcome(0), actions_of(outcome(0))))
    assert read_result(tmp_path / "out").run.policy.name == "mine"
    with open_result(tmp_path / "out", run) as done:  # the record equals the written record
        assert list(done) == [0]


def test_error_text_of_a_policy_round_trips(tmp_path):
    start = EpisodeSpec(0, 0, "pick", "table", "", "builtin", 0, "")
    episode = SimpleNamespace(episode=0, task="pick", config="table", seed=0, split="test", p_vis=None)
    made = Rollout(start, error=f"{HOSTILE}\udcff").make_outcome(episode, [])
    assert made.error.isprintable()
    write(tmp_path / "out", [])
    append_episode(tmp_path / "out", EvaluatedEpisode(made, actions_of(made)))
    assert asdict(read_result(tmp_path / "out").outcomes[0]) == asdict(made)


def test_reports_escape_texts(tmp_path):
    texts = {"config": HOSTILE, "split": HOSTILE, "failure_stage": HOSTILE, "error": HOSTILE}
    outcomes = [outcome(0), outcome(1, came_to=2, **texts), outcome(2, split=HOSTILE)]
    run = {"protocol": HOSTILE, "policy": {"name": HOSTILE, "note": HOSTILE}, "versions": {HOSTILE: HOSTILE}}
    found = write(tmp_path / "out", outcomes, **run, protocol_hash=HOSTILE)
    write_report(found, tmp_path / "report")
    reports = {name: (tmp_path / "report" / name).read_text(encoding="utf-8") for name in ("report.md", "report.html")}
    reports["comparison"] = compare_results([found, found])
    for name, text in reports.items():
        assert all(character.isprintable() or character in "\n\t" for character in text), name
        assert "<script>alert" not in text.replace("\\<", "")
    for name in ("report.md", "comparison"):
        for rows in re.findall(
            r"(?:^\|.*\n)+", reports[name], re.MULTILINE
        ):  # rows of a table have equal numbers of cells
            assert len({row.replace("\\|", "").count("|") for row in rows.splitlines()}) == 1
