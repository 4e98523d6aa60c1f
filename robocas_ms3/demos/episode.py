"""One seed to one recorded episode: attempts, undone or kept, until the task succeeds."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

import robocas_ms3.tasks  # noqa: F401  (registers the environments)
from robocas_ms3.config import TaskConfig, load_task_config
from robocas_ms3.demos.ledger import Failure
from robocas_ms3.demos.open_loop import OpenLoop
from robocas_ms3.demos.record import EpisodeRecorder
from robocas_ms3.demos.trials import try_actions
from robocas_ms3.errors import EpisodeLost, LayoutError, PlanningFailed
from robocas_ms3.planning.executor import Executor, Seconds
from robocas_ms3.planning.mplib_backend import MplibPlanner
from robocas_ms3.planning.protocol import Planner
from robocas_ms3.planning.reachability import Reachability
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.retreating import back_out
from robocas_ms3.robots.urdf import robot_files
from robocas_ms3.tasks.base import RoboCASEnv
from robocas_ms3.tasks.spec import TASKS

STANDARD_FREQ = 20  # Hz, at which the tasks' horizons are given

FAR = ("horizon",)  # stages whose failure has its cause farther back than the last checkpoint


@dataclass(frozen=True)
class EpisodeSettings:
    """How episodes are generated; the same for all seeds of a run.

    Attributes:
        task: short name of the task.
        config: name of a shipped configuration, or the whole of one.
        pack: name or folder of the object pack.
        control_freq: Hz.
        max_attempts: attempts a seed has.
        keep_recoveries: leave failed attempts in the record instead of undoing them.
        replay_rate: Hz; an attempt counts only if its own actions, as a dataset of this rate holds them, succeed again
            open loop (`trials`), and none goes beyond [-1, 1]. 0: not tried; nor is it where the base drives, which
            those actions leave out.
    """

    task: str
    config: str | dict[str, Any]
    pack: str
    control_freq: int = STANDARD_FREQ
    max_attempts: int = 20
    keep_recoveries: bool = False
    replay_rate: int = 5


@dataclass
class EpisodeResult:
    """What became of a seed.

    Attributes:
        seed: of the episode.
        success: whether an episode was recorded.
        steps: its length in control steps.
        attempts: attempts used.
        seconds: where the time went.
        failures: every attempt that failed.
    """

    seed: int
    success: bool
    steps: int = 0
    attempts: int = 0
    seconds: Seconds = field(default_factory=Seconds)
    failures: list[Failure] = field(default_factory=list)


class EpisodeGenerator:
    """Makes episodes of one task in one process: holds the environment, the planner and the policy.

    Args:
        settings: the same for all episodes.
    """

    def __init__(self, settings: EpisodeSettings) -> None:
        self.settings = settings
        # On a busy machine the threads of torch's small operations wait for each other, 25 times longer than they work.
        torch.set_num_threads(1)
        config = load_task_config(settings.config)
        self.horizon = horizon(settings.task, settings.control_freq)
        self.env = gym.make(
            TASKS[settings.task].env_id,
            max_episode_steps=self.horizon,
            config=settings.config,
            pack=settings.pack,
            obs_mode="none",
            reward_mode="none",
            control_mode="pd_joint_pos_base" if config.base_motion else "pd_joint_pos",
            render_backend="none",
            sim_config={"control_freq": settings.control_freq},
        )
        base_env = self.env.unwrapped
        assert isinstance(base_env, RoboCASEnv)
        files = robot_files()
        self.planner: Planner = MplibPlanner(str(files.arm_urdf), str(files.arm_srdf), dt=base_env.control_timestep)
        self.reachability = Reachability(str(files.arm_urdf))
        # a scripted policy tries once, from wherever the episode stands, and raises PlanningFailed
        self.policy: Callable[[Arm], None] = import_module(TASKS[settings.task].solver).attempt
        self.open_loop: OpenLoop | None = None
        if settings.replay_rate and not config.base_motion:
            kwargs = {"config": settings.config, "pack": settings.pack}
            self.open_loop = OpenLoop(
                {"env_id": TASKS[settings.task].env_id, "env_kwargs": kwargs}, settings.replay_rate
            )

    def generate(self, seed: int, folder: Path, name: str) -> EpisodeResult:
        """Make the episode of a seed, as ``folder/name.h5`` and ``.json``; no files where every attempt failed.

        The same seed and versions give the same episode, whatever was generated before.
        """
        recorder = EpisodeRecorder(self.env, folder, name)
        executor = Executor(recorder, seed)
        result = EpisodeResult(seed, success=False, seconds=executor.seconds)
        finished = False
        try:
            recoveries = self._attempts(executor, recorder, result)
            if result.success:
                recorder.finish({**self._describe(executor), "attempts": result.attempts, "recoveries": recoveries})
                finished = True
        finally:
            if not finished:
                recorder.discard()
        return result

    def _attempts(self, executor: Executor, recorder: EpisodeRecorder, result: EpisodeResult) -> list[dict[str, Any]]:
        recoveries = []
        try:
            executor.reset()
        except LayoutError as error:
            self._log(result, 0, PlanningFailed("layout", error.what), 0.0)
            return recoveries
        for attempt in range(self.settings.max_attempts):
            result.attempts = attempt + 1
            begun, first = time.perf_counter(), len(executor.actions)
            # seeded by seed and attempt alone: what was planned before must not matter
            entropy = np.random.SeedSequence([executor.seed, attempt])
            self.planner.seed(int(entropy.generate_state(1)[0]))
            arm = Arm(self.planner, self.reachability, executor, np.random.default_rng(entropy), attempt)
            try:
                self.policy(arm)
                self._check(executor, recorder)
                result.success, result.steps = True, len(executor.actions)
                return recoveries
            except PlanningFailed as error:
                self._log(result, attempt, error, time.perf_counter() - begun)
                last = error
            mendable = first < len(executor.actions) < self.horizon and not isinstance(last, EpisodeLost)
            if self.settings.keep_recoveries and mendable:
                try:
                    back_out(arm)
                    recoveries.append(
                        {"range": [first, len(executor.actions) - 1], "stage": last.stage, "reason": last.reason}
                    )
                    continue
                except PlanningFailed:
                    pass
            executor.go_back(far=last.stage in FAR)
            recoveries = [kept for kept in recoveries if kept["range"][1] < len(executor.actions)]
        return recoveries

    def _check(self, executor: Executor, recorder: EpisodeRecorder) -> None:
        """See that what a policy says it has done is a demonstration.

        Raises:
            PlanningFailed: the task has not succeeded.
            EpisodeLost: it took longer than an episode may, or its own actions do not do it again, or not within the
                range of ``pd_ee_delta_pose``.
        """
        if len(executor.actions) > self.horizon:
            raise EpisodeLost("horizon", "too_long")
        if not executor.flag("success"):
            raise PlanningFailed("episode", "no_success")
        if self.open_loop is not None:
            try_actions(self.open_loop, executor, recorder, self.settings.control_freq)

    @staticmethod
    def _log(result: EpisodeResult, attempt: int, error: PlanningFailed, seconds: float) -> None:
        result.failures.append(Failure(result.seed, attempt, error.stage, error.reason, round(seconds, 3)))

    def _describe(self, executor: Executor) -> dict[str, Any]:
        env = executor.base_env
        target = env.target_asset().asset
        bounds = [s.first for s in executor.segments] + [len(executor.actions)]
        said, layout = env.instructions[0], env.layouts[0]
        assert layout is not None  # there was a reset
        return {
            "instruction": said.text,
            "instruction_template": said.template_id,
            "relation": layout.relation,
            "support": env.task_config.support,
            "target": {"slot": int(env.target_slot[0]), "asset_id": target.id, "name": target.name},
            "objects": [asset.asset.id for asset in env.object_assets[0]],
            "subgoals": [
                {
                    "goal_type": segment.goal_type,
                    "goal_description": segment.goal_description,
                    "goal_range": [segment.first, after - 1],
                }
                for segment, after in zip(executor.segments, bounds[1:], strict=True)
            ],
            "replay_rate": self.settings.replay_rate if self.open_loop is not None else None,
            "facts": {"disturbed": int(executor.info["disturbed"][0]), **executor.facts},
            "seconds": {part: round(value, 3) for part, value in asdict(executor.seconds).items()},
        }

    def close(self) -> None:
        """Close the environments."""
        self.env.close()
        if self.open_loop is not None:
            self.open_loop.close()


def horizon(task: str, control_freq: int) -> int:
    """Control steps a demonstration may have: as many seconds as the task allows at the standard rate.

    ``gym.make`` alone allows ``TaskSpec.max_episode_steps`` at any rate.
    """
    return TASKS[task].max_episode_steps * control_freq // STANDARD_FREQ


def recordable_config(config: TaskConfig, name: str | None) -> str | dict[str, Any]:
    """What a record says of its configuration: the name of a shipped one, else the whole of it (no local path)."""
    return name if name is not None else config.model_dump(mode="json")
