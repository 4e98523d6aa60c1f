"""Training samples of `keyframe`: images of decisions, instructions, and grasps with their outcome."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.baselines.baseline import Batch, OnRead, Split, make_empty_split_error
from robocas_ms3.baselines.keyframe.config import KeyframeConfig
from robocas_ms3.baselines.keyframe.gripper_crops import CELLS, CROP_CHANNELS, POSE_FEATURES, augment_crops, make_crops
from robocas_ms3.baselines.keyframe.network import FIRST_NAME, OFFSET_UNIT, STRIDE, make_inputs
from robocas_ms3.baselines.keyframe.observed_scene import find_table_height, is_in_workspace, sample_pixels, unproject
from robocas_ms3.baselines.training.scenes import TrainingScenes, select_scene_settings
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import from_wxyz, transform_points
from robocas_ms3.datasets.candidate_images.images_file import CandidateImages, hash_decisions, images_path
from robocas_ms3.datasets.sources.episode_source import FIRST_SLOT, ROBOT
from robocas_ms3.datasets.sources.split import split_by_seed
from robocas_ms3.datasets.training.target_instructions import draw_target_instruction, find_relations
from robocas_ms3.demos.candidates.candidates_file import FILE_NAME, CandidateFile
from robocas_ms3.scenes.language.embed import DIMENSIONS, TextEmbedder
from robocas_ms3.scenes.relations import RELATIONS

_TEXTS = 4  # instructions per image of a batch
_DRAWN_TEXTS = 3  # instructions per object and decision, of which one is from the paraphrases for training
_FIXED_CAMERA_SCALE = (0.35, 0.8)  # of crops of other cameras than the one on the hand, which are farther away
_OBJECT_CROPS = 0.9  # fraction of crops near an object
_MIN_POINTS = 15  # on the object of a grasp
_POINT_STEP = 2  # pixels between points of the cloud
_RENDER = "robocas render-candidates CANDIDATES --looks 3 --segmentation"


@dataclass(frozen=True)
class _File:
    """A candidates file with its images, and by row and slot the centres of the objects (D, K, 3) in the base frame."""

    candidates: CandidateFile
    images: CandidateImages
    hand_cameras: tuple[str, ...]
    other_cameras: tuple[str, ...]
    centers: NDArray[np.float64]


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
            looks, depth and segmentation next to it.
        split: ``train`` or ``val``, by seed.
        on_read: called with the number of files read, and the number of all files.

    Raises:
        DatasetError: there is no file; a file has another version; or its images are missing, or have no depth,
            segmentation or looks, or another size.
        EmptySplitError: the split has no decision.
    """

    def __init__(
        self, config: KeyframeConfig, path: Path, split: Split, on_read: OnRead = lambda done, total: None
    ) -> None:
        self._config, self._split = config, split
        paths = [path] if path.is_file() else sorted(path.rglob(FILE_NAME))
        if not paths:
            fix = f"Pass a folder of robocas generate --record-candidates, and render its images: {_RENDER}."
            raise DatasetError("no candidates file", where=path, expected=FILE_NAME, fix=fix)
        self._files: list[_File] = []
        for number, one in enumerate(paths):
            self._files.append(_open(one, config.image_size))
            on_read(number + 1, len(paths))
        names = sorted(
            {str(name) for file in self._files for name in np.unique(file.candidates.decisions["object_name"]) if name}
        )
        self._class_of = {name: FIRST_NAME + number for number, name in enumerate(names)}
        rows = self._split_rows(split)
        if not rows:
            raise make_empty_split_error(path, split)
        self._samples = [
            _Sample(number, row, camera) for number, row in rows for camera in self._cameras_of(number, row)
        ]
        self.episodes = len({(number, int(self._decisions(number)["seed"][row])) for number, row in rows})
        self._embeddings, self._texts = self._draw_texts(rows)
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
        return len(self._samples)

    def __getitems__(self, indices: list[int]) -> Batch:
        samples = [self._read(self._samples[index], np.random.default_rng(self._seed(index))) for index in indices]
        return {name: torch.from_numpy(np.stack([one[name] for one in samples])) for name in samples[0]}

    def _seed(self, index: int) -> int | None:
        return None if self._split == "train" else index  # each epoch has other crops; each validation has the same

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

    def _cameras_of(self, number: int, row: int) -> list[str]:
        file = self._files[number]
        is_first = self._decisions(number)["decision"][row] == 0
        return [*file.hand_cameras[1:], *((*file.other_cameras, file.hand_cameras[0]) if is_first else ())]

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
            name = Path(str(file.candidates.recorded_env.kwargs.get("config", config.task))).stem
            configs[name] = select_scene_settings(config)
        return TrainingScenes(tasks=sorted(tasks), objects=sorted(objects), configs=configs)

    def _read(self, sample: _Sample, rng: np.random.Generator) -> dict[str, NDArray[Any]]:
        file, row, camera = self._files[sample.file], sample.row, sample.camera
        images = file.images
        fx, fy, cx, cy = images.intrinsic(row, camera)
        intrinsics, pose = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), images.camera_in_base(row, camera)
        rgb, depth, segmentation = images.rgb(row, camera), images.depth(row, camera), images.segmentation(row, camera)
        is_look = camera in file.hand_cameras
        scale = self._config.crop_scale if is_look else _FIXED_CAMERA_SCALE
        crop = _draw_crop(segmentation, self._config.crop_size, scale, rng)
        part = (slice(crop[1], crop[1] + crop[3]), slice(crop[0], crop[0] + crop[2]))
        shifted = intrinsics - np.array([[0, 0, crop[0]], [0, 0, crop[1]], [0, 0, 0]])
        image = make_inputs(rgb[part], depth[part], shifted, pose)
        label, offset = self._make_labels(file, row, depth[part], segmentation[part], shifted, pose)
        image = _resize(image, self._config.crop_size)
        if self._split == "train":
            image, label, offset = _augment(image, label, offset, rng, upside_down=is_look)
        grasps = self._read_grasps(file, row, depth, segmentation, intrinsics, pose, rng)
        texts = self._texts[sample.file, row]
        chosen = [texts[number] for number in rng.integers(len(texts), size=_TEXTS)]
        return {
            "image": np.ascontiguousarray(image, np.float32),
            "label": np.ascontiguousarray(label, np.int64),
            "offset": np.ascontiguousarray(offset, np.float32),
            "text": self._embeddings[[text.embedding for text in chosen]],
            "name": np.array([text.name for text in chosen]),
            "relation": np.array([text.relation for text in chosen]),
            **grasps,
        }

    def _make_labels(
        self,
        file: _File,
        row: int,
        depth: NDArray,
        segmentation: NDArray[np.uint8],
        intrinsics: NDArray,
        pose: NDArray,
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return the class (h, w) and the offset (3, h, w) of each cell of a crop."""
        width, height = (length // STRIDE for length in self._config.crop_size)
        rows = ((np.arange(height) + 0.5) * depth.shape[0] / height).astype(np.int64)
        columns = ((np.arange(width) + 0.5) * depth.shape[1] / width).astype(np.int64)
        values = segmentation[np.ix_(rows, columns)]
        names = file.candidates.decisions["object_name"][row]
        classes, centers = np.zeros(256, np.uint8), np.zeros((256, 3))
        classes[:FIRST_SLOT] = range(FIRST_SLOT)
        classes[FIRST_SLOT : FIRST_SLOT + len(names)] = [self._class_of.get(str(name), 0) for name in names]
        centers[FIRST_SLOT : FIRST_SLOT + len(names)] = np.nan_to_num(file.centers[row])
        points, _ = unproject(depth, intrinsics, pose, (rows, columns))
        in_camera = (centers[values] - points) @ pose[:3, :3] / OFFSET_UNIT
        in_camera[values < FIRST_SLOT] = 0
        return classes[values], in_camera.transpose(2, 0, 1).astype(np.float32)

    def _read_grasps(
        self,
        file: _File,
        row: int,
        depth: NDArray,
        segmentation: NDArray[np.uint8],
        intrinsics: NDArray,
        pose: NDArray,
        rng: np.random.Generator,
    ) -> dict[str, NDArray[Any]]:
        count = self._config.grasps
        crops = np.zeros((count, CROP_CHANNELS, CELLS, CELLS), np.float32)
        poses, outcome = np.zeros((count, POSE_FEATURES), np.float32), np.full(count, -1.0, np.float32)
        found = file.candidates.decision(row).candidates
        known = np.isin(found["primitive"], ("grasp", "lift")) & np.isfinite(found["start_in_base"][:, 0])
        known &= found["feasible"] | np.char.endswith(found["failure"], "collision")
        pixels = sample_pixels(depth.shape, _POINT_STEP)
        points, valid = unproject(depth, intrinsics, pose, pixels)
        values = segmentation[np.ix_(*pixels)]
        valid &= (values != ROBOT) & is_in_workspace(points)
        values, points = values[valid], points[valid]
        others = points[values == 0][:, 2]
        if len(others):
            table, number = find_table_height(others), 0
            for index in rng.permutation(np.flatnonzero(known)).tolist():
                mask = values == FIRST_SLOT + int(found["slot"][index])
                if number == count or mask.sum() < _MIN_POINTS:
                    continue
                grasp = from_wxyz(found["start_in_base"][index].astype(np.float64))[None]
                one, feature = make_crops(points, mask.astype(np.float32), grasp, table)
                crops[number], poses[number], outcome[number] = one[0], feature[0], float(found["success"][index])
                number += 1
        if self._split == "train":
            crops, poses = augment_crops(crops, poses, rng)
        return {"crop": crops, "pose": poses, "outcome": outcome}


def _open(path: Path, size: tuple[int, int]) -> _File:
    file = CandidateFile(path)
    images = CandidateImages(images_path(path), hash_decisions(file))
    specs = file.recorded_env.cameras()
    hand = [camera.name for camera in specs if camera.mount == "hand" and camera.name in images.cameras]
    looks = [name for name in images.cameras if name.startswith("look_")]
    for what, has, expected in (
        ("depth", images.has_depth, "depth images"),
        ("segmentation", images.has_segmentation, "segmentation images"),
        ("looks", bool(looks and hand), "looks of a camera on the hand"),
        ("size", images.size == size, f"{size[0]} x {size[1]} pixels"),
    ):
        if not has:
            found = f"{images.size[0]} x {images.size[1]} pixels" if what == "size" else f"no {what}"
            fix = f"Render the images again: {_RENDER} --size {size[0]} {size[1]} --overwrite."
            raise DatasetError(
                "these images do not suit keyframe", where=images.path, expected=expected, found=found, fix=fix
            )
    others = [camera.name for camera in specs if camera.mount != "hand" and camera.name in images.cameras]
    return _File(file, images, (hand[0], *looks), tuple(others), _compute_centers(file))


def _compute_centers(file: CandidateFile) -> NDArray[np.float64]:
    """Return the centres (D, K, 3) of the objects in the arm's base frame, m; NaN in empty slots."""
    decisions, pack = file.decisions, load_pack(file.recorded_env.kwargs.get("pack", "builtin"))
    ids = [str(one) for one in np.unique(decisions["object_id"]) if one]
    unknown = sorted(set(ids) - set(pack.objects))
    if unknown:
        fix = "Install the pack of the recording."
        raise DatasetError(
            "unknown objects", where=file.path, expected=f"objects of {pack.root}", found=unknown, fix=fix
        )
    middles = {one: pack.objects[one].surface_points().mean(axis=0) for one in ids}
    centers = np.full((*decisions["present"].shape, 3), np.nan)
    for row, slot in np.argwhere(decisions["present"]).tolist():
        pose = from_wxyz(decisions["object_in_base"][row, slot].astype(np.float64))
        centers[row, slot] = transform_points(pose, middles[str(decisions["object_id"][row, slot])][None])[0]
    return centers


def _draw_crop(
    segmentation: NDArray[np.uint8], size: tuple[int, int], scale: tuple[float, float], rng: np.random.Generator
) -> tuple[int, int, int, int]:
    """Draw a crop, mostly near an object; return left, top, width and height in pixels."""
    height, width = segmentation.shape
    factor = np.exp(rng.uniform(*np.log(scale)))
    crop_width, crop_height = min(width, int(size[0] * factor)), min(height, int(size[1] * factor))
    rows, columns = np.nonzero(segmentation[::4, ::4] >= FIRST_SLOT)
    if len(rows) and rng.random() < _OBJECT_CROPS:
        index = rng.integers(len(rows))
        x = 4 * columns[index] + rng.integers(-crop_width // 3, crop_width // 3 + 1)
        y = 4 * rows[index] + rng.integers(-crop_height // 3, crop_height // 3 + 1)
    else:
        x, y = rng.integers(width), rng.integers(height)
    left = int(np.clip(x - crop_width // 2, 0, width - crop_width))
    top = int(np.clip(y - crop_height // 2, 0, height - crop_height))
    return left, top, crop_width, crop_height


def _resize(image: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Scale an image (5, H, W) to a width and height; heights and depths are not interpolated."""
    colors = [cv2.resize(channel, size, interpolation=cv2.INTER_LINEAR) for channel in image[:3]]
    distances = [cv2.resize(channel, size, interpolation=cv2.INTER_NEAREST) for channel in image[3:]]
    return np.stack([*colors, *distances])


def _augment(
    image: NDArray[np.float32],
    label: NDArray[np.uint8],
    offset: NDArray[np.float32],
    rng: np.random.Generator,
    *,
    upside_down: bool,
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.float32]]:
    """Change colours and distances randomly, and turn and reflect the image.

    upside_down: whether the image may be turned by half a turn, as images of the camera on the hand.
    """
    image, offset = image.copy(), offset.copy()
    shifts = rng.uniform(-0.15, 0.15) + rng.uniform(-0.06, 0.06, 3)
    image[:3] = image[:3] * np.float32(rng.uniform(0.75, 1.25)) + shifts.astype(np.float32)[:, None, None]
    image[3:] += rng.uniform((-0.15, -0.1), (0.15, 0.1)).astype(np.float32)[:, None, None]
    noise = np.array([0.02, 0.02, 0.02, 0.006, 0.006], np.float32)[:, None, None]
    image += noise * rng.standard_normal(image.shape, np.float32)
    if upside_down and rng.random() < 0.5:
        image, label, offset = image[:, ::-1, ::-1], label[::-1, ::-1], offset[:, ::-1, ::-1]
        offset = offset * np.array([-1, -1, 1], np.float32)[:, None, None]
    if rng.random() < 0.5:
        image, label, offset = image[:, :, ::-1], label[:, ::-1], offset[:, :, ::-1]
        offset = offset * np.array([-1, 1, 1], np.float32)[:, None, None]
    return image, label, offset
