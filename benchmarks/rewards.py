"""Draw the dense reward of one demonstration per task, and of runs that stop on the way; write a JPEG file.

python benchmarks/rewards.py [--out docs/images/rewards.jpg]

Printed lines: length of each demonstration and mean reward of each fifth; reward per step of each run that stops.
"""

import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import torch
import tyro
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from robocas_ms3.demos import EpisodeSettings
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.tasks import TASKS

BLUE, ORANGE, GREY = "#2f6fa8", "#e08a2e", "#9aa3ab"
AFTER = 3.0  # s that are drawn after the end of the demonstration
SHADES = ("#f2f4f6", "#e4e8ec")


@dataclass
class Args:
    configs: list[str] = field(
        default_factory=lambda: ["pick_table_scattered", "select_table_orderly", "search_table_stacked",
                                 "open_pick_drawer"]
    )  # fmt: skip
    """Task configurations; one demonstration is drawn for each."""
    seed: int = 1
    """First seed to try."""
    out: Path = Path("docs/images/rewards.jpg")


def main(args: Args) -> None:
    torch.set_num_threads(1)
    with rc_context({"font.size": 9, "axes.titlesize": 10}):
        figure = Figure(figsize=(11, 2.4 * len(args.configs)), layout="constrained")
        FigureCanvasAgg(figure)
        for axes, config in zip(np.ravel(figure.subplots(len(args.configs), 1)), args.configs, strict=True):
            draw(axes, config, args.seed)
        axes.set_xlabel("s")
        figure.savefig(args.out, dpi=110, pil_kwargs={"quality": 88})


def draw(axes: Any, config: str, seed: int) -> None:
    env, actions, seed = demonstrate(config, seed)
    freq = env.unwrapped.control_freq
    levels, infos = run_actions(env, seed, actions, round(AFTER * freq))
    stages = list(env.unwrapped.REWARDS.stages)
    at = np.array([find_stage(env.unwrapped.REWARDS, info) for info in infos])
    times = np.arange(1, len(levels) + 1) / freq
    bounds = [0, *(np.flatnonzero(np.diff(at)) + 1), len(at)]
    for shade, (first, after) in enumerate(zip(bounds[:-1], bounds[1:], strict=True)):
        axes.axvspan(first / freq, after / freq, color=SHADES[shade % 2], lw=0)
        if after - first > 0.035 * len(at):
            name = [*stages, "success"][at[first]]
            axes.text((first + after) / 2 / freq, 1.04, name, ha="center", color="#555", size=8)
    for stop in find_stop_steps(infos, actions):
        idle, _ = run_actions(env, seed, actions[:stop], len(levels) - stop)
        axes.plot(times[stop - 1 :], idle[stop - 1 :], color=ORANGE, lw=1.2, ls=(0, (4, 2)), zorder=3)
        axes.plot(times[stop - 1], idle[stop - 1], "o", color=ORANGE, ms=4, zorder=4)
        print(f"{config} seed {seed}: a run that stops after {stop / freq:.1f} s gets {idle[-1]:.3f} per step then")
    axes.plot(times, levels, color=BLUE, lw=1.8, zorder=5)
    print(f"{config} seed {seed}: {len(actions) / freq:.1f} s, mean of each fifth "
          f"{[round(float(part.mean()), 2) for part in np.array_split(levels[: len(actions)], 5)]}")  # fmt: skip
    axes.set(title=config, ylim=(0, 1.14), xlim=(0, times[-1]), ylabel="reward per step")
    axes.set(yticks=np.arange(0, 1.1, 0.25))
    axes.title.set_y(1.0)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    env.close()


def demonstrate(config: str, seed: int) -> tuple[gym.Env, np.ndarray, int]:
    """Return an environment with dense rewards, the actions of a demonstration, and its seed."""
    task = load_task_config(config).task
    generator = EpisodeGenerator(EpisodeSettings(task, config, "builtin"))
    with tempfile.TemporaryDirectory() as folder:
        while not generator.generate(seed, Path(folder), "demonstration").success:
            seed += 1
        with h5py.File(Path(folder) / "demonstration.h5") as file:
            group: Any = file["traj_0"]
            actions = np.array(group["actions"])
    mode = generator.env.unwrapped.control_mode  # pyright: ignore[reportAttributeAccessIssue]
    generator.close()
    kwargs = {"obs_mode": "none", "reward_mode": "normalized_dense", "render_backend": "none", "control_mode": mode}
    return gym.make(TASKS[task].env_id, config=config, **kwargs), actions, seed


def run_actions(env: gym.Env, seed: int, actions: np.ndarray, then: int) -> tuple[np.ndarray, list[dict]]:
    """Return rewards and infos of the actions, followed by `then` repetitions of the last action."""
    env.reset(seed=seed)
    levels, infos = [], []
    for action in [*actions, *[actions[-1]] * then]:
        _, reward, *_, info = env.step(action)
        levels.append(float(reward))
        infos.append(info)
    return np.array(levels), infos


def find_stage(table: Any, info: dict) -> int:
    """Return the index of the first stage with a reward term below 1."""
    full = [all(info["reward_terms"][name] == 1 for name in own) for own in table.stages.values()]
    return [*full, False].index(False)


def find_stop_steps(infos: list[dict], actions: np.ndarray) -> list[int]:
    """Return steps at which to stop: before the first touch of the target, grasped, lifted, above the basket."""
    first = {
        flag: next(i for i, info in enumerate(infos) if info[flag])
        for flag in ("reached_target", "target_grasped", "target_lifted")
    }
    released = int(np.flatnonzero(actions[:, 7] < 0)[-1])
    stops = [first["reached_target"] // 2, first["reached_target"] - 2, first["target_grasped"] + 1, released]
    return [stop for stop in stops if stop > 0]


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
