"""What a training sample holds, and which steps of an episode it is made of: options and index arithmetic.

A sample belongs to a step t, 0 <= t <= T - 2: from each of these a motion leaves. It holds the observations
``t - H + 1 .. t`` and the actions ``t - H + 1 .. t + A - 1``. So with A = 1 there is one action beside each
observation, as upstream's models predict them, and the last A rows are the chunk that starts at t.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.sources.episode_source import Split

Steps = NDArray[np.int64]
Padding = Literal["hold", "zero", "drop"]
V0_CAMERAS = ("base_camera", "gripper_camera")
V0_SIZE = (320, 256)
"""Width and height in pixels."""
STATE_KEYS = tuple(
    spec.name for spec in schema.EPISODE_INFO if spec.shape[:1] == ("T",) and spec.dtype != "str" and not spec.embedding
)
"""Arrays that ``state`` may be made of."""


@dataclass(frozen=True)
class SampleOptions:
    """What the samples of a dataset hold.

    Attributes:
        split: ``train`` or ``val`` by ``data_info.json``, or ``all``.
        observation_horizon: steps looked back on, the present one included; upstream's RT-1: 6, RoboFlamingo: 11.
        action_horizon: actions from the present step on; upstream: 1.
        padding: beyond an episode's ends. ``hold``: the robot stands still (first image, no motion, the gripper command
            nearest in time); ``zero``: zeros; ``drop``: such samples are left out.
        cameras: names, in the order of their stack; empty: no images.
        size: width and height to scale images to; None: as they are.
        depth: whether to give depth too.
        float_images: RGB as float32 in 0..1 instead of uint8.
        state: arrays of the schema to give as ``state``, see `STATE_KEYS`.
        embedding: whether to give embeddings of the texts.
        subgoals: whether to give sub-goals.
        normalize: whether to map motion from ``action_space`` to [-1, 1], clipped.
        action_space: in place of that of ``data_info.json``, in its form; a trajectory file is read whole without one.
        rate_hz: of a trajectory's samples; default 5.
        include_failed: also a trajectory's episodes without success.
        cached_episodes: number of episodes whose arrays are kept, in each worker.
    """

    split: Split = "train"
    observation_horizon: int = 6
    action_horizon: int = 1
    padding: Padding = "hold"
    cameras: Sequence[str] = V0_CAMERAS
    size: tuple[int, int] | None = V0_SIZE
    depth: bool = False
    float_images: bool = False
    state: Sequence[str] = ()
    embedding: bool = False
    subgoals: bool = False
    normalize: bool = False
    action_space: Mapping[str, Any] | None = None
    rate_hz: float | None = None
    include_failed: bool = False
    cached_episodes: int = 64

    def __post_init__(self) -> None:
        choices = [("split", self.split, get_args(Split)), ("padding", self.padding, get_args(Padding))]
        for where, found, known in (*choices, *(("state", key, STATE_KEYS) for key in self.state)):
            if found not in known:
                raise DatasetError("no such choice", where=where, expected=f"one of {', '.join(known)}", found=found)
        for where in ("observation_horizon", "action_horizon"):
            found = getattr(self, where)
            if type(found) is not int or found < 1:
                raise DatasetError("invalid number of steps", where=where, expected="an integer >= 1", found=found)
        if self.size is not None and (len(self.size) != 2 or min(self.size) < 1):
            raise DatasetError("no such size", where="size", expected="width and height >= 1", found=self.size)

    def sample_steps(self, length: int) -> range:
        """Return the steps of an episode of T steps that have a sample."""
        if self.padding == "drop":
            first = self.observation_horizon - 1
            return range(first, max(first, length - self.action_horizon))
        return range(max(0, length - 1))

    def observation_steps(self, step: int) -> Steps:
        """Return the steps (H,) that a sample observes; below 0 before the episode."""
        return np.arange(step - self.observation_horizon + 1, step + 1)

    def action_steps(self, step: int) -> Steps:
        """Return the steps (H + A - 1,) of its actions; below 0 or beyond T - 2 outside of the episode."""
        return np.arange(step - self.observation_horizon + 1, step + self.action_horizon)
