"""Episodes run with a policy, several envs at a time."""

from __future__ import annotations

import numpy as np
import pytest
from counting_env import CountingEnv, run_policy

from robocas_ms3.core.errors import EvaluationError, PolicyError
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.rollouts.rollout import EndConditions, EpisodeBatch, run_rollouts


class CountingPolicy:
    """Policy that acts for the number of steps in its instruction, in chunks, and records its inputs."""

    spec = PolicySpec(state=True)

    def __init__(self, chunk: int = 1) -> None:
        self.chunk, self.asked = chunk, []

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        pass

    def act(self, observations: Observations) -> np.ndarray:
        assert observations.state is not None
        for env, said, seed in zip(observations.envs, observations.instructions, observations.state[:, 0], strict=True):
            assert said == f"count to {seed:.0f}", env  # instruction of the episode of this env
        self.asked.append(observations.envs.tolist())
        actions = np.zeros((len(observations.envs), self.chunk, 7))
        actions[..., 0] = 1
        return actions[:, 0] if self.chunk == 1 else actions


def starts(*seeds: int) -> list[EpisodeSpec]:
    return [EpisodeSpec(-1, i, "pick", "", "", "", seed, f"count to {seed}") for i, seed in enumerate(seeds)]


@pytest.mark.parametrize("count", [1, 2, 4])
@pytest.mark.parametrize("refill", [True, False])
def test_every_episode_runs_once_with_its_own_instruction(count, refill):
    env, policy = CountingEnv(count, None), CountingPolicy()
    ended = run_policy(env, policy, starts(3, 9, 2, 5, 4, 1), 7, refill=refill)
    assert sorted(one.spec.episode for one in ended) == list(range(6))
    for one in ended:
        seed = one.spec.seed
        assert one.steps == min(seed, 7)
        assert one.seconds == pytest.approx(0.05 * one.steps)
        assert one.flags["success"] == (seed if seed <= 7 else None)
        assert one.at_end["success"] == (seed <= 7)
        assert one.flags["fail"] is None
    if not refill and count == 4:
        assert [len(envs) for envs in env.resets] == [4, 4]  # four, then two episodes
        assert policy.asked[3] == [1, 3]  # ended envs are not observed


def test_all_actions_of_a_chunk_are_executed_before_the_next_call_of_the_policy():
    policy = CountingPolicy(chunk=3)
    ended = run_policy(CountingEnv(2, None), policy, starts(4, 7), 7)
    assert {one.spec.seed: one.steps for one in ended} == {4: 4, 7: 7}
    assert policy.asked == [[0, 1], [0, 1], [1]]


class LookingPolicy(CountingPolicy):
    """Policy with a camera that requests images of env 1 only; it records the mean pixel and depth of each env."""

    spec = PolicySpec(state=True, cameras={"base_camera": (6, 4)}, depth=True)

    def __init__(self, chunk: int = 1) -> None:
        super().__init__(chunk)
        self.pixels, self.depths = [], []

    def requests_images(self, envs: np.ndarray) -> np.ndarray:
        return envs == 1

    def act(self, observations: Observations) -> np.ndarray:
        self.pixels.append(observations.images["base_camera"].mean((1, 2, 3)).tolist())
        self.depths.append(observations.depths["base_camera"].mean((1, 2, 3)).tolist())
        assert observations.images["base_camera"].shape[1:] == (4, 6, 3)
        return super().act(observations)


def test_only_requested_images_are_rendered():
    env, policy = CountingEnv(2, None), LookingPolicy()
    run_policy(env, policy, starts(2, 3), 7)
    # episodes are assigned to envs in order: env 0 counts to 2, env 1 to 3
    assert env.rendered == [[1], [1], [1]]
    assert policy.pixels == [[0, 1], [0, 2], [3]]
    assert policy.depths == [[0, 100], [0, 200], [300]]


