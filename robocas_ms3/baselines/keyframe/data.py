"""Training samples of `keyframe`: images of decisions, instructions, and grasps with their outcome."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.baselines.baseline import Batch, OnRead, Split, make_empty_split_error
from robocas_ms3.baselines.keyframe.config import KeyframeConfig
from robocas_ms3.baselines.keyframe.decision_files import (
    RENDER_COMMAND,
    DecisionFile,
    DecisionImage,
    check_same_cameras,
    open_decisions,
)
from robocas_ms3.baselines.keyframe.gripper_crops import CELLS, CROP_CHANNELS, POSE_FEATURES, augment_crops, make_crops
from robocas_ms3.baselines.keyframe.handles import Handle, find_pulled_handle
from robocas_ms3.baselines.keyframe.image_crops import augment_image, draw_crop, resize_inputs
from robocas_ms3.baselines.keyframe.network import FIRST_NAME, HANDLE, OFFSET_UNIT, PULL_UNIT, STRIDE, make_inputs
from robocas_ms3.baselines.keyframe.observed_scene import (
    find_table_height,
    is_above_table,
    is_below_camera,
    is_in_workspace,
    sample_pixels,
    unproject,
)
from robocas_ms3.baselines.training.scenes import TrainingScenes, name_config, select_scene_settings
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import from_wxyz
from robocas_ms3.datasets.sources.episode_source import FIRST_SLOT, NOTHING, ROBOT
from robocas_ms3.datasets.sources.split import split_by_seed
from robocas_ms3.datasets.training.target_instructions import draw_target_instruction, find_relations
from robocas_ms3.demos.candidates.candidates_file import FILE_NAME
from robocas_ms3.demos.candidates.tables import Arrays
from robocas_ms3.scenes.language.embed import DIMENSIONS, TextEmbedder
from robocas_ms3.scenes.relations import RELATIONS

_CROPS = 64  # random crops of each image per epoch of the training; a sample is one of them
_TEXTS = 4  # instructions per image of a batch
_DRAWN_TEXTS = 3  # instructions per object and decision, of which one is from the paraphrases for training
_FIXED_CAMERA_SCALE = (0.6, 1.2)  # of crops of other cameras than the one on the hand, which are farther away
_MIN_POINTS = 15  # on the object of a grasp
_POINT_STEP = 2  # pixels between points of the cloud
_BLOCKED = ("straight_line_blocked", "goal_in_collision")  # reasons of failures


@dataclass(frozen=True)
class _Sample:
    """Image of a decision: number of the file, row of the decision, camera."""

    file: int
    row: int
    camera: str


@dataclass(frozen=True)
class _Text:
    """Instruction: index of its embedding, class of its name, class of its relation."""

    embedding: int
    name: int
    relation: int


class KeyframeSamples:
    """Images of the decisions in candidates files.

    Args:
        config: configuration of the run.
        path: a ``candidates.h5``, or a folder that contains such files, also in subfolders. Each file has images with
            views, depth and segmentation next to it.
        split: ``train`` or ``val``, by seed.
        on_read: called with the number of files read, and the number of all files.

    Raises:
        DatasetError: there is no file; a file has another version; or its images are missing, or have no depth,
            segmentation or views, or another size.
        EmptySplitError: the split has no decision.
    """

    def __init__(
        self, config: KeyframeConfig, path: Path, split: Split, on_read: OnRead = lambda done, total: None
    ) -> None:
        self._config, self._split = config, split
        paths = [path] if path.is_file() else sorted(path.rglob(FILE_NAME))
        if not paths:
            fix = f"Pass a folder of robocas generate --record-candidates, and render its images: {RENDER_COMMAND}."
            raise DatasetError("no candidates file", where=path, expected=FILE_NAME, fix=fix)
        self._files: list[DecisionFile] = []
        for number, one in enumerate(paths):
            self._files.append(open_decisions(one, config.image_size))
            on_read(number + 1, len(paths))
        check_same_cameras(self._files)
        names = sorted(
            {str(name) for file in self._files for name in np.unique(file.candidates.decisions["object_name"]) if name}
        )
        self._class_of = {name: FIRST_NAME + number for number, name in enumerate(names)}
        rows = self._split_rows(split)
        self._embeddings, self._texts = self._draw_texts(rows)
        rows = [place for place in rows if self._texts[place]]  # an instruction can name an object
        if not rows:
            raise make_empty_split_error(path, split)
        self._samples = [
            _Sample(number, row, camera) for number, row in rows for camera in self._cameras_of(number, row)
        ]
        self._handles = {place: handle for place in rows if (handle := self._find_handle(*place)) is not None}
        self.episodes = len({(number, int(self._decisions(number)["seed"][row])) for number, row in rows})
        first = self._files[0]
        self.facts: dict[str, Any] = {
            "names": names,
            "cameras": [*first.other_cameras, first.hand_cameras[0]],
            "hand_camera": first.hand_cameras[0],
            "image_sizes": {
                camera: list(config.image_size) for camera in (*first.other_cameras, first.hand_cameras[0])
            },
        }
        self.scenes = self._describe_scenes()

    def __len__(self) -> int:
        return len(self._samples) * (_CROPS if self._split == "train" else 1)

    def __getitems__(self, indices: list[int]) -> Batch:
        samples = [
            self._read(
                self._samples[index % len(self._samples)], np.random.default_rng([self._config.train.seed, index])
            )
            for index in indices
        ]
        return {name: torch.from_numpy(np.stack([one[name] for one in samples])) for name in samples[0]}

    def _decisions(self, number: int) -> Any:
        return self._files[number].candidates.decisions

    def _split_rows(self, split: Split) -> list[tuple[int, int]]:
        """Return the decisions of a split with an empty gripper: number of the file and row."""
        found = []
        for number in range(len(self._files)):
            decisions = self._decisions(number)
            seeds = dict(enumerate(decisions["seed"].tolist()))
            chosen = split_by_seed(seeds)[split == "val"]
            found += [(number, row) for row in chosen if decisions["held_slot"][row] < 0]
        return found

    def _find_handle(self, number: int, row: int) -> Handle | None:
        """Return the handle that a decision pulls, or that an earlier decision of the same seed has pulled, or None."""
        file, decisions = self._files[number], self._decisions(number)
        if not np.isfinite(decisions["opening"][row]):
            return None
        for earlier in range(row, row - int(decisions["decision"][row]) - 1, -1):
            if decisions["kind"][earlier] == "pull":
                handle = find_pulled_handle(file.candidates.decision(earlier).candidates)
                if handle is not None:
                    return handle if earlier == row else handle.move_to_end()
        return None

    def _cameras_of(self, number: int, row: int) -> list[str]:
        file = self._files[number]
        decisions = self._decisions(number)
        is_survey = decisions["decision"][row] == 0 or np.isfinite(decisions["opening"][row])
        return [*file.hand_cameras[1:], *((*file.other_cameras, file.hand_cameras[0]) if is_survey else ())]

    def _draw_texts(
        self, rows: list[tuple[int, int]]
    ) -> tuple[NDArray[np.float32], dict[tuple[int, int], list[_Text]]]:
        """Draw instructions for the objects of each decision; return all embeddings, and the texts by decision."""
        texts: dict[str, int] = {}
        found: dict[tuple[int, int], list[_Text]] = {}
        configs = [file.candidates.recorded_env.task_config() for file in self._files]
        for number, row in rows:
            decisions, config = self._decisions(number), configs[number]
            paraphrased = config.model_copy(
                update={"language": config.language.model_copy(update={"split": "train", "synonyms": True})}
            )
            names = np.where(decisions["present"][row], decisions["object_name"][row], "")
            xy = decisions["object_in_base"][row][:, :2]
            rng = np.random.default_rng([int(decisions["seed"][row]), int(decisions["decision"][row])])
            one: list[_Text] = []
            for slot in np.flatnonzero(names != "").tolist():
                for relation in find_relations(config, names, xy, slot):
                    for draw in range(_DRAWN_TEXTS):
                        text = draw_target_instruction(paraphrased if draw == 0 else config, names, slot, relation, rng)
                        name = self._class_of[str(names[slot])] - FIRST_NAME
                        number_of = 0 if relation is None else 1 + RELATIONS.index(relation)
                        one.append(_Text(texts.setdefault(text, len(texts)), name, number_of))
            found[number, row] = one
        embeddings = TextEmbedder()(texts) if texts else np.zeros((0, DIMENSIONS), np.float32)
        return embeddings, found

    def _describe_scenes(self) -> TrainingScenes:
        tasks, objects, configs = set[str](), set[str](), dict[str, dict[str, Any]]()
        for file in self._files:
            config = file.candidates.recorded_env.task_config()
            tasks.add(config.task)
            objects |= {str(one) for one in np.unique(file.candidates.decisions["object_id"]) if one}
            settings = select_scene_settings(config)
            if settings not in configs.values():
                configs[name_config(file.candidates.recorded_env.kwargs.get("config", config.task), configs)] = settings
        return TrainingScenes(tasks=sorted(tasks), objects=sorted(objects), configs=configs)

    def _read(self, sample: _Sample, rng: np.random.Generator) -> dict[str, NDArray[Any]]:
        file, row, camera = self._files[sample.file], sample.row, sample.camera
        is_train, is_on_hand = self._split == "train", camera in file.hand_cameras
        image = file.read_image(row, camera)
        scale = self._config.crop_scale if is_on_hand else _FIXED_CAMERA_SCALE
        found, handle = file.candidates.decision(row).candidates, self._handles.get((sample.file, row))
        is_object = image.segmentation >= FIRST_SLOT
        if handle is not None:
            points, valid = unproject(image.depth, image.intrinsics, image.camera_in_base)
            is_object |= valid & handle.contains(points)
        crop = image.crop(*draw_crop(is_object, self._config.crop_size, scale, rng))
        inputs = make_inputs(crop.rgb, crop.depth, crop.intrinsics, crop.camera_in_base)
        inputs = resize_inputs(inputs, self._config.crop_size)
        label, offset = self._make_labels(file, row, crop, handle)
        pull = _make_pull(crop, handle)
        if is_train:
            vectors = [offset, *pull.reshape(3, 3, 1, 1)]
            inputs, label, (offset, *pulls) = augment_image(inputs, label, vectors, rng, upside_down=is_on_hand)
            pull = np.concatenate(pulls).ravel()
        crops, poses, outcome = self._read_grasps(found, image, rng)
        if is_train:
            crops, poses = augment_crops(crops, poses, rng)
        texts = self._texts[sample.file, row]
        chosen = [texts[number] for number in rng.integers(len(texts), size=_TEXTS)]
        return {
            "image": np.ascontiguousarray(inputs, np.float32),
            "label": np.ascontiguousarray(label, np.int64),
            "offset": np.ascontiguousarray(offset, np.float32),
            "pull": np.ascontiguousarray(pull, np.float32),
            "text": self._embeddings[[text.embedding for text in chosen]],
            "name": np.array([text.name for text in chosen]),
            "relation": np.array([text.relation for text in chosen]),
            "crop": crops,
            "pose": poses,
            "outcome": outcome,
        }

    def _make_labels(
        self, file: DecisionFile, row: int, crop: DecisionImage, handle: Handle | None
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return the class (h, w) and the offset (3, h, w) of each cell of a crop."""
        width, height = (length // STRIDE for length in self._config.crop_size)
        rows = ((np.arange(height) + 0.5) * crop.depth.shape[0] / height).astype(np.int64)
        columns = ((np.arange(width) + 0.5) * crop.depth.shape[1] / width).astype(np.int64)
        values = crop.segmentation[np.ix_(rows, columns)]
        names = file.candidates.decisions["object_name"][row]
        classes, centers = np.zeros(256, np.uint8), np.zeros((256, 3))
        classes[:FIRST_SLOT] = range(FIRST_SLOT)
        classes[FIRST_SLOT : FIRST_SLOT + len(names)] = [self._class_of.get(str(name), 0) for name in names]
        centers[FIRST_SLOT : FIRST_SLOT + len(names)] = np.nan_to_num(file.centers[row])
        points, _ = unproject(crop.depth, crop.intrinsics, crop.camera_in_base, (rows, columns))
        label, ends = classes[values], centers[values]
        if handle is not None:
            is_handle = (values == NOTHING) & handle.contains(points)
            label[is_handle], ends[is_handle] = HANDLE, handle.position
        in_camera = (ends - points) @ crop.camera_in_base[:3, :3] / OFFSET_UNIT
        in_camera[label < HANDLE] = 0
        return label, in_camera.transpose(2, 0, 1).astype(np.float32)

    def _read_grasps(
        self, found: Arrays, image: DecisionImage, rng: np.random.Generator
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Return crops, pose features and outcomes of some candidates whose object is visible in an image."""
        count = self._config.grasps
        crops = np.zeros((count, CROP_CHANNELS, CELLS, CELLS), np.float32)
        poses, outcome = np.zeros((count, POSE_FEATURES), np.float32), np.full(count, -1.0, np.float32)
        pixels = sample_pixels(image.depth.shape, _POINT_STEP)
        points, valid = unproject(image.depth, image.intrinsics, image.camera_in_base, pixels)
        values = image.segmentation[np.ix_(*pixels)]
        valid &= (values != ROBOT) & is_in_workspace(points)
        values, points = values[valid], points[valid]
        others = points[(values == NOTHING) & is_below_camera(points, image.camera_in_base)]
        if not len(others):
            return crops, poses, outcome
        is_held = found["success"] | found["held"]  # also where the object could not be placed afterwards
        table, number = find_table_height(others, points[values >= FIRST_SLOT]), 0
        kept = is_above_table(points, table)
        values, points = values[kept], points[kept]
        for index in rng.permutation(np.flatnonzero(find_labelled_grasps(found))).tolist():
            mask = values == FIRST_SLOT + int(found["slot"][index])
            if number < count and mask.sum() >= _MIN_POINTS:
                grasp = from_wxyz(found["start_in_base"][index].astype(np.float64))[None]
                one, feature = make_crops(points, mask.astype(np.float32), grasp, table)
                crops[number], poses[number], outcome[number] = one[0], feature[0], float(is_held[index])
                number += 1
        return crops, poses, outcome


def find_labelled_grasps(candidates: Arrays) -> NDArray[np.bool_]:
    """Return which candidates (N,) are grasps or lifts whose success depends on the scene alone.

    A candidate that could not be planned is a failed grasp if the gripper or the arm would touch an obstacle. If it is
    out of reach, its success is unknown.
    """
    reasons = np.array([text.rpartition(": ")[2] for text in candidates["failure"].tolist()])
    known = candidates["feasible"] | np.isin(reasons, _BLOCKED)
    return known & np.isin(candidates["primitive"], ("grasp", "lift")) & np.isfinite(candidates["start_in_base"][:, 0])


def _make_pull(image: DecisionImage, handle: Handle | None) -> NDArray[np.float64]:
    """Return the pull (9,) of a handle in the camera frame; zeros without a handle."""
    if handle is None:
        return np.zeros(9)
    vectors = np.stack([handle.motion / PULL_UNIT, handle.approach, handle.bar])
    return (vectors @ image.camera_in_base[:3, :3]).ravel()
