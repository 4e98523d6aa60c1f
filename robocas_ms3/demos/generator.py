"""One seed to one recorded episode: attempts, undone or kept, until the task succeeds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import robocas_ms3.tasks  # noqa: F401  (registers the environments)
from robocas_ms3.core.errors import LayoutError, PlanningError, UnrecoverableError
from robocas_ms3.core.extensions import load_object
from robocas_ms3.demos.backtracking import Resimulation
from robocas_ms3.demos.branches import ForkedBranches, say_once, why_not_fork
from robocas_ms3.demos.failures import EpisodeResult, Takeover
from robocas_ms3.demos.interventions import complete
from robocas_ms3.demos.open_loop import OpenLoop, Trials
from robocas_ms3.demos.recordings.environment import RecordedEnv
from robocas_ms3.demos.recordings.episode_recorder import EpisodeRecorder
from robocas_ms3.demos.recordings.subgoals import SubGoal
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.planning.decisions import Decisions, StraightDecisions
from robocas_ms3.planning.executor import Executor
from robocas_ms3.planning.kinematics import ArmChain, Reachability
from robocas_ms3.planning.protocol import Planner
from robocas_ms3.planning.rrt_connect import make_planner
from robocas_ms3.planning.skills.arm import Arm, back_out
from robocas_ms3.robots.registry import DEFAULT, find_robot
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.task_specs import TASKS
from robocas_ms3.tasks.base import RoboCASEnv


class EpisodeGenerator:
    """Makes episodes of one task in one process: holds the environment, the planner and the policy.

    Next to other processes it needs one thread of torch (``torch.set_num_threads``).

    Args:
        settings: the same for all episodes.
        fork: undo failed attempts by forking where that is safe; the episodes are the same without.
    """

    def __init__(self, settings: EpisodeSettings, *, fork: bool = True) -> None:
        self.settings = settings
        config, robot = load_task_config(settings.config), find_robot(settings.robot)
        chosen: dict[str, Any] = {} if settings.robot == DEFAULT else {"robot_uids": settings.robot}
        self.horizon = TASKS[settings.task].steps(settings.control_freq)
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
        self.reachability = Reachability(ArmChain(robot.files().arm_urdf, robot.description))
        # a scripted policy tries once, from wherever the episode stands, and raises PlanningError
        self.policy: Callable[[Arm], None] = load_object(TASKS[settings.task].solver)
        self.worlds: list[OpenLoop] = []
        self.trials: Trials | None = None
        if settings.check_rate and not config.base_motion:
            scene = {"config": settings.config, "layouts": settings.layouts, **chosen}
            env = RecordedEnv(TASKS[settings.task].env_id, None, scene).with_pack(settings.pack)
            self.worlds = [OpenLoop(env, settings.check_rate) for _ in range(1 + settings.check_trials)]
            self.trials = Trials(self.worlds, settings)
        self._fork = fork and not settings.keep_recoveries
        reason = why_not_fork(renders=base_env.scene.can_render())
        if self._fork and reason:
            say_once(reason)
            self._fork = False

    def generate(self, seed: int, folder: Path, name: str, takeover: Takeover | None = None) -> EpisodeResult:
        """Make the episode of a seed, as ``folder/name.h5`` and ``.json``; no files where every attempt failed.

        The same seed and versions give the same episode, whatever was generated before. With a takeover, the episode
        begins where another policy was in this scene.
        """
        recorder = EpisodeRecorder(self.env, folder, name)
        executor = Executor(recorder, seed)
        result = EpisodeResult(seed, success=False, seconds=executor.seconds, max_attempts=self.settings.max_attempts)
        attempts = _Attempts(self, recorder, executor, result, takeover)
        executor.rehearse = attempts.rehearse
        try:
            if takeover is not None and takeover.refused:
                raise UnrecoverableError("takeover", takeover.refused)
            if self.settings.keep_recoveries:
                attempts.make_in_one_motion()
            else:
                attempts.make_from_resets(ForkedBranches(result) if self._fork else Resimulation(result))
        except LayoutError as error:
            result.failed(PlanningError("layout", error.what))
        except UnrecoverableError as error:  # of a takeover; those of attempts are dealt with there
            result.failed(error)
        result.attempts = len(result.failures) + result.success
        return result

    def close(self) -> None:
        self.env.close()
        for world in self.worlds:
            world.close()


@dataclass
class _Attempts:
    generator: EpisodeGenerator
    recorder: EpisodeRecorder
    executor: Executor
    result: EpisodeResult
    takeover: Takeover | None

    def make_from_resets(self, decisions: ForkedBranches | Resimulation) -> None:
        """Make attempts, each from the reset; within them decisions are made otherwise."""
        while not self.result.exhausted:
            number = len(self.result.failures)

            def attempt(number: int = number) -> None:
                self._reset()
                self._play(self._arm(decisions, number))
                self._finish([])

            if decisions.run(attempt):
                return

    def make_in_one_motion(self) -> None:
        """Make attempts one after the other in one motion, as long as failures can be repaired."""
        executor, result = self.executor, self.result
        decisions = StraightDecisions(lambda: len(executor.actions))
        recoveries: list[dict[str, Any]] = []
        self._reset()
        while not result.exhausted:
            first = len(executor.actions)
            arm = self._arm(decisions, len(result.failures))
            try:
                if first:
                    self.generator.policy(arm)
                else:
                    self._play(arm)
                self._finish(recoveries)
                return
            except PlanningError as error:
                result.failed(error)
                last = error
            try:
                if not first < len(executor.actions) < self.generator.horizon or isinstance(last, UnrecoverableError):
                    raise last
                back_out(arm)
                span = [first, len(executor.actions) - 1]
                recoveries.append({"range": span, "stage": last.stage, "reason": last.reason})
            except PlanningError:
                recoveries = []
                self._reset()

    def _arm(self, decisions: Decisions, number: int) -> Arm:
        return Arm(self.generator.planner, self.generator.reachability, self.executor, decisions, (number,))

    def _play(self, arm: Arm) -> None:
        if self.takeover is None:
            self.generator.policy(arm)
        else:
            complete(arm, self.generator.policy)

    def _reset(self) -> None:
        self.executor.reset()
        with self.executor.seconds.spent_on("reset"):
            if self.takeover is not None:
                self.recorder.begin_at(self.takeover.state)
                self.executor.info = self.executor.base_env.get_info()
                self.executor.gripper = self.takeover.gripper
            if self.generator.trials is not None:
                self.generator.trials.reset(self.executor.seed, self.takeover)

    @property
    def _noisy(self) -> bool:
        return self.result.noise_failures < self.generator.settings.check_failures

    def rehearse(self, *, finished: bool = False) -> None:
        if self.generator.trials is not None:
            gripper = np.array([action[7] for action in self.executor.actions])
            with self.executor.seconds.spent_on("check"):
                self.generator.trials.follow(self.recorder.states, gripper, finished=finished, noisy=self._noisy)

    def _finish(self, recoveries: list[dict[str, Any]]) -> None:
        if len(self.executor.actions) > self.generator.horizon:
            raise UnrecoverableError("horizon", "too_long")
        if not self.executor.flag("success"):
            raise PlanningError("episode", "no_success")
        self.rehearse(finished=True)
        self.result.success, self.result.steps = True, len(self.executor.actions)
        self.recorder.finish(self._describe(recoveries))

    def _describe(self, recoveries: list[dict[str, Any]]) -> dict[str, Any]:
        executor, settings, tried = self.executor, self.generator.settings, self.generator.trials is not None
        env, taken = executor.base_env, self.takeover
        target = env.target_asset().asset
        if taken is not None:
            executor.segments[0].first = 0  # what freed the way to it is part of it
        bounds = [part.first for part in executor.segments] + [len(executor.actions)]
        said, layout = env.instruction(), env.layout()
        assert layout is not None  # there was a reset
        return {
            "instruction": said.text,
            "instruction_template": said.template_id,
            "relation": layout.relation,
            "support": env.task_config.support,
            "target": {"slot": int(env.target_slot[0]), "asset_id": target.id, "name": target.name},
            "objects": [asset.asset.id for asset in env.object_assets[0]],
            "subgoals": [
                SubGoal.of(part.goal_type, part.goal_description, part.first, after - 1).model_dump()
                for part, after in zip(executor.segments, bounds[1:], strict=True)
            ],
            "check_rate": settings.check_rate if tried else None,
            "facts": {"disturbed": int(executor.info["disturbed"][0]), **executor.facts},
            "seconds": {part: round(value, 3) for part, value in asdict(executor.seconds).items()},
            "attempts": len(self.result.failures) + 1,
            "failed_attempts": [f"{failure.stage}: {failure.reason}" for failure in self.result.failures],
            "check_trials": None if not tried else settings.check_trials if self._noisy else 0,
            "recoveries": recoveries,
            **({"takeover": {"policy": taken.policy, "policy_steps": taken.policy_steps}} if taken else {}),
        }
