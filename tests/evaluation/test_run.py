"""Episodes of a real protocol have the same outcomes in every loop, for any number of envs and shards."""

from __future__ import annotations

from pathlib import Path

import pytest

from robocas_ms3.core.errors import OutputExistsError
from robocas_ms3.evaluation import results
from robocas_ms3.evaluation.policies import make_policy
from robocas_ms3.evaluation.policy import EpisodeSpec, ExternalPolicy
from robocas_ms3.evaluation.session import EvaluationSession
from robocas_ms3.evaluation.settings import EvaluationSettings

pytestmark = pytest.mark.slow


def opened(folder, policy="random", **settings) -> EvaluationSession:
    settings = {"tasks": ("pick", "select"), "backend": "processes", **settings}
    return EvaluationSession(make_policy(policy), EvaluationSettings(policy=policy, out=folder, **settings))


def play(folder, policy="random", **settings) -> dict[int, dict]:
    list(opened(folder, policy, **settings).run())
    return {number: one.without_clock() for number, one in results.read(folder).outcomes.items()}


@pytest.fixture(scope="module")
def alone(short, tmp_path_factory):
    """Outcomes of a random policy, one env at a time."""
    return play(tmp_path_factory.mktemp("alone"), protocol=str(short), envs=1)


def test_outcomes_do_not_depend_on_the_number_of_envs_or_on_shards(alone, short, tmp_path):
    assert sorted(alone) == [0, 1, 2, 3]
    assert not any(one["success"] for one in alone.values())
    assert len({one["measures"]["path_length"] for one in alone.values()}) == 4
    together = play(tmp_path / "two", protocol=str(short), envs=2, workers=1)
    parts = [play(tmp_path / str(n), protocol=str(short), tasks=("select",), shard=f"{n}/2") for n in (0, 1)]
    assert together == alone
    assert {**parts[0], **parts[1]} == {number: alone[number] for number in (2, 3)}
    assert [sorted(part) for part in parts] == [[2], [3]]


def test_a_run_that_was_cut_off_continues_and_ends_the_same(alone, short, tmp_path):
    begun: list[int] = []
    playing = opened(tmp_path, protocol=str(short), envs=1).run(begun.append)
    next(playing)
    assert begun == [4]
    playing.close()
    path = tmp_path / "episodes.jsonl"
    path.write_text(path.read_text() + path.read_text()[:100])  # and killed while it wrote
    with pytest.raises(OutputExistsError, match="policy.name"):
        play(tmp_path, "still", protocol=str(short))
    assert play(tmp_path, protocol=str(short), envs=2) == alone


def test_an_external_loop_has_the_same_outcomes(alone, short):
    policy = make_policy("random")
    settings = EvaluationSettings(protocol=str(short), envs=1, backend="processes")
    session = EvaluationSession(ExternalPolicy(policy.spec), settings)
    for number in (0, 2):
        seed = session.protocol.episodes[number].seed
        policy.reset([EpisodeSpec(0, number, "", "", "", "", seed, "")])
        seen = session.reset([number])
        while seen is not None:
            seen = session.step(policy.act(seen))
        assert session.outcomes[0].without_clock() == alone[number]
    session.close()


def test_the_scripted_policy_succeeds(tmp_path):
    outcome = play(tmp_path, "scripted", protocol="smoke", tasks=("pick",), episodes=1)[0]
    assert outcome["success"] and outcome["success_at_end"] and outcome["success_v0"]
    flags = outcome["flags"]
    assert flags["reached_target"] <= flags["target_lifted"] <= flags["target_in_basket"] <= flags["success"]
    assert outcome["failure_stage"] == ""


def test_the_policy_of_the_docs_sees_what_it_declares(short, tmp_path, monkeypatch, needs_renderer):
    page = (Path(__file__).resolve().parents[2] / "docs" / "evaluation.md").read_text(encoding="utf-8")
    program = page.split("```python\n")[1].split("```")[0]
    program = program.replace("rate_hz=5,", "rate_hz=5, depth=True, state=True, language='text',")
    program = program.replace(
        "        return np.tile",
        """\
        assert observations.depths["gripper_camera"].shape[1:] == (48, 64, 1)
        assert observations.state.shape[1] > 90 and observations.tcp_in_base.shape[1:] == (7,)
        assert all(said.startswith("grasp the ") for said in observations.instructions)
        return np.tile""",
    )
    (tmp_path / "docs_policy.py").write_text(program, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    settings = {"protocol": str(short), "workers": 1, "episodes": 2, "tasks": ("select",)}
    outcomes = play(tmp_path / "out", "docs_policy:Descend", **settings)
    assert len(outcomes) == 2
    assert all(one["measures"]["path_length"] == pytest.approx(0.2, abs=0.02) for one in outcomes.values())
