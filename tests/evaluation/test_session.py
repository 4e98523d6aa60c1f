"""Episodes in an external loop."""

from __future__ import annotations

import numpy as np
import pytest
from counting_env import BREAKS

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation import results
from robocas_ms3.evaluation.policies.plain import RandomPolicy
from robocas_ms3.evaluation.policy import EpisodeSpec, ExternalPolicy, PolicySpec
from robocas_ms3.evaluation.protocol import load_protocol
from robocas_ms3.evaluation.session import EvaluationSession, evaluate
from robocas_ms3.evaluation.settings import EvaluationSettings


def ones(count: int = 1, value: float = 1.0) -> np.ndarray:
    return np.full((1, count, 7), value)


AT_5_HZ = PolicySpec(rate_hz=5)


def open_session(protocol: str = "smoke", spec: PolicySpec = AT_5_HZ, num_envs: int = 1):
    settings = EvaluationSettings(num_envs=num_envs, backend="processes")
    return EvaluationSession(load_protocol(protocol), ExternalPolicy(spec), settings)


@pytest.fixture
def session():
    opened = open_session()
    yield opened
    opened.close()


def test_an_episode_goes_on_until_the_rules_end_it(made, session):
    seen = session.reset([1])
    assert seen.instructions == [load_protocol("smoke").episodes[1].instruction]
    for step in range(4):
        assert session.outcomes == {}
        seen = session.step(ones())
        assert seen is not None and seen.envs.tolist() == [0], step
    assert session.step(ones()) is None
    outcome = session.outcomes[0]
    assert (outcome.episode, outcome.success, outcome.steps, outcome.seconds) == (1, True, 5, 1.0)
    assert outcome.flags["reached_any"] == 2
    assert (outcome.config, outcome.seed, outcome.failure_stage) == ("pick_table_scattered", 110001, "")
    with pytest.raises(EvaluationError, match="no episode is running"):
        session.step(ones())


def test_an_episode_ends_when_its_task_has_no_more_steps(made, session):
    assert [session.max_steps(task) for task in ("pick", "search")] == [200, 600]
    session.reset([0])
    assert session.step(ones(199, 0.0)) is not None
    assert session.step(ones(1, 0.0)) is None
    assert (session.outcomes[0].steps, session.outcomes[0].failure_stage) == (200, "reached_any")


def test_a_chunk_is_played_to_its_end(made, session):
    session.reset([0])
    assert session.step(ones(3)) is not None
    assert session.step(ones(3)) is None
    assert session.outcomes[0].steps == 5


def test_a_reset_drops_the_running_episode(made, session):
    session.reset([0])
    session.step(ones())
    seen = session.reset([1])
    assert session.outcomes == {}
    assert seen.instructions == [load_protocol("smoke").episodes[1].instruction]
    assert session.step(ones(5)) is None
    assert (session.outcomes[0].episode, session.outcomes[0].steps, session.outcomes[0].error) == (1, 5, "")


def test_an_env_stays_as_long_as_its_configuration(made, session):
    for number in (0, 1, 2, 0):
        session.reset([number])
    assert [env.config for env in made] == ["pick_table_scattered", "select_table_orderly", "pick_table_scattered"]
    assert [env.seeds for env in made] == [[110000, 110001], [110000], [110000]]
    assert [env.closed for env in made] == [True, True, False]
    session.close()
    assert made[-1].closed


def test_an_error_of_the_env_is_raised_and_the_next_reset_opens_another(made, session):
    session.reset([0])
    with pytest.raises(RuntimeError, match="the env broke"):
        session.step(ones(1, BREAKS))
    assert session.outcomes == {}
    session.reset([0])
    assert session.step(ones(5)) is None
    assert session.outcomes[0].success
    assert [env.closed for env in made] == [True, False]


def test_actions_of_another_shape_are_refused_and_the_episode_continues(made, session):
    session.reset([0])
    with pytest.raises(EvaluationError, match=r"actions don't fit"):
        session.step(np.zeros((1, 6)))
    assert session.step(ones(5)) is None
    assert session.outcomes[0].steps == 5


def test_each_env_of_a_batch_ends_by_itself(made):
    session = open_session(num_envs=3)
    seen = session.reset([4, 5, 4])
    assert seen.envs.tolist() == [0, 1, 2] and seen.instructions[0] == seen.instructions[2] != seen.instructions[1]
    actions = np.zeros((3, 7))
    actions[:, 0] = 1, 2.5, 1
    seen = session.step(actions)
    actions[2] = np.nan
    seen = session.step(actions)
    assert seen is not None and seen.envs.tolist() == [0]
    assert {env: (one.steps, one.success, one.error) for env, one in session.outcomes.items()} == {
        1: (2, True, ""),
        2: (1, False, "the policy's action is not finite"),
    }
    assert session.step(np.tile(ones(3), (3, 1, 1))) is None
    assert session.outcomes[0].steps == 5
    assert not np.stack(made[0].actions)[2:, 1:].any()  # ended envs are sent zeros
    with pytest.raises(EvaluationError, match="several configurations"):
        session.reset([0, 4, 5])
    with pytest.raises(EvaluationError, match="wrong number of episodes"):
        session.reset([0, 1])


@pytest.mark.parametrize("number", [-1, 8])
def test_an_episode_that_the_protocol_lacks(made, session, number):
    with pytest.raises(EvaluationError, match="no such episode"):
        session.reset([number])


def test_what_does_not_fit_the_protocol_is_refused():
    with pytest.raises(EvaluationError, match="convention is none of this protocol's"):
        open_session("paper-v1", PolicySpec(convention="joint_positions"))


@pytest.mark.slow
def test_real_episodes_come_out_as_in_an_evaluation(tmp_path):
    class Brief(RandomPolicy):
        spec = PolicySpec(reference="tcp", language="none", rate_hz=5)

    protocol = load_protocol("smoke")
    settings = EvaluationSettings("random", 1, "processes", tasks=("pick",), episodes=1)
    list(evaluate(EvaluationSession(protocol, Brief(), settings), tmp_path))
    session, policy = open_session(spec=Brief.spec), RandomPolicy()
    for number, outcome in results.read(tmp_path).outcomes.items():
        seed = protocol.episodes[number].seed
        policy.reset([EpisodeSpec(0, number, "", "", "", "", seed, "")])
        seen = session.reset([number])
        while seen is not None:
            seen = session.step(policy.act(seen))
        assert session.outcomes[0].without_clock() == outcome.without_clock()
        assert outcome.steps > 100
    session.close()
