"""PPO learns to reach for one of a few fruits and hold it, on a CPU: the baseline `ppo`, from Python.

    python examples/ppo.py --seed 1 --out out/ppo_1

is `robocas train ppo --seed 1 --out out/ppo_1`; docs/rl.md says what comes of it.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from robocas_ms3.baselines import Progress, RunOptions, train_run


@dataclass
class Args:
    out: Path = Path("out/ppo")
    """Folder of the run."""
    seed: int = 1
    """Of the policy and its noise."""
    steps: int = 102_400
    """Of all environments together."""
    batch: int = 512
    """Steps of all environments together between updates."""
    envs: int = 8
    """Environments."""
    workers: int | None = None
    """Processes that they are in; default: one an environment, but no more than cores."""
    layouts: int = 64
    """Different scenes to learn from."""
    trials: int = 50
    """Episodes at the end, in layouts that were not learned from, without noise."""


def main(args: Args) -> None:
    torch.set_num_threads(1)
    train = {"seed": args.seed, "steps": args.steps, "batch_size": args.batch}
    more = {"envs": args.envs, "workers": args.workers, "layouts": args.layouts, "trials": args.trials}
    train_run(RunOptions("ppo", None, args.out, {**more, "train": train}, overwrite=True), Progress(note=print))


if __name__ == "__main__":
    main(tyro.cli(Args))
