"""Episodes in an external loop."""

from __future__ import annotations

import numpy as np
import pytest
from counting_env import BREAKS

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation import results
from robocas_ms3.evaluation.harness.driven import DrivenEpisodes
from robocas_ms3.evaluation.policies.plain import RandomPolicy
from robocas_ms3.evaluation.policy import EpisodeSpec, PolicySpec
from robocas_ms3.evaluation.protocol import load_protocol
from robocas_ms3.evaluation.run import Settings, evaluate


def ones(count: int = 1, value: float = 1.0) -> np.ndarray:
    return np.full((1, count, 7), value)


@pytest.fixture
def driven():
    made = DrivenEpisodes(load_protocol("smoke"), PolicySpec(rate_hz=5))
    yield made
    made.close()


def test_an_episode_goes_on_until_the_rules_end_it(made, driven):
    seen = driven.reset([1])
    assert seen.instructions == [load_protocol("smoke").episodes[1].instruction]
    for step in range(4):
        assert driven.outcomes == {}
        seen = driven.step(ones())
        assert seen is not None and seen.envs.tolist() == [0], step
    assert driven.step(ones()) is None
    outcome = driven.outcomes[0]
    assert (outcome.episode, outcome.success, outcome.steps, outcome.seconds) == (1, True, 5, 1.0)
    assert outcome.flags["reached_any"] == 2
    assert (outcome.config, outcome.seed, outcome.failure_stage) == ("pick_table_scattered", 110001, "")
    with pytest.raises(EvaluationError, match="no episode is running"):
        driven.step(ones())


def test_an_episode_ends_when_its_task_has_no_more_steps(made, driven):
    assert [driven.max_steps(task) for task in ("pick", "search")] == [200, 600]
    driven.reset([0])
    assert driven.step(ones(199, 0.0)) is not None
    assert driven.step(ones(1, 0.0)) is None
    assert (driven.outcomes[0].steps, driven.outcomes[0].failure_stage) == (200, "reached_any")


def test_a_chunk_is_played_to_its_end(made, driven):
    driven.reset([0])
    assert driven.step(ones(3)) is not None
    assert driven.step(ones(3)) is None
    assert driven.outcomes[0].steps == 5


def test_a_reset_drops_the_running_episode(made, driven):
    driven.reset([0])
    driven.step(ones())
    seen = driven.reset([1])
    assert driven.outcomes == {}
    assert seen.instructions == [load_protocol("smoke").episodes[1].instruction]
    assert driven.step(ones(5)) is None
    assert (driven.outcomes[0].episode, driven.outcomes[0].steps, driven.outcomes[0].error) == (1, 5, "")


def test_an_env_stays_as_long_as_its_configuration(made, driven):
    for number in (0, 1, 2, 0):
        driven.reset([number])
    assert [env.config for env in made] == ["pick_table_scattered", "select_table_orderly", "pick_table_scattered"]
    assert [env.seeds for env in made] == [[110000, 110001], [110000], [110000]]
    assert [env.closed for env in made] == [True, True, False]
    driven.close()
    assert made[-1].closed


def test_an_error_of_the_env_is_raised_and_the_next_reset_opens_another(made, driven):
    driven.reset([0])
    with pytest.raises(RuntimeError, match="the env broke"):
        driven.step(ones(1, BREAKS))
    assert driven.outcomes == {}
    driven.reset([0])
    assert driven.step(ones(5)) is None
    assert driven.outcomes[0].success
    assert [env.closed for env in made] == [True, False]


def test_actions_of_another_shape_are_refused_and_the_episode_continues(made, driven):
    driven.reset([0])
    with pytest.raises(EvaluationError, match=r"actions don't fit"):
        driven.step(np.zeros((1, 6)))
    assert driven.step(ones(5)) is None
    assert driven.outcomes[0].steps == 5


def test_each_env_of_a_batch_ends_by_itself(made):
    driven = DrivenEpisodes(load_protocol("smoke"), PolicySpec(rate_hz=5), Settings(3, "processes"))
    seen = driven.reset([4, 5, 4])
    assert seen.envs.tolist() == [0, 1, 2] and seen.instructions[0] == seen.instructions[2] != seen.instructions[1]
    actions = np.zeros((3, 7))
    actions[:, 0] = 1, 2.5, 1
    seen = driven.step(actions)
    actions[2] = np.nan
    seen = driven.step(actions)
    assert seen is not None and seen.envs.tolist() == [0]
    assert {env: (one.steps, one.success, one.error) for env, one in driven.outcomes.items()} == {
        1: (2, True, ""),
        2: (1, False, "the policy's action is not finite"),
    }
    assert driven.step(np.tile(ones(3), (3, 1, 1))) is None
    assert driven.outcomes[0].steps == 5
    assert not np.stack(made[0].actions)[2:, 1:].any()  # ended envs are sent zeros
    with pytest.raises(EvaluationError, match="several configurations"):
        driven.reset([0, 4, 5])
    with pytest.raises(EvaluationError, match="wrong number of episodes"):
        driven.reset([0, 1])


@pytest.mark.parametrize("number", [-1, 8])
def test_an_episode_that_the_protocol_lacks(made, driven, number):
    with pytest.raises(EvaluationError, match="no such episode"):
        driven.reset([number])


def test_what_does_not_fit_the_protocol_is_refused():
    with pytest.raises(EvaluationError, match="convention is none of this protocol's"):
        DrivenEpisodes(load_protocol("paper-v1"), PolicySpec(convention="joint_positions"))


@pytest.mark.slow
def test_real_episodes_come_out_as_in_an_evaluation(tmp_path):
    class Brief(RandomPolicy):
        spec = PolicySpec(reference="tcp", language="none", rate_hz=5)

    protocol = load_protocol("smoke")
    settings = Settings(1, "processes", tasks=("pick",), episodes=1)
    list(evaluate(protocol, Brief(), "random", tmp_path, settings))
    driven, policy = DrivenEpisodes(protocol, Brief.spec), RandomPolicy()
    for number, outcome in results.read(tmp_path).outcomes.items():
        seed = protocol.episodes[number].seed
        policy.reset([EpisodeSpec(0, number, "", "", "", "", seed, "")])
        seen = driven.reset([number])
        while seen is not None:
            seen = driven.step(policy.act(seen))
        assert driven.outcomes[0].without_clock() == outcome.without_clock()
        assert outcome.steps > 100
    driven.close()
