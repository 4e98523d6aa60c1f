"""Episodes in somebody else's loop."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from robocas_ms3.errors import EvaluationError
from robocas_ms3.evaluation import results
from robocas_ms3.evaluation.harness.driven import DrivenEpisodes
from robocas_ms3.evaluation.policies.plain import RandomPolicy
from robocas_ms3.evaluation.policy import Start, Wants
from robocas_ms3.evaluation.protocol import load_protocol
from robocas_ms3.evaluation.run import Settings, evaluate


def ones(count: int = 1, value: float = 1.0) -> np.ndarray:
    return np.full((1, count, 7), value)


@pytest.fixture
def driven():
    made = DrivenEpisodes(load_protocol("smoke"), Wants(rate_hz=5))
    yield made
    made.close()
    assert not [thread for thread in threading.enumerate() if thread.name.endswith("(_play)")]


def test_an_episode_goes_on_until_the_rules_end_it(made, driven):
    seen = driven.reset(1)
    assert seen.instructions == [load_protocol("smoke").episodes[1].instruction]
    for step in range(4):
        assert driven.outcome is None
        seen = driven.step(ones())
        assert seen is not None and seen.envs.tolist() == [0], step
    assert driven.step(ones()) is None
    outcome = driven.outcome
    assert outcome is not None
    assert (outcome.episode, outcome.success, outcome.steps, outcome.seconds) == (1, True, 5, 1.0)
    assert outcome.flags["reached_any"] == 2
    assert (outcome.config, outcome.seed, outcome.failure_stage) == ("pick_table_scattered", 110001, "")
    with pytest.raises(EvaluationError, match="no episode plays"):
        driven.step(ones())


def test_an_episode_ends_when_its_task_has_no_more_steps(made, driven):
    assert [driven.max_steps(task) for task in ("pick", "search")] == [200, 600]
    driven.reset(0)
    assert driven.step(ones(199, 0.0)) is not None
    assert driven.step(ones(1, 0.0)) is None
    assert driven.outcome is not None
    assert (driven.outcome.steps, driven.outcome.failure_stage) == (200, "reached_any")


def test_a_chunk_is_played_to_its_end(made, driven):
    driven.reset(0)
    assert driven.step(ones(3)) is not None
    assert driven.step(ones(3)) is None
    assert driven.outcome is not None and driven.outcome.steps == 5


def test_one_that_plays_is_broken_off_by_the_next(made, driven):
    driven.reset(0)
    driven.step(ones())
    seen = driven.reset(1)
    assert driven.outcome is None
    assert seen.instructions == [load_protocol("smoke").episodes[1].instruction]
    assert driven.step(ones(5)) is None
    assert (driven.outcome.episode, driven.outcome.steps, driven.outcome.error) == (1, 5, "")


def test_an_env_stays_as_long_as_its_configuration(made, driven):
    for number in (0, 1, 2, 0):
        driven.reset(number)
    assert [env.config for env in made] == ["pick_table_scattered", "select_table_orderly", "pick_table_scattered"]
    assert [env.seeds for env in made] == [[110000, 110001], [110000], [110000]]
    assert [env.closed for env in made] == [True, True, False]
    driven.close()
    assert made[-1].closed


def test_what_breaks_is_raised_and_the_next_episode_has_another_env(made, driven):
    driven.reset(0)
    with pytest.raises(RuntimeError, match="the env broke"):
        driven.step(ones(1, 13))
    assert driven.outcome is None
    driven.reset(0)
    with pytest.raises(EvaluationError, match=r"actions don't fit"):
        driven.step(np.zeros((1, 6)))
    driven.reset(0)
    assert driven.step(ones(5)) is None
    assert driven.outcome.success
    assert [env.closed for env in made] == [True, True, False]


@pytest.mark.parametrize("number", [-1, 8])
def test_an_episode_that_the_protocol_lacks(made, driven, number):
    with pytest.raises(EvaluationError, match="no such episode"):
        driven.reset(number)


def test_what_does_not_fit_the_protocol_is_refused():
    with pytest.raises(EvaluationError, match="convention is none of this protocol's"):
        DrivenEpisodes(load_protocol("paper-v1"), Wants(convention="joint_positions"))


@pytest.mark.slow
def test_real_episodes_come_out_as_in_an_evaluation(tmp_path):
    class Brief(RandomPolicy):
        wants = Wants(reference="tcp", language="none", rate_hz=5)

    protocol = load_protocol("smoke")
    settings = Settings(1, "processes", tasks=("pick",), episodes=1)
    list(evaluate(protocol, Brief(), "random", tmp_path, settings))
    driven, policy = DrivenEpisodes(protocol, Brief.wants), RandomPolicy()
    for number, outcome in results.read(tmp_path).outcomes.items():
        seed = protocol.episodes[number].seed
        policy.reset([Start(0, number, "", "", "", "", seed, "")])
        seen = driven.reset(number)
        while seen is not None:
            seen = driven.step(policy.act(seen))
        assert driven.outcome is not None
        assert driven.outcome.without_clock() == outcome.without_clock()
        assert outcome.steps > 100
    driven.close()
