"""Demonstrations as a torch dataset: windows of observations and actions, decoded when they are asked for.

What upstream's training loader computes, and what it leaves open: docs/training.md.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError, EmptySplitError
from robocas_ms3.core.words import count_of
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.actions import ActionScale
from robocas_ms3.datasets.formats import open_source
from robocas_ms3.datasets.sources.protocol import Side
from robocas_ms3.datasets.training.sample_arrays import check_holds, read_episode, type_index
from robocas_ms3.datasets.training.sample_pictures import PictureStack
from robocas_ms3.datasets.training.sampling import SampleIndex, balancing_weights
from robocas_ms3.datasets.training.windows import Padding, Window

UPSTREAM_CAMERAS = ("base_camera", "gripper_camera")
UPSTREAM_SIZE = (320, 256)
"""Width and height in pixels."""
STATE_KEYS = tuple(
    spec.name for spec in schema.EPISODE_INFO if spec.shape[:1] == ("T",) and spec.dtype != "str" and not spec.embedding
)
"""Arrays that ``state`` may be made of."""


class RoboCASDataset(torch.utils.data.Dataset):
    """Samples of a dataset, or of a trajectory file (state and action only).

    Only the overview is read at the beginning; arrays and pictures are read sample by sample, and no file stays open,
    so that workers may be forked or spawned. A sample is a dict; H = ``observation_horizon``, A = ``action_horizon``:

    ======================  ==================  ==================================================================
    ``rgb``                 (H, C, 3, h, w)     uint8, or float32 in 0..1; cameras in the order asked for
    ``depth``               (H, C, h, w)        float32, m along the optical axis, 0 = nothing
    ``state``               (H, D)              float32, the arrays of ``state`` side by side
    ``action``              (H + A - 1, 7)      float32; row i belongs to observation i, the last A rows are the chunk
    ``observation_mask``    (H,)                bool, False = padding
    ``action_mask``         (H + A - 1,)        bool, False = padding
    ``instruction``         str
    ``language_embedding``  (384,)              float32
    ``subgoal``             str                 text of the present sub-goal
    ``subgoal_type``        (H,)                int64, index in ``language.templates.GOAL_TYPES``; -1 = unknown
    ``subgoal_embedding``   (H, 384)            float32
    ``episode``, ``step``   int                 whose sample this is
    ======================  ==================  ==================================================================

    Keys that were not asked for are absent.

    Args:
        path: a RoboCAS folder, a LeRobot folder of ours, one of another format, or ``trajectory.h5``.
        split: ``train`` or ``val`` by ``data_info.json``, or ``all``.
        observation_horizon: steps looked back on, the present one included; upstream's RT-1: 6, RoboFlamingo: 11.
        action_horizon: actions from the present step on; upstream: 1.
        padding: beyond an episode's ends: ``hold``, ``zero`` or ``drop``, see ``windows.Window``.
        cameras: names, in the order of their stack; empty: no pictures.
        size: width and height to scale pictures to; None: as they are.
        depth: whether to give depth too.
        float_images: RGB as float32 in 0..1 instead of uint8.
        state: arrays of the schema to give as ``state``, see ``STATE_KEYS``.
        embedding: whether to give embeddings of the texts.
        subgoals: whether to give sub-goals.
        normalize: whether to map motion from ``action_space`` to [-1, 1], clipped.
        action_space: in place of that of ``data_info.json``, in its form; a trajectory file is read whole without one.
        rate_hz: of a trajectory's samples; default 5.
        include_failed: also a trajectory's episodes without success.
        transform: called with each sample; has to be picklable where workers are spawned.
        cached_episodes: of how many the arrays are kept, in each worker.

    Raises:
        DatasetError: nothing there, an empty split, a wrong option, something asked for that the dataset does not hold.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        split: Side = "train",
        observation_horizon: int = 6,
        action_horizon: int = 1,
        padding: Padding = "hold",
        cameras: Sequence[str] = UPSTREAM_CAMERAS,
        size: tuple[int, int] | None = UPSTREAM_SIZE,
        depth: bool = False,
        float_images: bool = False,
        state: Sequence[str] = (),
        embedding: bool = False,
        subgoals: bool = False,
        normalize: bool = False,
        action_space: Mapping[str, Any] | None = None,
        rate_hz: float | None = None,
        include_failed: bool = False,
        transform: Callable[[dict[str, Any]], Any] | None = None,
        cached_episodes: int = 64,
    ) -> None:
        self.window = Window(observation_horizon, action_horizon, padding)
        self.cameras, self.size, self.depth, self.float_images = tuple(cameras), size, depth, float_images
        self.state, self.embedding, self.subgoals = tuple(state), embedding, subgoals
        self.transform = transform
        _check_choice("split", split, get_args(Side))
        for key in self.state:
            _check_choice("state", key, STATE_KEYS)
        if size is not None and (len(size) != 2 or min(size) < 1):
            raise DatasetError("no such size", where="size", expected="width and height >= 1", found=size)
        self.source = open_source(path, rate_hz=rate_hz, include_failed=include_failed)
        self.rate_hz = self.source.rate_hz
        """Steps a second."""
        check_holds(self.source, self.cameras, depth=depth, embedding=embedding)
        self._pictures = PictureStack(self.cameras, size, float_images)
        self.episodes: list[int] = self.source.split(split)
        """Numbers of the split's episodes, sorted."""
        if not self.episodes:
            raise EmptySplitError(
                "this split holds no episodes",
                where=path,
                expected=f"some in {split}",
                found=f"{len(self.source.lengths)} in all",
                fix='Add seeds, or pass split="all".',
            )
        samples = {number: self.window.samples(self.source.lengths[number]) for number in self.episodes}
        self._index = SampleIndex(samples)
        if not len(self._index):
            longest = max(self.source.lengths[number] for number in self.episodes)
            needed = observation_horizon + action_horizon if padding == "drop" else 2
            raise DatasetError(
                "no episode is long enough",
                where=path,
                expected=count_of(needed, "step"),
                found=longest,
                fix="Pad them.",
            )
        self._stages = np.concatenate([self._stages_of(number, steps) for number, steps in samples.items()])
        self.scale: ActionScale | None = None
        """How actions are normalised; None: they are not."""
        if normalize:
            self.scale = ActionScale.of(self.source.action_space() if action_space is None else action_space, path)
        self._cached_episodes = max(1, cached_episodes)
        self._cache: OrderedDict[int, dict[str, Any]] = OrderedDict()

    def _stages_of(self, number: int, steps: range) -> NDArray[np.int8]:
        stages = np.full(self.source.lengths[number], -1, dtype=np.int8)
        for goal in self.source.episode(number).goals:
            stages[goal.first : goal.last + 1] = type_index(goal.goal_type)
        return stages[steps.start : steps.stop]

    def __len__(self) -> int:
        return len(self._index)

    def locate(self, index: int) -> tuple[int, int]:
        """Episode number and step of a sample.

        Raises:
            IndexError: there is no such sample.
        """
        return self._index.locate(index)

    def index(self, episode: int, step: int) -> int:
        """The sample of an episode's step.

        Raises:
            DatasetError: the episode is not in this split, or that step has no sample.
        """
        return self._index.index(episode, step)

    def indices(self, episode: int) -> range:
        """Samples of an episode.

        Raises:
            DatasetError: it is not in this split.
        """
        return self._index.indices(episode)

    @property
    def stages(self) -> NDArray[np.int8]:
        """(N,) sub-goal type of each sample's step, index in ``GOAL_TYPES``; -1 = unknown."""
        return self._stages

    def weights(self) -> torch.Tensor:
        """(N,) float64 weights for ``WeightedRandomSampler`` with which each sub-goal type is drawn equally often.

        Raises:
            DatasetError: no sub-goals are known.
        """
        if (self._stages < 0).all():
            raise DatasetError("no sub-goals are known here", where=self.source.root, expected="step_goals")
        return torch.from_numpy(balancing_weights(self._stages))

    def __getitem__(self, index: int) -> Any:
        """One sample.

        Raises:
            IndexError: there is no such sample.
            DatasetError: a file is missing or damaged.
        """
        number, step = self.locate(int(index))
        episode = self._episode(number)
        observed, acted = self.window.observed(step), self.window.acted(step)
        last = len(episode["action"]) - 2  # that an action leaves
        sample: dict[str, Any] = {"episode": number, "step": step}
        sample["observation_mask"] = torch.from_numpy(observed >= 0)
        sample["action_mask"] = torch.from_numpy((acted >= 0) & (acted <= last))
        sample["action"] = self._actions(episode, acted, last)
        for key in ("state", "subgoal_type", "subgoal_embedding"):
            if key in episode:
                sample[key] = self._rows(episode[key], observed, nothing=-1 if key == "subgoal_type" else 0)
        sample["instruction"] = episode["instruction"]
        if self.embedding:
            sample["language_embedding"] = torch.from_numpy(episode["language_embedding"].copy())
        if self.subgoals:
            sample["subgoal"] = episode["texts"][step]
        if self.cameras:
            zero = self.window.padding == "zero"
            sample["rgb"] = self._pictures.read(episode["pictures"], observed, "rgb", zero=zero)
            if self.depth:
                sample["depth"] = self._pictures.read(episode["pictures"], observed, "depth", zero=zero)
        return sample if self.transform is None else self.transform(sample)

    def _actions(self, episode: Mapping[str, Any], acted: NDArray[np.int64], last: int) -> torch.Tensor:
        rows = np.clip(acted, 0, last)
        actions = episode["action"][rows]
        outside = acted != rows
        if self.window.padding == "hold":
            actions[outside, :6] = 0
            actions[acted < 0, 6] = episode["first_command"]  # that of the last one goes on after the end
        if self.scale is not None:
            actions = self.scale.encode(actions)
        if self.window.padding == "zero":
            actions[outside] = 0
        return torch.from_numpy(actions)

    def _rows(self, array: NDArray, observed: NDArray[np.int64], nothing: int) -> torch.Tensor:
        rows = array[np.maximum(observed, 0)]
        if self.window.padding == "zero":
            rows[observed < 0] = nothing
        return torch.from_numpy(rows)

    def _episode(self, number: int) -> dict[str, Any]:
        if number in self._cache:
            self._cache.move_to_end(number)
            return self._cache[number]
        made = read_episode(self.source, number, self.state, embedding=self.embedding, subgoals=self.subgoals)
        if self.cameras:
            made["pictures"] = self.source.episode(number)
        self._cache[number] = made
        if len(self._cache) > self._cached_episodes:
            self._cache.popitem(last=False)
        return made

    def __getstate__(self) -> dict[str, Any]:
        """Leave the cache behind."""
        return {**self.__dict__, "_cache": OrderedDict()}


def _check_choice(where: str, found: object, known: Sequence[str]) -> None:
    if found not in known:
        raise DatasetError("no such choice", where=where, expected=f"one of {', '.join(known)}", found=found)
