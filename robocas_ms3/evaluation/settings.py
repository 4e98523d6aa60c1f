"""Settings of an evaluation: the options of `robocas eval run`. Imports no simulator."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from robocas_ms3.core.checks import check_number, parse_shard
from robocas_ms3.core.errors import EvaluationError

_NO_HINT = tyro.conf.arg(help_behavior_hint="")  # the help text states the default


@dataclass(frozen=True)
class EvaluationOptions:
    """Policy, protocol and result."""

    tasks: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[TASK ...]"), _NO_HINT] = ()
    """Tasks to evaluate, such as pick.
    Default: all tasks of the protocol. In paper-v1, select runs in the episodes of pick, as in RoboCAS-v0."""
    policy: Annotated[str, tyro.conf.arg(metavar="POLICY")] = "scripted"
    """Policy to evaluate: a name from `robocas list`, such as scripted (joint targets) or scripted-ee-delta;
    a run folder of `robocas train`; module:Class of your own code; replay:TRAJECTORY.h5;
    or the address ws://HOST:PORT of `robocas serve-policy`."""
    protocol: Annotated[str, tyro.conf.arg(metavar="PROTOCOL")] = "ms3-v1"
    """Name of a bundled protocol (`robocas eval protocols`), or a protocol folder."""
    out: Annotated[Path | None, _NO_HINT] = None
    """Output folder. Default: eval/PROTOCOL/POLICY, with a suffix for --weld and --action-noise."""
    overwrite: bool = False
    """Delete an existing result and start again. Default: continue a result that has the same settings."""
    retry_errors: bool = False
    """Repeat episodes that ended with an error, such as a lost connection to a policy server."""
    weld: bool = False
    """Fix lifted objects to the hand until the gripper is commanded to open, as RoboCAS-v0 does.
    Only for protocols with RoboCAS-v0's steps (paper-v1), in worker processes.
    Results with and without the weld are not comparable."""
    action_noise: Annotated[tuple[float, float], tyro.conf.arg(metavar="MM DEG"), _NO_HINT] = (0.0, 0.0)
    """Add normal noise to each component of each motion of the TCP that the policy commands.
    Standard deviations in mm and degrees, such as 0.5 0.2.
    Results with and without noise are not comparable. Default: 0 0, no noise."""
    render_size: Annotated[tuple[int, int] | None, tyro.conf.Suppress] = None
    """Width and height in pixels of the images of ``env.render``; None: no images."""


@dataclass(frozen=True, kw_only=True)
class SelectionOptions:
    """Subset of the episodes of the protocol. Default: all."""

    shard: Annotated[str, tyro.conf.arg(metavar="K/N")] = "0/1"
    """Run shard K of N: the episodes whose number is K modulo N, 0 <= K < N.
    `robocas eval merge` joins the results."""
    split: Annotated[str, _NO_HINT] = ""
    """Run only the episodes of this split, such as `seen`; `robocas eval protocols` lists the splits. Default: all."""
    episodes: Annotated[int | None, _NO_HINT] = None
    """Run only the first N episodes of each configuration. Default: all."""


@dataclass(frozen=True, kw_only=True)
class SimulationOptions:
    """Processes and limits; outcomes do not depend on them."""

    envs: int = 2
    """Number of environments that run at the same time; outcomes do not depend on it."""
    workers: Annotated[int | None, _NO_HINT] = None
    """Number of worker processes. Default: one per environment, at most one per CPU core.
    0: all environments in this process, without limits."""
    backend: Literal["auto", "processes", "gpu"] = "auto"
    """Where the simulation runs. auto: on a GPU if there is one, else in worker processes."""
    step_seconds: float = 300.0
    """Time limit in seconds per environment step or reset of a worker process; the policy has no limit.
    An episode whose worker exceeds it or crashes is repeated once.
    After a second failure it counts as failed, with an error."""
    memory_gb: float = 8.0
    """Memory limit per worker process in GiB."""


@dataclass(frozen=True)
class EvaluationSettings(EvaluationOptions, SelectionOptions, SimulationOptions):
    """Evaluate a policy in the episodes of a protocol and write the outcome of each episode as it ends.

    Example: robocas eval pick --policy runs/pick --protocol paper-v1 --out eval/pick
    """

    def __post_init__(self) -> None:
        for name, least in (("envs", 1), ("episodes", 1), ("workers", 0)):
            if (number := getattr(self, name)) is not None:
                check_number(f"--{name}", number, least)
        for number in self.action_noise:
            check_number("--action-noise", number, 0)
        check_number("--step-seconds", self.step_seconds, 1)
        check_number("--memory-gb", self.memory_gb, 0.1)
        parse_shard(self.shard, EvaluationError)

    def choose_folder(self, protocol: str, played_as: Iterable[str] = ()) -> Path:
        """Return ``out``, or the default folder eval/PROTOCOL/POLICY of the working directory.

        The default folder has the suffixes ``_TASK``, for each task in ``played_as``, ``_weld`` and ``_noiseMM_DEG``.
        """
        suffixes = [
            *played_as,
            *(["weld"] if self.weld else []),
            *(["noise{:g}_{:g}".format(*self.action_noise)] if any(self.action_noise) else []),
        ]
        name = "_".join([re.sub(r"[^\w.-]+", "_", self.policy), *suffixes])
        return self.out or (Path("eval") / protocol / name).absolute()
