"""Generate the episode of a seed: attempts of the scripted policy until the task succeeds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import robocas_ms3.tasks  # noqa: F401  (registers the environments)
from robocas_ms3.core.errors import LayoutError, PlanningError, RobocasError, UnrecoverableError
from robocas_ms3.core.extensions import import_object
from robocas_ms3.demos.backtracking import ResimulatedDecisions
from robocas_ms3.demos.branches import ForkedDecisions
from robocas_ms3.demos.candidates.recorder import CandidateRecorder
from robocas_ms3.demos.candidates.records import candidates_file_name
from robocas_ms3.demos.failures import EpisodeResult, Intervention
from robocas_ms3.demos.forked_processes import find_reason_not_to_fork, warn_cannot_fork
from robocas_ms3.demos.interventions import intervene
from robocas_ms3.demos.open_loop import OpenLoopChecks, OpenLoopEnv
from robocas_ms3.demos.recordings.environment import RecordedEnv
from robocas_ms3.demos.recordings.episode_recorder import EpisodeRecorder
from robocas_ms3.demos.recordings.subgoals import SubGoal
from robocas_ms3.demos.recordings.trajectory_hdf5 import INTENDED_ACTIONS, JOINT_DEVIATIONS
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.planning.action_noise import ActionNoise
from robocas_ms3.planning.decisions import Decisions, IrreversibleDecisions, SearchLimits
from robocas_ms3.planning.executor import MotionExecutor
from robocas_ms3.planning.kinematics import ArmChain, InverseKinematics
from robocas_ms3.planning.protocol import Planner
from robocas_ms3.planning.rrt_connect import make_planner
from robocas_ms3.planning.skills.arm import Arm, recover
from robocas_ms3.robots.registry import DEFAULT_ROBOT, find_robot
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.task_specs import TASKS
from robocas_ms3.tasks.base import RoboCASEnv


@dataclass(frozen=True)
class EpisodeLimits:
    """Limits of an episode.

    Attributes:
        horizon: maximum length of the episode in control steps.
        max_attempts: maximum number of attempts of the scripted policy.
        first_attempt: number of the first attempt; other numbers give other random numbers.
        look_ahead: number of candidates that each decision simulates and compares; the episode continues from the best
            one and never backtracks. 0: no candidate is simulated before it is executed. None: as the scripted policy
            decides, with backtracking.
    """

    horizon: int
    max_attempts: int
    first_attempt: int = 0
    look_ahead: int | None = None


class EpisodeGenerator:
    """Generator of the episodes of one task in one process.

    The generator owns an environment, a motion planner, the scripted policy and the environments of the open-loop
    checks.

    Limit torch to one thread (``torch.set_num_threads``) if several processes generate at once.

    Args:
        settings: settings of all episodes.
        fork: whether to undo failed attempts by forking, if that is safe; the episodes do not depend on it.
    """

    def __init__(self, settings: EpisodeSettings, *, fork: bool = True) -> None:
        self.settings = settings
        config, robot = load_task_config(settings.config), find_robot(settings.robot)
        chosen: dict[str, Any] = {} if settings.robot == DEFAULT_ROBOT else {"robot_uids": settings.robot}
        self.horizon = TASKS[settings.task].horizon_steps(settings.control_freq)
        self.env = gym.make(
            TASKS[settings.task].env_id,
            max_episode_steps=self.horizon,
            config=settings.config,
            pack=settings.pack,
            layouts=settings.layouts,
            **chosen,
            obs_mode="none",
            reward_mode="none",
            control_mode="pd_joint_pos_base" if config.base_motion else "pd_joint_pos",
            render_backend="none",
            sim_config={"control_freq": settings.control_freq},
        )
        base_env = self.env.unwrapped
        assert isinstance(base_env, RoboCASEnv)
        self.planner: Planner = make_planner(settings.planner, robot, dt=base_env.control_timestep)
        self.inverse_kinematics = InverseKinematics(ArmChain(robot.files().arm_urdf, robot.description))
        # runs one attempt from the current state; raises PlanningError if it fails
        self.policy: Callable[[Arm], None] = import_object(TASKS[settings.task].solver)
        self.open_loop_envs: list[OpenLoopEnv] = []
        self.open_loop_checks: OpenLoopChecks | None = None
        if settings.check_rate and not config.base_motion:
            scene = {"config": settings.config, "layouts": settings.layouts, **chosen}
            env = RecordedEnv(TASKS[settings.task].env_id, None, scene).with_pack(settings.pack)
            self.open_loop_envs = [OpenLoopEnv(env, settings.check_rate) for _ in range(1 + settings.check_trials)]
            self.open_loop_checks = OpenLoopChecks(self.open_loop_envs, settings)
        self._fork = fork and not settings.keep_recoveries
        reason = find_reason_not_to_fork(renders=base_env.scene.can_render())
        if settings.record_candidates and (reason or not self._fork):
            raise RobocasError(
                "candidates can be recorded only with forked processes",
                where="--record-candidates",
                found=reason or "--no-fork",
                fix="Use Linux and CPU physics, without --no-fork. If CUDA is in use, pass --jobs 1 or more.",
                usage=True,
            )
        if self._fork and reason:
            warn_cannot_fork(reason)
            self._fork = False

    def generate(
        self,
        seed: int,
        folder: Path,
        name: str,
        intervention: Intervention | None = None,
        limits: EpisodeLimits | None = None,
    ) -> EpisodeResult:
        """Generate the episode of a seed, and write it if an attempt succeeds.

        The episode depends only on the arguments, the settings and the package versions.

        Args:
            seed: seed of the episode.
            folder: folder of the files ``name.h5`` and ``name.json``, and of the candidates' file.
            name: name of the files without suffix.
            intervention: state in which another policy left the scene; the episode starts in this state.
            limits: limits of this episode; None: the horizon of the task and the attempts of the settings.
        """
        limits = limits or EpisodeLimits(self.horizon, self.settings.max_attempts)
        recorder = EpisodeRecorder(self.env, folder, name)
        executor = MotionExecutor(recorder, seed, noise=self._make_noise())
        result = EpisodeResult(
            seed,
            success=False,
            seconds=executor.seconds,
            experience=executor.experience,
            max_attempts=limits.max_attempts,
        )
        candidates = CandidateRecorder(self.settings, self.env, folder / candidates_file_name(name), result)
        attempts = _Attempts(self, recorder, executor, result, intervention, candidates)
        attempts.limits = limits
        executor.check_open_loop = attempts.check_open_loop
        try:
            if intervention is not None and intervention.skip_reason:
                raise UnrecoverableError("intervention", intervention.skip_reason)
            if self.settings.keep_recoveries:
                attempts.run_in_one_recording()
            elif limits.look_ahead == 0:
                attempts.run_once()
            else:
                attempts.run_from_resets(ForkedDecisions(result) if self._fork else ResimulatedDecisions(result))
        except LayoutError as error:
            result.add_failure(PlanningError("layout", error.what))
        except UnrecoverableError as error:  # of an intervention; those of attempts are handled there
            result.add_failure(error)
        result.attempts = len(result.failures) + result.success
        if result.decisions and not result.success:
            candidates.write(recorder.env_info())
        result.decisions = []  # they are in their file
        return result

    def _make_noise(self) -> ActionNoise | None:
        settings, base_env = self.settings, self.env.unwrapped
        assert isinstance(base_env, RoboCASEnv)
        if not settings.has_action_noise:
            return None
        drive = base_env.agent.arm_drive
        # within a simulation step, the target is that of the end of this step
        lag = drive["damping"] / drive["stiffness"] - 0.5 / base_env.sim_freq
        return ActionNoise(self.inverse_kinematics.chain, settings.action_noise, settings.control_freq, lag)

    def close(self) -> None:
        self.env.close()
        for env in self.open_loop_envs:
            env.close()


@dataclass
class _Attempts:
    generator: EpisodeGenerator
    recorder: EpisodeRecorder
    executor: MotionExecutor
    result: EpisodeResult
    intervention: Intervention | None
    candidates: CandidateRecorder
    limits: EpisodeLimits = field(init=False)

    def run_from_resets(self, decisions: ForkedDecisions | ResimulatedDecisions) -> None:
        """Run attempts with backtracking, each from the reset, until one succeeds or none is left."""
        while not self.result.has_no_attempts_left:
            number = len(self.result.failures)

            def attempt(number: int = number) -> None:
                self._reset()
                self._run_policy(self._make_arm(decisions, number))
                self._finish([])

            if decisions.run(attempt):
                return

    def run_once(self) -> None:
        """Run one attempt in which no motion is undone."""
        self._reset()
        try:
            self._run_policy(self._make_arm(IrreversibleDecisions(lambda: len(self.executor.actions)), 0))
            self._finish([])
        except PlanningError as error:
            self.result.add_failure(error)

    def run_in_one_recording(self) -> None:
        """Run attempts in one continuous recording; start from the reset again if a recovery is impossible."""
        executor, result = self.executor, self.result
        decisions = IrreversibleDecisions(lambda: len(executor.actions))
        recoveries: list[dict[str, Any]] = []
        self._reset()
        while not result.has_no_attempts_left:
            first = len(executor.actions)
            arm = self._make_arm(decisions, len(result.failures))
            try:
                if first:
                    self.generator.policy(arm)
                else:
                    self._run_policy(arm)
                self._finish(recoveries)
                return
            except PlanningError as error:
                result.add_failure(error)
                last = error
            try:
                if not first < len(executor.actions) < self.limits.horizon or isinstance(last, UnrecoverableError):
                    raise last
                recover(arm)
                span = [first, len(executor.actions) - 1]
                recoveries.append({"range": span, "stage": last.stage, "reason": last.reason})
            except PlanningError:
                recoveries = []
                self._reset()

    def _make_arm(self, decisions: Decisions, number: int) -> Arm:
        path, look_ahead = (self.limits.first_attempt + number,), self.limits.look_ahead
        arm = Arm(self.generator.planner, self.generator.inverse_kinematics, self.executor, decisions, path)
        arm.search_limits = SearchLimits(look_ahead, 1) if look_ahead else None
        if self.generator.settings.record_candidates:
            self.candidates.observe(arm)
        return arm

    def _run_policy(self, arm: Arm) -> None:
        if self.intervention is None:
            self.generator.policy(arm)
        else:
            intervene(arm, self.generator.policy)

    def _reset(self) -> None:
        self.executor.reset()
        with self.executor.seconds.measure("reset"):
            if self.intervention is not None:
                self.recorder.start_at(self.intervention.state)
                self.executor.info = self.executor.base_env.get_info()
                self.executor.gripper = self.intervention.gripper
            if self.generator.open_loop_checks is not None:
                self.generator.open_loop_checks.reset(self.executor.seed, self.intervention)

    def check_open_loop(self, *, finished: bool = False) -> None:
        result = self.result
        if self.generator.open_loop_checks is not None:
            gripper = np.array([action[7] for action in self.executor.actions])
            with self.executor.seconds.measure("check"):
                noise_failure = self.generator.open_loop_checks.check(
                    self.recorder.states, gripper, finished=finished, noise=result.noise_checked
                )
            if noise_failure:
                allowed = self.generator.settings.check_failures
                assert allowed is not None  # set by the settings
                if result.noise_failure_count < allowed:
                    raise UnrecoverableError("open_loop_check", noise_failure)
                result.noise_checked = False

    def _finish(self, recoveries: list[dict[str, Any]]) -> None:
        if len(self.executor.actions) > self.limits.horizon:
            raise UnrecoverableError("episode", "too_long")
        if not self.executor.is_flag_set("success"):
            raise PlanningError("episode", "no_success")
        self.check_open_loop(finished=True)
        self.result.success, self.result.steps = True, len(self.executor.actions)
        if self.generator.settings.record_candidates:  # first, since an episode with its trajectory is complete
            self.candidates.write(self.recorder.env_info())
        self.recorder.finish(self._describe(recoveries), self._noise_arrays())

    def _noise_arrays(self) -> dict[str, NDArray[np.float32]]:
        executor = self.executor
        if executor.noise is None:
            return {}
        arrays = {INTENDED_ACTIONS: executor.actions, JOINT_DEVIATIONS: executor.deviations}
        return {name: np.array(rows, np.float32) for name, rows in arrays.items()}

    def _describe(self, recoveries: list[dict[str, Any]]) -> dict[str, Any]:
        executor, settings, checked = (
            self.executor,
            self.generator.settings,
            self.generator.open_loop_checks is not None,
        )
        env, intervention = executor.base_env, self.intervention
        target = env.target_asset().asset
        if intervention is not None:
            executor.segments[0].first = 0  # the first sub-goal includes the retreat before it
        bounds = [segment.first for segment in executor.segments] + [len(executor.actions)]
        instruction, layout = env.instruction(), env.layout()
        assert layout is not None  # set by the reset
        return {
            "instruction": instruction.text,
            "instruction_template": instruction.template_id,
            "relation": layout.relation,
            "support": env.task_config.support,
            "target": {"slot": int(env.target_slot[0]), "asset_id": target.id, "name": target.name},
            "objects": [asset.asset.id for asset in env.object_assets[0]],
            "subgoals": [
                SubGoal.from_range(segment.goal_type, segment.goal_description, segment.first, end - 1).model_dump()
                for segment, end in zip(executor.segments, bounds[1:], strict=True)
            ],
            "check_rate": settings.check_rate if checked else None,
            "facts": {"disturbed": int(executor.info["disturbed"][0]), **executor.facts},
            "seconds": {
                phase: round(value, 3)
                for phase, value in asdict(executor.seconds).items()
                if phase != "candidates" or settings.record_candidates
            },
            "attempts": len(self.result.failures) + 1,
            "failed_attempts": [f"{failure.stage}: {failure.reason}" for failure in self.result.failures],
            "check_trials": None if not checked else settings.check_trials if self.result.noise_checked else 0,
            "recoveries": recoveries,
            **(
                {"intervention": {"policy": intervention.policy, "policy_steps": intervention.policy_steps}}
                if intervention
                else {}
            ),
            **({"action_noise": list(settings.action_noise)} if settings.has_action_noise else {}),
        }
