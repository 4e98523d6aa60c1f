"""Demonstrations as a torch dataset: windows of observations and actions, decoded when they are asked for.

What upstream's training loader computes, and what it leaves open: docs/training.md.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError, EmptySplitError
from robocas_ms3.core.words import count_of
from robocas_ms3.datasets.actions import ActionScale
from robocas_ms3.datasets.formats import open_source
from robocas_ms3.datasets.training.options import SampleOptions
from robocas_ms3.datasets.training.sample_arrays import check_holds, read_episode, type_index
from robocas_ms3.datasets.training.sample_pictures import PictureStack


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
        options: what the samples hold.
        transform: called with each sample; has to be picklable where workers are spawned.

    Raises:
        DatasetError: nothing there, an empty split, a wrong option, something asked for that the dataset does not hold.
    """

    def __init__(
        self,
        path: Path | str,
        options: SampleOptions | None = None,
        *,
        transform: Callable[[dict[str, Any]], Any] | None = None,
    ) -> None:
        self.options = options = options or SampleOptions()
        self.transform = transform
        cameras = tuple(options.cameras)
        self.source = open_source(path, rate_hz=options.rate_hz, include_failed=options.include_failed)
        self.rate_hz = self.source.rate_hz
        """Steps a second."""
        check_holds(self.source, cameras, depth=options.depth, embedding=options.embedding)
        self._pictures = PictureStack(cameras, options.size, options.float_images)
        self.episodes: list[int] = self.source.split(options.split)
        """Numbers of the split's episodes, sorted."""
        if not self.episodes:
            raise EmptySplitError(
                "this split holds no episodes",
                where=path,
                expected=f"some in {options.split}",
                found=f"{len(self.source.lengths)} in all",
                fix='Add seeds, or pass split="all".',
            )
        self._steps = {number: options.samples(self.source.lengths[number]) for number in self.episodes}
        self._offsets = np.cumsum([0, *map(len, self._steps.values())])
        if not len(self):
            longest = max(self.source.lengths[number] for number in self.episodes)
            needed = options.observation_horizon + options.action_horizon if options.padding == "drop" else 2
            raise DatasetError(
                "no episode is long enough",
                where=path,
                expected=count_of(needed, "step"),
                found=longest,
                fix="Pad them.",
            )
        self.stages = np.concatenate([self._stages_of(number, within) for number, within in self._steps.items()])
        """(N,) int8 sub-goal type of each sample's step, index in ``GOAL_TYPES``; -1 = unknown."""
        self.scale: ActionScale | None = None
        """How actions are normalised; None: they are not."""
        if options.normalize:
            space = self.source.action_space() if options.action_space is None else options.action_space
            self.scale = ActionScale.of(space, path)
        self._cache: OrderedDict[int, dict[str, Any]] = OrderedDict()

    def _stages_of(self, number: int, steps: range) -> NDArray[np.int8]:
        stages = np.full(self.source.lengths[number], -1, dtype=np.int8)
        for goal in self.source.episode(number).goals:
            stages[goal.first : goal.last + 1] = type_index(goal.goal_type)
        return stages[steps.start : steps.stop]

    def __len__(self) -> int:
        return int(self._offsets[-1])

    def locate(self, index: int) -> tuple[int, int]:
        """Return episode number and step of a sample.

        Raises:
            IndexError: there is no such sample.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        index %= len(self)
        place = int(np.searchsorted(self._offsets, index, side="right")) - 1
        number = self.episodes[place]
        return number, self._steps[number][index - int(self._offsets[place])]

    def indices(self, episode: int) -> range:
        """Return the samples of an episode.

        Raises:
            DatasetError: the episode is not in this split.
        """
        if episode not in self._steps:
            raise DatasetError("no such episode in this split", where=f"episode {episode}")
        place = self.episodes.index(episode)
        return range(int(self._offsets[place]), int(self._offsets[place + 1]))

    def index(self, episode: int, step: int) -> int:
        """Return the sample of an episode's step.

        Raises:
            DatasetError: the episode is not in this split, or that step has no sample.
        """
        found, steps = self.indices(episode), self._steps[episode]
        if step not in steps:
            expected = f"{steps[0]} to {steps[-1]}" if steps else "none"
            raise DatasetError("no sample of this step", where=f"episode {episode}", expected=expected, found=step)
        return found[step - steps.start]

    def weights(self) -> torch.Tensor:
        """(N,) float64 weights for ``WeightedRandomSampler`` with which each sub-goal type is drawn equally often.

        Raises:
            DatasetError: no sub-goals are known.
        """
        if (self.stages < 0).all():
            raise DatasetError("no sub-goals are known here", where=self.source.root, expected="step_goals")
        _, stages, counts = np.unique(self.stages, return_inverse=True, return_counts=True)
        return torch.from_numpy(1.0 / (len(counts) * counts[stages]))

    def __getitem__(self, index: int) -> Any:
        """One sample.

        Raises:
            IndexError: there is no such sample.
            DatasetError: a file is missing or damaged.
        """
        number, step = self.locate(int(index))
        episode = self._episode(number)
        observed, acted = self.options.observed(step), self.options.acted(step)
        last = len(episode["action"]) - 2  # that an action leaves
        sample: dict[str, Any] = {"episode": number, "step": step}
        sample["observation_mask"] = torch.from_numpy(observed >= 0)
        sample["action_mask"] = torch.from_numpy((acted >= 0) & (acted <= last))
        sample["action"] = self._actions(episode, acted, last)
        for key in ("state", "subgoal_type", "subgoal_embedding"):
            if key in episode:
                sample[key] = self._rows(episode[key], observed, nothing=-1 if key == "subgoal_type" else 0)
        sample["instruction"] = episode["instruction"]
        if self.options.embedding:
            sample["language_embedding"] = torch.from_numpy(episode["language_embedding"].copy())
        if self.options.subgoals:
            sample["subgoal"] = episode["texts"][step]
        if self.options.cameras:
            zero = self.options.padding == "zero"
            sample["rgb"] = self._pictures.read(episode["pictures"], observed, "rgb", zero=zero)
            if self.options.depth:
                sample["depth"] = self._pictures.read(episode["pictures"], observed, "depth", zero=zero)
        return sample if self.transform is None else self.transform(sample)

    def _actions(self, episode: Mapping[str, Any], acted: NDArray[np.int64], last: int) -> torch.Tensor:
        rows = np.clip(acted, 0, last)
        actions = episode["action"][rows]
        outside = acted != rows
        if self.options.padding == "hold":
            actions[outside, :6] = 0
            actions[acted < 0, 6] = episode["first_command"]  # that of the last one goes on after the end
        if self.scale is not None:
            actions = self.scale.encode(actions)
        if self.options.padding == "zero":
            actions[outside] = 0
        return torch.from_numpy(actions)

    def _rows(self, array: NDArray, observed: NDArray[np.int64], nothing: int) -> torch.Tensor:
        rows = array[np.maximum(observed, 0)]
        if self.options.padding == "zero":
            rows[observed < 0] = nothing
        return torch.from_numpy(rows)

    def _episode(self, number: int) -> dict[str, Any]:
        if number in self._cache:
            self._cache.move_to_end(number)
            return self._cache[number]
        wanted = self.options
        made = read_episode(
            self.source, number, tuple(wanted.state), embedding=wanted.embedding, subgoals=wanted.subgoals
        )
        if self.options.cameras:
            made["pictures"] = self.source.episode(number)
        self._cache[number] = made
        if len(self._cache) > max(1, self.options.cached_episodes):
            self._cache.popitem(last=False)
        return made

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_cache": OrderedDict()}
