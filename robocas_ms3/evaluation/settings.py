"""Settings of an evaluation: the options of `robocas eval run`. Loads no simulator."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from robocas_ms3.core.checks import check_number, parse_shard
from robocas_ms3.core.errors import EvaluationError

_NO_HINT = tyro.conf.arg(help_behavior_hint="")  # the help text says what the default is


@dataclass(frozen=True)
class EvaluationSettings:
    """Measure a policy by a protocol: every episode of its list once, written as it ends.

    Example: robocas eval pick --policy runs/pick --protocol paper-v1 --out eval/pick
    """

    tasks: Annotated[tuple[str, ...], tyro.conf.Positional, _NO_HINT] = ()
    """Only the episodes of these tasks. Default: all."""
    policy: str = "scripted"
    """Policy: scripted (joint targets), scripted-ee-delta (RoboCAS' 7 numbers), scripted-perturbed (these, off by some
    cm), random, noop, replay:TRAJECTORY.h5, a folder of `robocas train`, module:Class of your own, one that an
    installed package brings (`robocas list`), or ws://HOST:PORT, a server's (`robocas serve-policy`)."""
    protocol: str = "ms3-v1"
    """Name of a bundled protocol, or its folder."""
    out: Annotated[Path | None, _NO_HINT] = None
    """Folder to write to. Default: eval/PROTOCOL/POLICY, with the weld eval/PROTOCOL/POLICY_weld."""
    overwrite: bool = False
    """Start again. Default: continue a result with the same settings, or add episodes to it."""
    retry_errors: bool = False
    """Run episodes again that ended with an error, such as a server that was gone."""
    envs: int = 2
    """Envs at a time; the outcome does not depend on it."""
    workers: Annotated[int | None, _NO_HINT] = None
    """Processes. Default: one per env, no more than cores."""
    step_seconds: float = 300.0
    """Seconds that envs of a process may take for a step or a reset. If they take longer, or more memory, or crash,
    the episode is run again once; then it counts as failed, with an error. Policies have no limit."""
    memory_gb: float = 8.0
    """GB of memory that a process of envs may use."""
    backend: Literal["auto", "processes", "gpu"] = "auto"
    """Where envs run. Auto: a GPU if there is one."""
    shard: str = "0/1"
    """K/N: only every N-th episode, from the K-th on (K = 0 ... N - 1). `robocas eval merge` joins the results."""
    split: Annotated[str, _NO_HINT] = ""
    """Only the episodes of this split, such as `seen`."""
    episodes: Annotated[int | None, _NO_HINT] = None
    """Only the first so many of each configuration."""
    weld: bool = False
    """Weld what closed fingers have lifted to the hand, as RoboCAS-v0 does, until the gripper is commanded to open.
    Only in protocols with RoboCAS-v0's steps (paper-v1), in processes; never compare it with results without."""
    render_size: Annotated[tuple[int, int] | None, tyro.conf.Suppress] = None
    """Width and height of the images of the env's ``render``, pixels; None: it renders none."""

    def __post_init__(self) -> None:
        for name in ("envs", "episodes", "workers"):
            if (number := getattr(self, name)) is not None:
                check_number(f"--{name}", number, 1)
        check_number("--step-seconds", self.step_seconds, 1)
        check_number("--memory-gb", self.memory_gb, 0.1)
        parse_shard(self.shard, EvaluationError)

    def folder(self, protocol: str) -> Path:
        name = re.sub(r"[^\w.-]+", "_", self.policy) + ("_weld" if self.weld else "")
        return self.out or (Path("eval") / protocol / name).absolute()
