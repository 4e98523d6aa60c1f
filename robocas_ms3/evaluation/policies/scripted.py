"""Scripted policy of the demonstrations, as a policy for evaluations: it observes, plans, and plans again."""

from __future__ import annotations

import logging
import math
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.demos.failures import Intervention
from robocas_ms3.demos.generator import EpisodeGenerator, EpisodeLimits
from robocas_ms3.demos.recordings.trajectory_hdf5 import open_episode, open_trajectory, read_steps
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.evaluation.policies.planned_scene import FADE, LIFT, PlannedScene, SceneState, measure_speeds
from robocas_ms3.evaluation.policies.replay import JointTrack, PoseTrack
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec, SimulationState
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.robots.registry import RobotSpec, find_robot

OFFSETS = (0.01, 0.05)  # smallest and largest offset in m: a finger lands on the target or on a neighbouring object
MAX_PLANS, MAX_FAILED_PLANS = 8, 3  # per episode
MAX_LATER_ATTEMPTS = 6  # attempts of each plan after the first one
MAX_HURRY = 2.5  # largest ratio of the speed of the policy to the speed of the plan
MIN_STEPS = 15  # policy steps below which no plan helps
WAIT_SECONDS = 1.0  # s to wait for bodies to come to rest, and for success after the end of a plan
RETRY_SECONDS = 2.0  # s to wait after a failed plan
_END_STEPS = 6  # policy steps that a plan should leave at the end of the episode
MAX_SHIFT = 0.03  # m by which a grasp follows a displaced body
_REST = 0.05  # m/s below which a body is at rest
_FREQ = 20  # Hz, control rate of the plans
_MAX_GENERATORS = 4  # maximum number of open environments
_OFFSET_STREAM = 411  # random stream of the offset
_log = logging.getLogger(__name__)


