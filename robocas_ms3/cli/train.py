"""``robocas train``: train a baseline on demonstrations."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from robocas_ms3.cli.options import Maybe, Repeated


@dataclass
class Train:
    """Train a baseline on a dataset of `robocas convert`, for `robocas eval TASK --policy RUN`.

    - small: base and gripper camera, language; made for two processor cores
    - bc-state: what only a simulator knows, from the trajectory.h5 of `robocas generate`
    - rt1: the paper's RT-1
    - ppo: learns by trying, without --data, from dense rewards and what only a simulator knows (docs/rl.md)

    docs/baselines.md says what they are, what they cost and what they reach. Several GPUs:
    `accelerate launch --no_python robocas train ...`.
    """

    baseline: Annotated[str, tyro.conf.Positional] = "small"
    """Which: small, bc-state, rt1, ppo, or another package's."""
    data: Maybe[Path] = None
    """Folder of a dataset, or a trajectory.h5. Needed, but for ppo."""
    out: Maybe[Path] = None
    """Folder of the run. Default: runs/BASELINE-DATA, or runs/BASELINE."""
    config: Maybe[Path] = None
    """YAML file of what differs from the baseline's defaults."""
    set: Repeated[str] = ()
    """A value of the configuration, such as `--set chunk=4` or `--set train.learning_rate=3e-4`; may be given again."""
    steps: Maybe[int] = None
    """Steps of the optimiser; train.steps of the configuration."""
    batch_size: Maybe[int] = None
    """Samples a step; train.batch_size."""
    seed: Maybe[int] = None
    """Of everything random; train.seed."""
    start: Maybe[str] = None
    """Folder of a run to begin with, such as one on less data, or small, which comes with the package (a folder of
    that name needs a longer path): with its weights, and its configuration where no option says otherwise. Default:
    random weights, the baseline's defaults."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where it computes. Auto: a GPU if there is one."""
    overwrite: bool = False
    """Start again. Default: continue a run with the same settings, as if it had not been interrupted."""


def main(cfg: Train) -> int:
    """Run the command; gives the exit code."""
    from robocas_ms3.baselines.runs import find_run
    from robocas_ms3.baselines.session import Said, train_run
    from robocas_ms3.cli.bars import bar
    from robocas_ms3.cli.terminal import say

    shown = cfg.out or _default_out(cfg)
    out = shown.absolute()
    start = None if cfg.start is None else find_run(Path(cfg.start)).absolute()
    with bar("episodes read", transient=True) as reading, bar("steps trained") as stepping:

        def step(done: int, of: int) -> None:
            reading.stop()  # a terminal has room for one
            stepping.at(done, of)

        first = os.environ.get("RANK", "0") == "0"  # of several processes it speaks
        said = Said(stepping.note, reading.at, step) if first else Said()
        try:
            train_run(
                cfg.baseline,
                cfg.data,
                out,
                changes_of(cfg),
                start=start,
                device=cfg.device,
                overwrite=cfg.overwrite,
                said=said,
            )
        except KeyboardInterrupt:
            raise KeyboardInterrupt("the same command continues") from None
    if first:
        say(f"{shown}: trained. Next: robocas eval TASK --policy {shown} --protocol {'paper-v1' if cfg.data else 'P'}")
    return 0


def _default_out(cfg: Train) -> Path:
    if cfg.data is None:
        return Path("runs") / cfg.baseline
    data = cfg.data.resolve()
    return Path("runs") / f"{cfg.baseline}-{data.parent.name if data.is_file() else data.name}"


def changes_of(cfg: Train) -> dict[str, Any]:
    """What differs from the defaults, as the file and the options have it; options win."""
    from robocas_ms3.baselines.begin import merged
    from robocas_ms3.core.documents import load_yaml
    from robocas_ms3.core.errors import TrainingError
    from robocas_ms3.scenes.config.overrides import parse_override

    found: dict[str, Any] = {}
    if cfg.config is not None:
        try:
            read = load_yaml(cfg.config)
        except FileNotFoundError:
            raise TrainingError("no such file", where=f"--config {cfg.config}") from None
        except (OSError, ValueError) as error:
            raise TrainingError("can't be read", where=f"--config {cfg.config}", found=error) from error
        if not isinstance(read, dict):
            raise TrainingError("no configuration", where=cfg.config, expected="a mapping", found=type(read).__name__)
        found = read
    for text in cfg.set:
        found = merged(found, parse_override(text, TrainingError, "train.seed=1"))
    for key in ("steps", "batch_size", "seed"):
        if (value := getattr(cfg, key)) is not None:
            found = merged(found, {"train": {key: value}})
    return found
