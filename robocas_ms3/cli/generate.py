"""``robocas generate``: record demonstrations with a scripted policy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from robocas_ms3.cli.interrupts import resumable
from robocas_ms3.cli.options import Maybe, Repeated
from robocas_ms3.core.words import count_of
from robocas_ms3.robots.table import DEFAULT
from robocas_ms3.scenes.task_specs import TASKS

if TYPE_CHECKING:
    TaskName = str
else:
    TaskName = tyro.extras.literal_type_from_choices(TASKS)


@dataclass
class Generate:
    """Record demonstrations of a task with its scripted policy, as a ManiSkill trajectory file.

    Rendering is not needed: states and actions are recorded, pictures are made by `robocas convert`.

    Example: robocas generate pick -n 20 --config pick_shelf_scattered --set objects.count=12
    """

    task: Annotated[TaskName, tyro.conf.Positional]
    """Which task."""
    episodes: Annotated[int, tyro.conf.arg(aliases=["-n"])] = 10
    """How many successful episodes to record, at least 1."""
    config: Maybe[str] = None
    """Name of a shipped task configuration, or a YAML file. Default: the task's own (see `robocas list`)."""
    set: Repeated[str] = ()
    """Set a key of the configuration, such as `--set objects.count=12`; repeatable (docs/configuration.md)."""
    pack: str = "builtin"
    """Object pack: its name, or its folder."""
    out: Maybe[Path] = None
    """Output folder. Default: demos/<config>-<pack>."""
    seed: int = 0
    """First seed, 0 or more; the following episodes take the seeds after it."""
    jobs: int = 1
    """Worker processes. The outcome does not depend on it."""
    episode_seconds: float = 1800.0
    """Seconds an episode may take. One that takes longer, or more memory, or crashes, is begun again once, by another
    process; then its seed is given up."""
    memory_gb: float = 8.0
    """GB of memory a process may use."""
    control_freq: int = 20
    """Control rate in Hz (the paper's is 5); must divide 100, the rate of physics."""
    max_attempts: int = 20
    """Attempts of the policy before a seed is given up."""
    replay_rate: Maybe[int] = None
    """Rate in Hz at which an episode's own 7-D actions are tried open loop; an attempt whose actions don't succeed
    again is undone. 0: no trial. Default: 5, or the control rate where 5 doesn't divide it."""
    noisy_trials: int = 1
    """How often they are tried with a robot's noise as well. 0: not at all."""
    noise: tuple[float, float] = (0.5, 0.2)
    """That noise: standard deviations in mm and degrees, of each component of each action."""
    noisy_failures: int = 1
    """Attempts that may fail for noise alone; after so many an episode counts without, and its record says so."""
    planner: str = "rrt_connect"
    """Motion planner: rrt_connect, or another package's (see docs/extending.md)."""
    robot: str = DEFAULT
    """Robot: ours, or another package's (see docs/extending.md)."""
    fork: bool = True
    """Undo what fails by forking the process, where that is safe. The episodes are the same without, only slower."""
    keep_recoveries: bool = False
    """Leave failed attempts in the episode, as one continuous motion, instead of undoing them."""
    after_policy: Maybe[str] = None
    """Have a policy act first, as in the evaluation (its --policy): the scripted one takes over from where it is, and
    only that is recorded. Scenes in which nothing is left to be done count as seeds given up."""
    after_steps: tuple[int, int] = (5, 60)
    """Least and most of its steps, of which it has a random number in each scene."""
    overwrite: bool = False
    """Start again. Default: continue a run with the same settings, or add episodes to a finished one."""


@resumable
def main(cfg: Generate) -> int:
    """Run the command."""
    from robocas_ms3.scenes.config import load_task_config, shipped_configs

    name = cfg.config or TASKS[cfg.task].default_config
    loaded = load_task_config(name, overrides=cfg.set)  # before seconds go by for what is imported next
    from robocas_ms3.cli.bars import bar
    from robocas_ms3.cli.terminal import say
    from robocas_ms3.core.workers import Limits
    from robocas_ms3.demos.checks import check_limits
    from robocas_ms3.demos.episode import EpisodeResult, EpisodeSettings, recordable_config
    from robocas_ms3.demos.generate import generate

    check_limits(cfg.episode_seconds, cfg.memory_gb)
    config = recordable_config(loaded, name if name in shipped_configs() and not cfg.set else None)
    out = cfg.out or Path("demos") / f"{Path(name).stem}-{Path(cfg.pack).name}"
    rate = cfg.replay_rate
    if rate is None:
        rate = 5 if cfg.control_freq % 5 == 0 else cfg.control_freq
    settings = EpisodeSettings(
        cfg.task,
        config,
        cfg.pack,
        cfg.control_freq,
        cfg.max_attempts,
        cfg.keep_recoveries,
        rate,
        cfg.noisy_trials,
        cfg.noisy_failures,
        *cfg.noise,
        planner=cfg.planner,
        robot=cfg.robot,
        after_policy=cfg.after_policy or "",
        after_steps=cfg.after_steps,
    )
    players, weights = None, ""
    if settings.after_policy:
        from robocas_ms3.evaluation.acting import Players, check_acting

        weights = check_acting(settings)
        players = Players(settings)
    with bar("episodes recorded") as shown:

        def on_result(result: EpisodeResult) -> None:
            if result.success:
                shown.advance()
            else:
                last = result.failures[-1]
                shown.note(f"seed {result.seed}: given up ({last.stage}: {last.reason})")

        def on_start(there: int) -> None:
            if there >= cfg.episodes:
                shown.note(f"{out} has {count_of(there, 'episode')} already")
            shown.start(cfg.episodes, there)

        summary = generate(
            settings,
            out,
            episodes=cfg.episodes,
            first_seed=cfg.seed,
            jobs=cfg.jobs,
            fork=cfg.fork,
            limits=Limits(cfg.episode_seconds, cfg.memory_gb),
            overwrite=cfg.overwrite,
            on_start=on_start,
            on_result=on_result,
            players=players,
            weights=weights,
        )
        shown.at(cfg.episodes, cfg.episodes)  # some of them may have been there beyond a seed that was not
    seconds = ", ".join(f"{part} {value:.2f}" for part, value in summary.mean_seconds.items())
    say(f"{count_of(summary.episodes, 'episode')} from {count_of(summary.seeds, 'seed')} ({summary.success_rate:.0%})")
    say(f"mean seconds a seed: {seconds}; mean length {summary.mean_steps:.0f} steps")
    if summary.failures:
        say("failed attempts: " + ", ".join(f"{reason} x{n}" for reason, n in summary.failures.items()))
    say(f"wrote {summary.trajectory}")
    return 0