@dataclass
class _Plan:
    """A planned episode.

    Attributes:
        track: targets, one per policy step.
        scene: expected scene.
        samples: (T + 1,) states of the plan before each of T policy steps and after the last.
        offset: (3,) horizontal displacement of the body that is grasped next or is held, before its grasp, m, world.
    """

    track: JointTrack | PoseTrack
    scene: PlannedScene
    samples: NDArray[np.int64]
    offset: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        self._grasps = self.scene.list_grasps()

    @property
    def is_over(self) -> bool:
        return self.track.step >= len(self.samples) - 1

    def find_deviations(self, robot: RobotSpec, state: SimulationState) -> list[int] | None:
        """Return the deviating bodies; None: none, an empty list: the arm or the gripper command deviates."""
        now, step = SceneState.from_states(robot, state.values), min(self.track.step, len(self.samples) - 1)
        index = int(self.samples[step])
        window = max(_FREQ // 5, int(np.diff(self.samples).max()))
        if (step > 0 and self.scene.closed[index] == (state.gripper > 0)) or self.scene.is_tcp_away(now, index, window):
            return []
        return self.scene.find_deviations(now, index, window) or None

    def next_action(self, observations: Observations, row: int, robot: RobotSpec) -> NDArray[np.floating]:
        """Return the next action (A,); a grasp follows a body that is up to `MAX_SHIFT` away from its planned position.

        The TCP poses are shifted with the body during the approach and the lift.
        """
        track = self.track
        if isinstance(track, JointTrack) or self.is_over or observations.simulation is None:
            return track.next_action(observations, row)
        index = int(self.samples[track.step + 1])
        grasp = next((one for one in self._grasps if index < one.holds + LIFT + FADE), None)
        if grasp is None or (weight := grasp.shift_weight(index)) == 0:
            return track.next_action(observations, row)
        if index <= grasp.closes:
            now = SceneState.from_states(robot, observations.simulation[row].values)
            self.offset = now.bodies[0, grasp.body] - self.scene.states.bodies[index, grasp.body]
            self.offset[2] = 0
        if np.linalg.norm(self.offset) > MAX_SHIFT:
            return track.next_action(observations, row)
        base_to_world = self.scene.states.tcp[index, :3, :3] @ track.poses[track.step, :3, :3].T
        return track.next_action(observations, row, weight * self.offset @ base_to_world)


@dataclass
class _Run:
    """Running episode of an env.

    Attributes:
        plan: present plan; None without one.
        plans: number of plans, also of failed ones.
        failed: number of failed plans.
        attempts: number of attempts of all plans.
        waited: policy steps for which the policy has waited to plan again.
        retry_at: policy step before which the policy does not plan again after a failed plan.
    """

    episode: EpisodeSpec
    plan: _Plan | None = None
    plans: int = 0
    failed: int = 0
    attempts: int = 0
    waited: int = 0
    retry_at: int = 0


class ScriptedPolicy:
    """Policy that plans from privileged state, follows the plan closed loop, and plans again when the scene deviates.

    The scripted policy of `robocas generate` makes the plan in a separate environment. The first plan of an episode
    starts at the reset. A later plan starts from the present state like an expert intervention (`demos.interventions`).
    The policy plans again when the scene is not as the plan expects it (`PlannedScene`), when the plan has ended
    without success, and some time after a failed plan. Without a plan the arm does not move. If a plan has more steps
    than the episode has left, the policy moves faster than the plan. The base of the robot never moves.

    Args:
        convention: ``joint_positions``: joint targets at 20 Hz; ``robocas``: 7-D actions at 5 Hz, relative to the TCP.
        perturbed: whether to shift all TCP poses of an episode by one horizontal offset (`sample_offset`), like a
            policy that misjudges positions, and never to plan again; only with the convention ``robocas``.
        look_ahead: number of candidates that each decision of the plan simulates (`EpisodeLimits`). The policy makes
            one plan per episode in one attempt; if it fails, the arm does not move. None: no such limits.
    """

    def __init__(
        self,
        convention: Literal["joint_positions", "robocas"] = "joint_positions",
        *,
        perturbed: bool = False,
        look_ahead: int | None = None,
    ) -> None:
        self._perturbed, self._rate = perturbed, _FREQ if convention == "joint_positions" else 5
        self._look_ahead, self._plans_once = look_ahead, perturbed or look_ahead is not None
        self.spec = PolicySpec(convention, reference="tcp", rate_hz=self._rate, language="none", simulation_state=True)
        self._runs: dict[int, _Run] = {}  # by env
        self._generators: dict[EpisodeSettings, EpisodeGenerator] = {}  # most recently used last

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        for episode in episodes:
            self._open_generator(episode)
        self._runs |= {episode.env: _Run(episode) for episode in episodes}

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """Return the next action (A,) of each env, (E, A); planning takes several seconds."""
        return np.stack([self._act(observations, row) for row in range(len(observations.envs))])

    def close(self) -> None:
        """Close the environments in which the episodes were planned."""
        for generator in self._generators.values():
            generator.close()

    def _act(self, observations: Observations, row: int) -> NDArray[np.floating]:
        assert observations.simulation is not None
        run, state = self._runs[int(observations.envs[row])], observations.simulation[row]
        decision = self._decide(run, state)
        if decision == "plan":
            self._plan_again(run, state)
        if decision == "wait" or run.plan is None:
            return self._hold(observations, row, state.gripper)
        return run.plan.next_action(observations, row, find_robot(run.episode.robot))

    def _plan_again(self, run: _Run, state: SimulationState) -> None:
        """Replace the plan. If only the time is too short for a new plan, keep the old one, which may still succeed."""
        plan = self._make_plan(run, state)
        run.plans, run.waited = run.plans + 1, 0
        if not isinstance(plan, _Plan):
            run.failed, run.retry_at = run.failed + 1, state.steps + round(RETRY_SECONDS * self._rate)
        if plan != "too_long":
            run.plan = plan if isinstance(plan, _Plan) else None

    def _decide(self, run: _Run, state: SimulationState) -> Literal["follow", "wait", "plan"]:
        """Return whether to follow the plan, to wait until the scene is at rest, or to plan again."""
        left = math.inf if run.episode.max_steps is None else run.episode.max_steps - state.steps
        if run.plans == 0:
            return "plan"
        may_plan = run.plans < MAX_PLANS and run.failed < MAX_FAILED_PLANS and left >= MIN_STEPS
        if self._plans_once or state.succeeded or not may_plan or state.steps < run.retry_at:
            return "follow"
        run.waited += 1
        if run.plan is None or run.plan.is_over:
            return "plan" if run.plan is None or run.waited > WAIT_SECONDS * self._rate else "follow"
        deviations = run.plan.find_deviations(find_robot(run.episode.robot), state)
        if deviations is None:
            run.waited = 0
            return "follow"
        moving = [body for body in deviations if measure_speeds(state.values)[body : body + 1].max(initial=0.0) > _REST]
        return "wait" if moving and run.waited <= WAIT_SECONDS * self._rate else "plan"

    def _hold(self, observations: Observations, row: int, gripper: float) -> NDArray[np.floating]:
        """Return the action (A,) that moves nothing."""
        if self.spec.convention == "joint_positions":
            return np.append(observations.qpos[row, RobotDescription.arm_slice], gripper)
        return np.append(np.zeros(6), float(gripper > 0))

    def _make_plan(self, run: _Run, state: SimulationState) -> _Plan | str:
        """Plan from the reset, or from the present state; return the reason of the last failure if there is no plan."""
        episode, stride = run.episode, _FREQ // self._rate
        left = None if episode.max_steps is None else max(MIN_STEPS, episode.max_steps - state.steps - _END_STEPS)
        after = (
            Intervention(episode.seed, "scripted", state.steps, state.values, state.gripper) if state.steps else None
        )
        with tempfile.TemporaryDirectory() as folder:
            generator = self._open_generator(episode)
            horizon = generator.horizon if left is None else min(generator.horizon, round(left * stride * MAX_HURRY))
            attempts = MAX_LATER_ATTEMPTS if run.plans else generator.settings.max_attempts
            attempts = attempts if self._look_ahead is None else 1
            limits = EpisodeLimits(horizon, attempts, run.attempts, self._look_ahead)
            result = generator.generate(episode.seed, Path(folder), "episode", after, limits)
            run.attempts += attempts
            if not result.success:
                return result.failures[-1].reason
            with open_trajectory(Path(folder) / "episode.h5") as file:
                actions, states = read_steps(open_episode(file, 0))
        robot, gripper = find_robot(episode.robot), actions[:, 7]
        samples = sample_plan(gripper, stride, left)
        scene = PlannedScene(SceneState.from_states(robot, states), np.append(state.gripper, gripper) < 0)
        if self.spec.convention == "joint_positions":
            return _Plan(JointTrack(actions[samples[1:] - 1, :8]), scene, samples)
        track = PoseTrack.from_recording(robot, states["articulations"][robot.description.uid], gripper, samples)
        if self._perturbed:
            track.poses[:, :2, 3] += sample_offset(episode.seed)
        return _Plan(track, scene, samples)

    def _open_generator(self, episode: EpisodeSpec) -> EpisodeGenerator:
        """Return the generator for the configuration of an episode; open it if needed.

        If more than `_MAX_GENERATORS` generators are open, the least recently used one is closed.
        """
        settings = EpisodeSettings(
            episode.task,
            episode.config_file,
            episode.pack,
            control_freq=_FREQ,
            check_rate=0,
            layouts=episode.layouts_file,
            robot=episode.robot,
        )
        generator = self._generators.pop(settings, None) or EpisodeGenerator(settings)
        self._generators[settings] = generator
        if len(self._generators) > _MAX_GENERATORS:
            self._generators.pop(next(iter(self._generators))).close()
        return generator


def sample_plan(gripper: NDArray[np.floating], stride: int, max_steps: int | None) -> NDArray[np.int64]:
    """Return the states (T + 1,) of a plan before and after each of T policy steps, in ascending order.

    They are evenly spaced, with the last states before a change of the gripper command in addition: the arm must have
    arrived before the gripper closes.

    Args:
        gripper: (S,) gripper commands of the plan.
        stride: control steps of the plan per policy step.
        max_steps: number of policy steps that should suffice; the policy then moves up to `MAX_HURRY` times faster.
    """
    steps, changes = len(gripper), np.flatnonzero(np.diff(gripper)) + 1
    count = math.ceil(steps / stride)
    if max_steps is not None:
        count = min(count, max(max_steps - len(changes), math.ceil(count / MAX_HURRY)))
    return np.union1d(np.linspace(0, steps, count + 1).round().astype(np.int64), changes)


def sample_offset(seed: int) -> NDArray[np.floating]:
    """Return the horizontal offset (2,) for the seed of an episode, in m in the frame of the arm's base (`OFFSETS`)."""
    generator = np.random.default_rng([seed, _OFFSET_STREAM])
    angle, distance = generator.uniform(0, 2 * np.pi), generator.uniform(*OFFSETS)
    return distance * np.array([np.cos(angle), np.sin(angle)])
