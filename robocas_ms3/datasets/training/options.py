"""Options of training samples, and the steps of an episode that a sample contains.

A sample belongs to a step t, 0 <= t <= T - 2 (step T - 1 has no action). It has the observations ``t - H + 1 .. t`` and
the actions ``t - H + 1 .. t + A - 1``. With A = 1 there is one action per observation, as the models of RoboCAS-v0
predict them. The last A rows are the chunk that starts at t.
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
"""Image width and height for RoboCAS-v0 models, pixels."""
STATE_KEYS = tuple(
    spec.name for spec in schema.EPISODE_INFO if spec.shape[:1] == ("T",) and spec.dtype != "str" and not spec.embedding
)
"""Arrays that ``state`` may contain."""


@dataclass(frozen=True)
class SampleOptions:
    """Options of the samples of a dataset.

    Attributes:
        split: ``train`` or ``val`` by ``data_info.json``, or ``all``.
        observation_horizon: number of observed steps H, including the current one; RoboCAS-v0: RT-1 6, RoboFlamingo 11.
        action_horizon: number of actions A from the current step on; RoboCAS-v0: 1.
        padding: values before the first and after the last step. ``hold``: the robot stands still (first image, no
            motion, nearest gripper command); ``zero``: zeros; ``drop``: samples that need padding are omitted.
        cameras: names of the cameras, in the order of the stack; empty: no images.
        size: width and height to which images are scaled, pixels; None: no scaling.
        depth: whether samples have depth images.
        calibration: whether samples have the intrinsic matrices and the nominal poses of the cameras.
        float_images: RGB as float32 in 0..1 instead of uint8.
        state: arrays of the schema that are concatenated to ``state``, see `STATE_KEYS`.
        embedding: whether samples have embeddings of the texts.
        subgoals: whether samples have sub-goals.
        normalize: whether motion is scaled from ``action_space`` to [-1, 1] and clipped.
        action_space: range for ``normalize``, instead of the range in ``data_info.json``. None with a trajectory file:
            the range is computed from all of its episodes.
        rate_hz: rate of the samples of a trajectory file in Hz; default 5.
        include_failed: whether failed episodes of a trajectory file are used.
        cached_episodes: number of episodes whose arrays are cached per worker.
    """

    split: Split = "train"
    observation_horizon: int = 6
    action_horizon: int = 1
    padding: Padding = "hold"
    cameras: Sequence[str] = V0_CAMERAS
    size: tuple[int, int] | None = V0_SIZE
    depth: bool = False
    calibration: bool = False
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
                raise DatasetError("invalid option", where=where, expected=f"one of {', '.join(known)}", found=found)
        for where in ("observation_horizon", "action_horizon"):
            found = getattr(self, where)
            if type(found) is not int or found < 1:
                raise DatasetError("invalid number of steps", where=where, expected="an integer >= 1", found=found)
        if self.size is not None and (len(self.size) != 2 or min(self.size) < 1):
            raise DatasetError("invalid size", where="size", expected="width and height >= 1", found=self.size)

    def sample_steps(self, length: int) -> range:
        """Return the steps of an episode that have a sample; ``length`` is its number of steps T."""
        if self.padding == "drop":
            first = self.observation_horizon - 1
            return range(first, max(first, length - self.action_horizon))
        return range(max(0, length - 1))

    def observation_steps(self, step: int) -> Steps:
        """Return the observed steps (H,) of the sample at a step; steps before the episode are negative."""
        return np.arange(step - self.observation_horizon + 1, step + 1)

    def action_steps(self, step: int) -> Steps:
        """Return the action steps (H + A - 1,) of the sample at a step.

        Steps outside the episode are negative or above T - 2.
        """
        return np.arange(step - self.observation_horizon + 1, step + self.action_horizon)
