"""Train the baseline `ppo` from Python: it learns on a CPU to reach for one of a few fruits and to hold it.

    python examples/ppo.py --seed 1 --out out/ppo_1

does the same as `robocas train ppo --seed 1 --out out/ppo_1`. The results are in docs/rl.md.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from robocas_ms3.baselines import ProgressCallbacks, RunOptions, train_run


@dataclass
class Args:
    out: Path = Path("out/ppo")
    """Folder of the run."""
    seed: int = 1
    """Seed of the policy and its noise."""
    steps: int = 102_400
    """Training steps, of all environments together."""
    batch: int = 512
    """Steps between updates, of all environments together."""
    envs: int = 8
    """Number of environments."""
    workers: int | None = None
    """Number of processes for the environments. Default: one per environment, at most one per core."""
    layouts: int = 64
    """Number of layouts for training."""
    test_episodes: int = 50
    """Number of test episodes after the training, in other layouts and without noise."""


def main(args: Args) -> None:
    torch.set_num_threads(1)
    train = {"seed": args.seed, "steps": args.steps, "batch_size": args.batch}
    config = {"envs": args.envs, "workers": args.workers, "layouts": args.layouts, "test_episodes": args.test_episodes}
    train_run(
        RunOptions("ppo", None, args.out, {**config, "train": train}, overwrite=True), ProgressCallbacks(message=print)
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
