"""Demonstrations as a torch dataset: windows of observations and actions, decoded when they are asked for.

What upstream's training loader computes, and what it leaves open: docs/training.md.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import get_worker_info

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.actions import ACTION_ARRAYS, ActionScale, episode_actions
from robocas_ms3.datasets.reader import Episode
from robocas_ms3.datasets.sampling import SampleIndex, balancing_weights
from robocas_ms3.datasets.sources import Split, open_source
from robocas_ms3.datasets.windows import Padding, Window
from robocas_ms3.errors import DatasetError
from robocas_ms3.language.templates import GOAL_TYPES

UPSTREAM_CAMERAS = ("base_camera", "gripper_camera")
UPSTREAM_SIZE = (320, 256)
"""Width and height in pixels."""
STATE_KEYS = tuple(
    spec.name for spec in schema.EPISODE_INFO if spec.shape[:1] == ("T",) and spec.dtype != "str" and not spec.embedding
)
"""Arrays that ``state`` may be made of."""


class RoboCASDataset(torch.utils.data.Dataset):
    """Samples of a RoboCAS folder, or of a trajectory file (state and action only).

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
        path: a RoboCAS folder, or ``trajectory.h5`` of ``robocas generate``.
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
        split: Split = "train",
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
        _check_choice("split", split, get_args(Split))
        for key in self.state:
            _check_choice("state", key, STATE_KEYS)
        if size is not None and (len(size) != 2 or min(size) < 1):
            raise DatasetError("no such size", where="size", expected="width and height >= 1", found=size)
        self.source = open_source(path, rate_hz=rate_hz, include_failed=include_failed)
        self._check_content()
        self.episodes: list[int] = self.source.split(split)
        """Numbers of the split's episodes, sorted."""
        if not self.episodes:
            raise DatasetError(
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
                "no episode is long enough", where=path, expected=f"{needed} steps", found=longest, fix="Pad them."
            )
        self._stages = np.concatenate([self._stages_of(number, steps) for number, steps in samples.items()])
        self.scale: ActionScale | None = None
        """How actions are normalised; None: they are not."""
        if normalize:
            self.scale = ActionScale.of(self.source.action_space() if action_space is None else action_space, path)
        self._cached_episodes = max(1, cached_episodes)
        self._cache: OrderedDict[int, dict[str, Any]] = OrderedDict()
        self._keys = (*ACTION_ARRAYS, *self.state, "language_goal")
        self._keys += ("step_lang_goals", "step_goal_type") * subgoals
        self._keys += ("language_embedding",) * embedding + ("step_goal_embs",) * (embedding and subgoals)
        self._process = -1

    def _check_content(self) -> None:
        source = self.source
        pictures = [camera.name for camera in schema.CAMERAS if camera.name in source.cameras]
        wrong = [camera for camera in self.cameras if camera not in pictures]
        if wrong and not pictures:
            raise DatasetError(
                "there are no pictures here",
                where=source.path,
                expected="cameras=()",
                found=f"cameras={self.cameras}",
                fix="Pass cameras=(), or make pictures with robocas convert.",
            )
        if wrong or len(set(self.cameras)) < len(self.cameras):
            expected = f"some of {', '.join(pictures)}, each once"
            raise DatasetError("no such camera", where=source.path, expected=expected, found=", ".join(self.cameras))
        if self.depth and not (source.has_depth and self.cameras):
            found = "no cameras" if source.has_depth else "no depth"
            raise DatasetError("there is no depth here", where=source.path, found=found, fix="Pass depth=False.")
        if self.embedding and not source.has_embeddings:
            raise DatasetError(
                "there are no embeddings here",
                where=source.path,
                fix="Pass embedding=False, or convert the trajectory with embeddings.",
            )

    def _stages_of(self, number: int, steps: range) -> NDArray[np.int8]:
        stages = np.full(self.source.lengths[number], -1, dtype=np.int8)
        for goal in self.source.goals(number):
            stages[goal.first : goal.last + 1] = _type_index(goal.goal_type)
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
            raise DatasetError("no sub-goals are known here", where=self.source.path, expected="step_goals")
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
        for key in ("instruction", "language_embedding"):
            if key in episode:
                sample[key] = episode[key]
        if self.subgoals:
            sample["subgoal"] = episode["texts"][step]
        if self.cameras:
            self._settle_process()
            sample["rgb"] = self._pictures(episode["pictures"], observed, "rgb")
            if self.depth:
                sample["depth"] = self._pictures(episode["pictures"], observed, "depth")
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

    def _pictures(self, episode: Episode, observed: NDArray[np.int64], kind: Literal["rgb", "depth"]) -> torch.Tensor:
        steps = np.maximum(observed, 0)
        decoded = {int(s): self._stack(episode, int(s), kind) for s in np.unique(steps)}
        shapes = {picture.shape for picture in decoded.values()}
        if len(shapes) > 1:
            raise DatasetError(
                "pictures differ in size", where=episode.folder, found=sorted(shapes), fix="Pass a size."
            )
        stack = np.stack([decoded[int(step)] for step in steps])
        if self.window.padding == "zero":
            stack[observed < 0] = 0
        return torch.from_numpy(stack)

    def _stack(self, episode: Episode, step: int, kind: Literal["rgb", "depth"]) -> NDArray:
        """One step's pictures, cameras first: (C, 3, h, w) or (C, h, w)."""
        shots = []
        for camera in self.cameras:
            picture = episode.rgb(camera, step) if kind == "rgb" else episode.depth(camera, step)
            if (picture.ndim, picture.dtype) != ((3, np.uint8) if kind == "rgb" else (2, np.uint16)):
                raise DatasetError(
                    "not a picture of this kind",
                    where=episode.image_path(camera, kind, step),
                    expected="(H, W, 3) uint8" if kind == "rgb" else "(H, W) uint16",
                    found=f"{picture.shape} {picture.dtype}",
                )
            shots.append(_resize(picture, self.size))
        if len({shot.shape for shot in shots}) > 1:
            found = [shot.shape for shot in shots]
            raise DatasetError("cameras differ in size", where=episode.folder, found=found, fix="Pass a size.")
        stack = np.stack(shots)
        if kind == "depth":
            return stack.astype(np.float32) / 1000
        stack = np.ascontiguousarray(stack.transpose(0, 3, 1, 2))
        return stack.astype(np.float32) / 255 if self.float_images else stack

    def _episode(self, number: int) -> dict[str, Any]:
        if number in self._cache:
            self._cache.move_to_end(number)
            return self._cache[number]
        arrays = self.source.arrays(number, self._keys)
        length = self.source.lengths[number]
        where = f"{self.source.path}, episode {number}"
        for key, array in arrays.items():
            if key not in {"language_goal", "language_embedding"} and len(array) != length:
                raise DatasetError(
                    "another length than the overview says",
                    where=f"{where}, {key}",
                    expected=length,
                    found=len(array),
                )
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise DatasetError("not a number", where=f"{where}, {key}", fix="robocas validate says more.")
        made: dict[str, Any] = {
            "action": episode_actions(arrays),
            "first_command": float(arrays["gripper_status"][0]),
            "instruction": str(arrays["language_goal"]),
        }
        if self.state:
            columns = [arrays[key].reshape(length, -1) for key in self.state]
            made["state"] = np.concatenate(columns, axis=1).astype(np.float32)
        if self.embedding:
            made["language_embedding"] = torch.from_numpy(arrays["language_embedding"])
        if self.subgoals:
            made["texts"] = arrays["step_lang_goals"].tolist()
            made["subgoal_type"] = np.array([_type_index(kind) for kind in arrays["step_goal_type"].tolist()])
            if self.embedding:
                made["subgoal_embedding"] = arrays["step_goal_embs"]
        if self.cameras:
            made["pictures"] = self.source.episode(number)
        self._cache[number] = made
        if len(self._cache) > self._cached_episodes:
            self._cache.popitem(last=False)
        return made

    def _settle_process(self) -> None:
        """In a worker: one thread for OpenCV, whose pool does not survive a fork."""
        if self._process != os.getpid():
            self._process = os.getpid()
            if get_worker_info() is not None:
                cv2.setNumThreads(0)

    def __getstate__(self) -> dict[str, Any]:
        """Leave the cache behind."""
        return {**self.__dict__, "_cache": OrderedDict(), "_process": -1}


def _check_choice(where: str, found: object, known: Sequence[str]) -> None:
    if found not in known:
        raise DatasetError("no such choice", where=where, expected=f"one of {', '.join(known)}", found=found)


def _type_index(goal_type: str) -> int:
    return _TYPE_INDEX.get(goal_type, -1)


_TYPE_INDEX: dict[str, int] = {kind: index for index, kind in enumerate(GOAL_TYPES)}


def _resize(picture: NDArray, size: tuple[int, int] | None) -> NDArray:
    """Scale to width and height: RGB by areas, depth by the nearest pixel, which mixes no distances."""
    if size is None or picture.shape[1::-1] == tuple(size):
        return picture
    smaller = size[0] <= picture.shape[1] and size[1] <= picture.shape[0]
    if picture.ndim == 2:
        return cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST_EXACT)
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
