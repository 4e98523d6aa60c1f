"""Settings of `robocas generate` and `robocas replay`: the options of the commands. Loads no simulator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from robocas_ms3.core.checks import MAX_SEED, check_number
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.robots.registry import DEFAULT as DEFAULT_ROBOT
from robocas_ms3.robots.registry import find_robot
from robocas_ms3.scenes.task_specs import SIM_FREQ, STANDARD_FREQ, TASKS

_NO_HINT = tyro.conf.arg(help_behavior_hint="")  # the help text says what the default is


def _task_names() -> type:
    """Return a type of the tasks' names, when the command line is parsed: it loads those of other packages."""
    return tyro.extras.literal_type_from_choices(TASKS)


@dataclass(frozen=True)
class EpisodeSettings:
    """How episodes are generated; the same for all seeds of a run."""

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(constructor_factory=_task_names)]
    """Which task."""
    config: Annotated[str | dict[str, Any], tyro.conf.arg(constructor=str, help_behavior_hint="")] = ""
    """Name of a shipped task configuration, or a YAML file. Default: the task's own (see `robocas list`)."""
    pack: str = "builtin"
    """Object pack: its name, or its folder."""
    control_freq: int = STANDARD_FREQ
    """Control rate in Hz (the paper's is 5); must divide 100, the rate of physics."""
    max_attempts: int = 20
    """Attempts of the policy before a seed is given up."""
    keep_recoveries: bool = False
    """Leave failed attempts in the episode, as one continuous motion, instead of undoing them."""
    check_rate: Annotated[int | None, _NO_HINT] = None
    """Rate in Hz at which an episode's own 7-D actions are tried open loop; an attempt whose actions don't succeed
    again is undone. 0: no trial. Default: 5, or the control rate where 5 doesn't divide it."""
    check_trials: int = 1
    """How often they are tried with a robot's noise as well. 0: not at all."""
    check_failures: int = 1
    """Attempts that may fail for noise alone; after so many an episode counts without, and its record says so."""
    check_noise_mm: Annotated[float, tyro.conf.Suppress] = 0.5
    check_noise_deg: Annotated[float, tyro.conf.Suppress] = 0.2
    layouts: Annotated[str, tyro.conf.Suppress] = "auto"
    """Where layouts come from, see `RoboCASEnv`."""
    planner: str = "rrt_connect"
    """Motion planner: rrt_connect, or another package's (see docs/extending.md)."""
    robot: str = DEFAULT_ROBOT
    """Robot: ours, or another package's (see docs/extending.md)."""
    after_policy: Annotated[str, _NO_HINT] = ""
    """Have a policy act first, as in the evaluation (its --policy): the scripted one takes over from where it is, and
    only that is recorded. Scenes in which nothing is left to be done count as seeds given up."""
    after_steps: tuple[int, int] = (5, 60)
    """Least and most of its steps, of which it has a random number in each scene."""

    def __post_init__(self) -> None:
        config = self.config or TASKS[self.task].default_config
        rate = self.check_rate
        if rate is None:
            rate = 5 if self.control_freq % 5 == 0 else self.control_freq
        object.__setattr__(self, "config", config)
        object.__setattr__(self, "check_rate", rate)

    def check(self) -> None:
        """Check the settings before anything is written.

        Raises:
            RobocasError: a number is out of its range, the task can't run the configuration, or there is no such
                planner, robot or pack.
        """
        from robocas_ms3.assets.pack import load_pack
        from robocas_ms3.planning.rrt_connect import BACKENDS
        from robocas_ms3.scenes.config import load_config_for
        from robocas_ms3.scenes.model import SceneModel

        control, replay = self.control_freq, self.check_rate or 0
        check_number("--max-attempts", self.max_attempts, 1)
        check_number("--control-freq", control, 1, SIM_FREQ)
        if SIM_FREQ % control:
            raise RobocasError(
                "the control rate must divide the rate of physics",
                where="--control-freq",
                expected=f"one of {', '.join(str(f) for f in range(1, SIM_FREQ + 1) if SIM_FREQ % f == 0)}",
                found=control,
            )
        for name in ("check_trials", "check_failures", "check_noise_mm", "check_noise_deg"):
            check_number(f"--{name.replace('_', '-')}", getattr(self, name), 0)
        check_number("--check-rate", replay, 0, control)
        if replay and (control % replay or SIM_FREQ % replay):
            raise RobocasError(
                "the rate of the open-loop check must divide the control rate and the rate of physics",
                where="--check-rate",
                expected=f"a divisor of {control}, or 0 for no check",
                found=replay,
            )
        check_number("--after-steps", self.after_steps[0], 1)
        check_number("--after-steps", self.after_steps[1], self.after_steps[0])
        BACKENDS.find(self.planner, where="planner")
        robot, config = find_robot(self.robot), load_config_for(TASKS[self.task], self.config)
        SceneModel.load(config, load_pack(self.pack), load_pack("builtin"), robot=robot.description)


