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
from robocas_ms3.demos.branches import ForkedBranches
from robocas_ms3.demos.forking import say_once, why_not_fork
from robocas_ms3.demos.ledger import Failure
from robocas_ms3.demos.open_loop import Noise, OpenLoop
from robocas_ms3.demos.resimulation import Resimulation
from robocas_ms3.demos.trials import NOISY, Trials
from robocas_ms3.errors import EpisodeLost, LayoutError, PlanningFailed
from robocas_ms3.planning.backends import DEFAULT, make_planner
from robocas_ms3.planning.decisions import Straight
from robocas_ms3.planning.executor import Executor, Seconds
from robocas_ms3.planning.protocol import Planner
from robocas_ms3.planning.reachability import Reachability
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.retreating import back_out
from robocas_ms3.recordings.environment import RecordedEnv
from robocas_ms3.recordings.motion import sample_stride
from robocas_ms3.recordings.writing import EpisodeRecorder
from robocas_ms3.robots.urdf import robot_files
from robocas_ms3.tasks.base import RoboCASEnv
from robocas_ms3.tasks.spec import TASKS

STANDARD_FREQ = 20  # Hz, at which the tasks' horizons are given


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
        noisy_trials: how often they are tried with noise, besides once without.
        noisy_failures: attempts that may fail for noise alone; after so many an episode counts without, and says so.
        noise_mm: its standard deviation, of each component of each action's translation, mm.
        noise_deg: the same of its Euler angles.
        layouts: where layouts come from, see ``RoboCASEnv``.
    """

    task: str
    config: str | dict[str, Any]
    pack: str
    control_freq: int = STANDARD_FREQ
    max_attempts: int = 20
    keep_recoveries: bool = False
    replay_rate: int = 5
    noisy_trials: int = 1
    noisy_failures: int = 1
    noise_mm: float = 0.5
    noise_deg: float = 0.2
    layouts: str = "auto"


@dataclass
class EpisodeResult:
    """What became of a seed; processes that branch off hand it on (`branches.Tally`).

    Attributes:
        seed: of the episode.
        success: whether an episode was recorded.
        steps: its length in control steps.
        attempts: attempts used.
        seconds: where the time went.
        failures: every attempt that failed.
        max_attempts: after so many the seed is given up.
        begun: when the attempt did, s of the clock.
    """

    seed: int
    success: bool
    steps: int = 0
    attempts: int = 0
    seconds: Seconds = field(default_factory=Seconds)
    failures: list[Failure] = field(default_factory=list)
    max_attempts: int = 1
    begun: float = field(default_factory=time.perf_counter)

    @property
    def noisy_failures(self) -> int:
        """How many attempts failed for noise alone."""
        return sum(failure.reason.startswith(NOISY) for failure in self.failures)

    @property
    def exhausted(self) -> bool:
        """Whether the seed is given up."""
        return len(self.failures) >= self.max_attempts

    def failed(self, error: PlanningFailed) -> None:
        """Note a failed attempt."""
        now = time.perf_counter()
        self.failures.append(
            Failure(self.seed, len(self.failures), error.stage, error.reason, round(now - self.begun, 3))
        )
        self.begun = now

    def adopt(self, other: EpisodeResult) -> None:
        """Become what another process sent."""
        vars(self.seconds).update(vars(other.seconds))  # the executor counts on in these
        vars(self).update({key: value for key, value in vars(other).items() if key != "seconds"})


class EpisodeGenerator:
    """Makes episodes of one task in one process: holds the environment, the planner and the policy.

    Args:
        settings: the same for all episodes.
        fork: undo what fails by forking where that is safe; the episodes are the same without.
    """

    def __init__(self, settings: EpisodeSettings, *, fork: bool = True) -> None:
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
            layouts=settings.layouts,
            obs_mode="none",
            reward_mode="none",
            control_mode="pd_joint_pos_base" if config.base_motion else "pd_joint_pos",
            render_backend="none",
            sim_config={"control_freq": settings.control_freq},
        )
        base_env = self.env.unwrapped
        assert isinstance(base_env, RoboCASEnv)
        files = robot_files()
        self.planner: Planner = make_planner(DEFAULT, files.arm_urdf, files.arm_srdf, dt=base_env.control_timestep)
        self.reachability = Reachability(str(files.arm_urdf))
        # a scripted policy tries once, from wherever the episode stands, and raises PlanningFailed
        self.policy: Callable[[Arm], None] = import_module(TASKS[settings.task].solver).attempt
        self.worlds: list[OpenLoop] = []
        self.trials: Trials | None = None
        if settings.replay_rate and not config.base_motion:
            scene = {"config": settings.config, "layouts": settings.layouts}
            env = RecordedEnv(TASKS[settings.task].env_id, None, scene).with_pack(settings.pack)
            self.worlds = [OpenLoop(env, settings.replay_rate) for _ in range(1 + settings.noisy_trials)]
            noise = Noise(settings.noise_mm / 1000, float(np.deg2rad(settings.noise_deg)))
            stride = sample_stride(settings.control_freq, settings.replay_rate)
            self.trials = Trials(self.worlds, noise, stride)
        self._fork = fork and not settings.keep_recoveries
        reason = why_not_fork(renders=base_env.scene.can_render())
        if self._fork and reason:
            say_once(reason)
            self._fork = False

    def generate(self, seed: int, folder: Path, name: str) -> EpisodeResult:
        """Make the episode of a seed, as ``folder/name.h5`` and ``.json``; no files where every attempt failed.

        The same seed and versions give the same episode, whatever was generated before.
        """
        recorder = EpisodeRecorder(self.env, folder, name)
        executor = Executor(recorder, seed)
        result = EpisodeResult(seed, success=False, seconds=executor.seconds, max_attempts=self.settings.max_attempts)
        executor.rehearse = lambda: self._rehearse(executor, recorder, result)
        try:
            if self.settings.keep_recoveries:
                self._keep_trying(executor, recorder, result)
            else:
                self._try_again(executor, recorder, result)
        except LayoutError as error:
            result.failed(PlanningFailed("layout", error.what))
        result.attempts = len(result.failures) + result.success
        return result

    def _try_again(self, executor: Executor, recorder: EpisodeRecorder, result: EpisodeResult) -> None:
        """Attempt after attempt, each from the reset; within them decisions are made otherwise."""
        decisions = ForkedBranches(result) if self._fork else Resimulation(result)
        while not result.exhausted:
            number = len(result.failures)

            def attempt(number: int = number) -> None:
                self._reset(executor)
                self.policy(Arm(self.planner, self.reachability, executor, decisions, (number,)))
                self._finish(executor, recorder, result, [])

            if decisions.run(attempt):
                return

    def _keep_trying(self, executor: Executor, recorder: EpisodeRecorder, result: EpisodeResult) -> None:
        """Attempts one after the other in one motion, as far as what failed can be mended."""
        decisions = Straight(lambda: len(executor.actions))
        recoveries: list[dict[str, Any]] = []
        self._reset(executor)
        while not result.exhausted:
            first = len(executor.actions)
            arm = Arm(self.planner, self.reachability, executor, decisions, (len(result.failures),))
            try:
                self.policy(arm)
                self._finish(executor, recorder, result, recoveries)
                return
            except PlanningFailed as error:
                result.failed(error)
                last = error
            try:
                if not first < len(executor.actions) < self.horizon or isinstance(last, EpisodeLost):
                    raise last
                back_out(arm)
                span = [first, len(executor.actions) - 1]
                recoveries.append({"range": span, "stage": last.stage, "reason": last.reason})
            except PlanningFailed:
                recoveries = []
                self._reset(executor)

    def _reset(self, executor: Executor) -> None:
        executor.reset()
        if self.trials is not None:
            with executor.seconds.spent_on("reset"):
                self.trials.reset(executor.seed)

    def _rehearse(
        self, executor: Executor, recorder: EpisodeRecorder, result: EpisodeResult, *, finished: bool = False
    ) -> None:
        """Try what was done so far; see `trials`."""
        if self.trials is not None:
            gripper = np.array([action[7] for action in executor.actions])
            noisy = result.noisy_failures < self.settings.noisy_failures
            with executor.seconds.spent_on("trial"):
                self.trials.follow(recorder.states, gripper, finished=finished, noisy=noisy)

    def _finish(
        self, executor: Executor, recorder: EpisodeRecorder, result: EpisodeResult, recoveries: list[dict[str, Any]]
    ) -> None:
        """Write what a policy says it has done, if it is a demonstration.

        Raises:
            PlanningFailed: it is none.
        """
        self._check(executor, recorder, result)
        result.success, result.steps = True, len(executor.actions)
        noisy = self.settings.noisy_trials if result.noisy_failures < self.settings.noisy_failures else 0
        recorder.finish(
            {
                **self._describe(executor),
                "attempts": len(result.failures) + 1,
                "noisy_trials": noisy if self.trials is not None else None,
                "recoveries": recoveries,
            }
        )

    def _check(self, executor: Executor, recorder: EpisodeRecorder, result: EpisodeResult) -> None:
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
        self._rehearse(executor, recorder, result, finished=True)

    def _describe(self, executor: Executor) -> dict[str, Any]:
        env = executor.base_env
        target = env.target_asset().asset
        bounds = [s.first for s in executor.segments] + [len(executor.actions)]
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
                {
                    "goal_type": segment.goal_type,
                    "goal_description": segment.goal_description,
                    "goal_range": [segment.first, after - 1],
                }
                for segment, after in zip(executor.segments, bounds[1:], strict=True)
            ],
            "replay_rate": self.settings.replay_rate if self.trials is not None else None,
            "facts": {"disturbed": int(executor.info["disturbed"][0]), **executor.facts},
            "seconds": {part: round(value, 3) for part, value in asdict(executor.seconds).items()},
        }

    def close(self) -> None:
        """Close the environments."""
        self.env.close()
        for world in self.worlds:
            world.close()


def horizon(task: str, control_freq: int) -> int:
    """Control steps a demonstration may have: as many seconds as the task allows at the standard rate.

    ``gym.make`` alone allows ``TaskSpec.max_episode_steps`` at any rate.
    """
    return TASKS[task].max_episode_steps * control_freq // STANDARD_FREQ


def recordable_config(config: TaskConfig, name: str | None) -> str | dict[str, Any]:
    """What a record says of its configuration: the name of a shipped one, else the whole of it (no local path)."""
    return name if name is not None else config.model_dump(mode="json")