def test_nothing_is_rendered_between_the_starts_of_chunks():
    env, policy = CountingEnv(2, None), LookingPolicy(chunk=3)
    policy.requests_images = lambda envs: np.ones(len(envs), bool)
    run_policy(env, policy, starts(4, 4), 7)
    assert env.rendered == [[0, 1], [0, 1]]
    assert policy.pixels == [[1, 1], [4, 4]]


def test_without_requests_images_each_observation_has_images():
    class AlwaysLookingPolicy(LookingPolicy):
        requests_images = None

    env, policy = CountingEnv(1, None), AlwaysLookingPolicy()
    run_policy(env, policy, starts(2), 7)
    assert (env.rendered, policy.pixels) == ([[0], [0]], [[1], [2]])


@pytest.mark.parametrize("found", [[True], [1, 0], "yes"])
def test_image_requests_of_another_shape_or_type_are_refused(found):
    policy = LookingPolicy()
    policy.requests_images = lambda envs: found
    with pytest.raises(EvaluationError) as error:
        run_policy(CountingEnv(2, None), policy, starts(4, 4), 7)
    assert (error.value.expected, "LookingPolicy, requests_images()" in error.value.where) == ("(2,) bool", True)


@pytest.mark.parametrize("fails", [True, False])
def test_policy_error_or_nan_action_ends_only_its_episode(fails):
    policy = CountingPolicy()
    act = policy.act

    def sick(observations: Observations) -> np.ndarray:
        actions, ill = act(observations), np.array(observations.instructions) == "count to 4"
        actions[ill] = np.nan
        if fails and ill.any():
            raise PolicyError({int(env): "no plan" for env in observations.envs[ill]}, actions)
        return actions

    policy.act = sick
    ended = sorted(run_policy(CountingEnv(2, None), policy, starts(4, 5, 3), 7), key=lambda one: one.spec.seed)
    error = "no plan" if fails else "NaN or infinite action of the policy"
    assert [(one.error, one.steps) for one in ended] == [("", 3), (error, 0), ("", 5)]
    outcome = ended[1].make_outcome(load_protocol("smoke").episodes[0], ())
    assert (outcome.success, outcome.failure_stage, outcome.error) == (False, "error", error)


class SimulationEnv(CountingEnv):
    """Envs whose observations have a state of the simulation: the elapsed steps, and the number of the env."""

    def _observation(self):
        envs = np.arange(self.num_envs)
        values = {"actors": {"apple": np.stack([self.elapsed, envs], axis=1)}}
        return {**super()._observation(), "simulation": {"values": values, "gripper": 1.0 - 2.0 * envs}}


def test_each_env_observes_its_own_simulation_state():
    """Env 0 counts to 3, env 1 to 1, after which it has succeeded but continues."""
    env, seen = SimulationEnv(2, None), []

    class Watching(CountingPolicy):
        spec = PolicySpec(state=True, simulation_state=True)

        def act(self, observations: Observations) -> np.ndarray:
            seen.append(dict(zip(observations.envs.tolist(), observations.simulation, strict=True)))
            return super().act(observations)

    batch = EpisodeBatch(env, Watching.spec, EndConditions(3, ends_on=()), 0.05, refill=True)
    list(run_rollouts(batch, Watching(), starts(1, 3)))
    last = seen[2]
    assert [last[env].values["actors"]["apple"].tolist() for env in (0, 1)] == [[[2, 0]], [[2, 1]]]
    assert [last[env].gripper for env in (0, 1)] == [1, -1]
    assert [last[env].steps for env in (0, 1)] == [2, 2]
    assert sorted(last[env].succeeded for env in (0, 1)) == [False, True]


def test_actions_of_another_shape_are_refused():
    policy = CountingPolicy()
    policy.act = lambda observations: np.zeros((2, 6))
    with pytest.raises(EvaluationError) as error:
        run_policy(CountingEnv(1, None), policy, starts(4), 7)
    assert error.value.expected == "numbers of shape (1, 7) or (1, H, 7)"
    assert error.value.where == f"{__name__}:CountingPolicy"