@dataclass(frozen=True)
class GenerateSettings:
    """Record demonstrations of a task with its scripted policy, as a ManiSkill trajectory file.

    Rendering is not needed: states and actions are recorded, images are rendered by `robocas convert`.

    Example: robocas generate pick -n 20 --config pick_shelf_scattered --set objects.count=12
    """

    episode: EpisodeSettings
    out: Annotated[Path | None, _NO_HINT] = None
    """Output folder. Default: demos/<config>-<pack>."""
    episodes: Annotated[int, tyro.conf.arg(aliases=["-n"])] = 10
    """How many successful episodes to record, at least 1."""
    set: Annotated[tuple[str, ...], _NO_HINT, tyro.conf.UseAppendAction] = ()
    """Set a key of the configuration, such as `--set objects.count=12`; repeatable (docs/configuration.md)."""
    seed: int = 0
    """First seed, 0 or more; the following episodes take the seeds after it."""
    jobs: int = 1
    """Worker processes. The outcome does not depend on it. 0: this process generates, without limits."""
    episode_seconds: float = 1800.0
    """Seconds an episode may take. One that takes longer, or more memory, or crashes, is retried once, by another
    process; then its seed is given up."""
    memory_gb: float = 8.0
    """GB of memory a process may use."""
    check_noise: Annotated[tuple[float, float] | None, _NO_HINT] = None
    """Noise of the noisy trials: standard deviations in mm and degrees, of each component of each action. Default: 0.5
    0.2."""
    fork: bool = True
    """Undo what fails by forking the process, where that is safe. The episodes are the same without, only slower."""
    overwrite: bool = False
    """Start again. Default: continue a run with the same settings, or add episodes to a finished one."""

    def resolve(self) -> GenerateSettings:
        """Return the settings with an output folder, the noise, and a configuration that no file or ``set`` changes.

        Raises:
            ConfigError: the configuration is invalid.
        """
        from robocas_ms3.scenes.config import bundled_configs, load_task_config

        episode, name = self.episode, self.episode.config
        config = load_task_config(name, overrides=self.set)
        if self.set or not isinstance(name, str) or name not in bundled_configs():
            episode = replace(episode, config=config.model_dump(mode="json"))
        if self.check_noise is not None:
            episode = replace(episode, check_noise_mm=self.check_noise[0], check_noise_deg=self.check_noise[1])
        stem = Path(name).stem if isinstance(name, str) else episode.task
        out = self.out or Path("demos") / f"{stem}-{Path(episode.pack).name}"
        return replace(self, episode=episode, out=out, set=(), check_noise=None)

    def check(self) -> None:
        check_number("--episodes", self.episodes, 1)
        check_number("--seed", self.seed, 0, MAX_SEED)
        check_number("--jobs", self.jobs, 0)
        check_number("--episode-seconds", self.episode_seconds, 1)
        check_number("--memory-gb", self.memory_gb, 0.1)
        self.episode.check()


@dataclass(frozen=True)
class ReplaySettings:
    """Replay a trajectory file: its actions, its states, or its actions in another control mode.

    Exit code 1 if an episode does not succeed.

    Example: robocas replay demos/pick --count 2
    """

    trajectory: Annotated[Path, tyro.conf.Positional]
    """F.h5, with F.json next to it, or the output folder of `robocas generate`."""
    control_mode: Annotated[str | None, tyro.conf.arg(aliases=["-c"], help_behavior_hint="")] = None
    """Convert the actions: pd_joint_delta_pos, pd_ee_delta_pose or pd_ee_pose. Default: as recorded."""
    obs_mode: Annotated[str, tyro.conf.arg(aliases=["-o"])] = "none"
    """Observations to record with --save, e.g. rgb+depth or state."""
    use_env_states: bool = False
    """Set the recorded state after every step."""
    count: Annotated[int | None, _NO_HINT] = None
    """Only the first so many episodes, at least 1."""
    save: Annotated[Path | None, _NO_HINT] = None
    """Write the replayed episodes to this HDF5 file."""
    allow_failure: bool = False
    """With --save: write failed episodes too."""
    pack: Annotated[str | None, _NO_HINT] = None
    """Object pack to use instead of the recorded one: its name, or its folder."""
    overwrite: bool = False
    """Replace the file given by --save if it exists."""

    @property
    def file(self) -> Path:
        return self.trajectory / "trajectory.h5" if self.trajectory.is_dir() else self.trajectory
