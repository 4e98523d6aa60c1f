"""Page content of trajectory files and datasets of all formats."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import from_xyzw, inverse, transform_points
from robocas_ms3.core.text import format_object_name
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.formats import CANDIDATES, detect_format
from robocas_ms3.datasets.images.image_headers import read_image_bytes
from robocas_ms3.datasets.sources.episode_source import ImageKind
from robocas_ms3.datasets.sources.provenance import make_entry_without_fingerprint, parse_task_name
from robocas_ms3.datasets.sources.reader import DEFAULT_RATE, Dataset
from robocas_ms3.datasets.sources.trajectory import TrajectorySource
from robocas_ms3.demos.recordings.trajectory_file import Recording, TrajectoryFile
from robocas_ms3.demos.settings import find_trajectory
from robocas_ms3.viewer.content import Content, PageContent
from robocas_ms3.viewer.damage import convert_damage_errors, read_object, read_or_default
from robocas_ms3.viewer.decisions.content import DecisionContent
from robocas_ms3.viewer.decisions.decision_source import DecisionSource
from robocas_ms3.viewer.episode import ARM, ROLL_PITCH_YAW, XYZ, Plot, collect_facts, make_episode_content, make_plot
from robocas_ms3.viewer.images import EncodedImage, check_inside

MEDIA_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".webp": "image/webp"}
_NO_IMAGES = "A trajectory file has no images. Render them with `robocas convert {name} --to robocas --out DIR`."
_STILL = 0.002  # m; objects that move less are drawn as a point
_PARKED = 5.0  # m from the arm; objects beyond are not in the scene
_AT_ONCE = 8  # images decoded together, because opening and seeking a video is slow
_CACHE_BYTES = 128e6  # of decoded images


def open_content(path: Path | str, *, images: Path | None = None) -> Content:
    """Open a trajectory file (or its folder), candidates.h5, or a dataset of any format, as content of the page.

    ``images`` is the file with the images of candidates.h5; None: the default file, if it exists.
    """
    path = find_trajectory(Path(path))
    found = detect_format(path)
    if found is not None and found.name == CANDIDATES:
        return DecisionContent(DecisionSource(path, images))
    if images is not None:
        raise DatasetError("only candidates.h5 has a file with images", where=path, fix="Omit --images.", usage=True)
    other_file = found is None or (found.name == "trajectory" and path.suffix not in (".h5", ".hdf5"))
    if other_file and not path.is_dir():
        raise DatasetError(
            "nothing to view",
            where=path,
            expected="a trajectory.h5, a candidates.h5, a RoboCAS folder or a LeRobot dataset",
            found="no such file or folder" if not path.exists() else "another kind of file",
        )
    if found is None or found.name == "robocas":
        return FolderContent(path)
    if found.name == "trajectory":
        return TrajectoryContent(path)
    if found.name == "lerobot":
        return LeRobotContent(path)
    return PageContent(found.import_function("reader")(path), found.title)


class FolderContent(PageContent):
    """Page content of a RoboCAS folder, also of RoboCAS-v0; the server sends images as they are stored."""

    def __init__(self, root: Path) -> None:
        self.dataset = dataset = Dataset(root)
        # damaged overviews are replaced by empty ones
        dataset.settings, wrong_settings = read_object(lambda: dataset.settings, schema.CONVERSION_FILE)
        dataset.info, wrong_info = read_object(lambda: dataset.info, schema.DATA_INFO_FILE)
        dataset.rate_hz, wrong = read_or_default(lambda: dataset.rate_hz, DEFAULT_RATE)
        assumed = f"`rate_hz` of `{schema.CONVERSION_FILE}`: {wrong}; {DEFAULT_RATE:g} Hz is used."
        dataset.cameras, _ = read_or_default(lambda: dataset.cameras, dataset.episode(dataset.numbers[0]).cameras)
        notes = wrong_settings, assumed if wrong else "", wrong_info
        super().__init__(dataset, "RoboCAS folder", notes)

    def _read_splits(self) -> Mapping[int, str]:
        splits, _ = read_or_default(lambda: self.dataset.splits, ([], []))  # includes missing episodes
        return {number: name for name, listed in zip(("train", "val"), splits, strict=True) for number in listed}

    def rgb(self, number: int, camera: str, step: int) -> EncodedImage:
        path = check_inside(self.dataset.episode(number).image_path(camera, "rgb", step), self.root)
        try:
            return EncodedImage(MEDIA_TYPES[path.suffix], read_image_bytes(path))
        except (OSError, ValueError) as error:
            found = getattr(error, "strerror", None) or error
            raise DatasetError("the image can't be read", where=path, found=found) from error

    def depth(self, number: int, camera: str, step: int) -> NDArray[np.uint16]:
        episode = self.dataset.episode(number)
        check_inside(episode.image_path(camera, "depth", step), self.root)
        return episode.depth(camera, step)


class TrajectoryContent(PageContent):
    """Page content of a trajectory file, one step per control step, with recorded actions and object paths."""

    scene_name = entry_name = "JSON entry"

    def __init__(self, path: Path) -> None:
        with convert_damage_errors(path):
            with TrajectoryFile(path) as file:
                task = parse_task_name(file.env_info["env_id"])
                self._entries = [
                    {"task": task, **make_entry_without_fingerprint(file, index)} for index in range(len(file.episodes))
                ]
            self.recordings = TrajectorySource(path, rate_hz=file.control_freq, include_failed=True)
        super().__init__(self.recordings, "trajectory file", [_NO_IMAGES.format(name=path.name)])

    def _read_entry(self, number: int) -> dict[str, Any]:
        return {key: self._entries[number][key] for key in ("task", "seed", "success", "target")}

    def _read_splits(self) -> Mapping[int, str]:
        return {}

    def _make_content(self, number: int, scene: Mapping[str, Any]) -> dict[str, Any]:
        episode = self.recordings.episode(number)
        recording, arrays = episode.recording(), episode.arrays
        base = from_xyzw(arrays["base_pos"][:1].astype(float), arrays["base_orn"][:1].astype(float))[0]
        objects = _list_object_paths(recording, scene, self.recordings.object_ids(number), base)
        shown = make_episode_content(arrays, scene, actions=_make_action_plots(recording), moving=objects)
        return {**shown, "facts": collect_facts({**scene, "source": None})}  # the source is this file


class LeRobotContent(PageContent):
    """Page content of a LeRobot dataset; images are decoded from the videos of the dataset."""

    def __init__(self, root: Path) -> None:
        from robocas_ms3.datasets.lerobot import schema as lerobot  # needs the extra `lerobot`
        from robocas_ms3.datasets.lerobot.reader import LeRobotDataset

        with convert_damage_errors(root):
            self.dataset = dataset = LeRobotDataset(root)
            _ = dataset.has_robocas_features, dataset.lengths, dataset.rate_hz, dataset.cameras, dataset.has_depth
        self.entry_name, self._indices = lerobot.CONVERSION_FILE, {*lerobot.INDICES, lerobot.SUBTASK_INDEX.key}
        settings, wrong_settings = read_object(lambda: dataset.settings, lerobot.CONVERSION_FILE)
        dataset.settings = settings or {"train_eps": []}
        dataset.scene_json_texts, wrong_scenes = read_object(lambda: dataset.scene_json_texts, lerobot.SCENES_FILE)
        notes = wrong_scenes, wrong_settings
        super().__init__(dataset, "LeRobot dataset", notes)
        self._decoded: OrderedDict[tuple[int, str, ImageKind, int], NDArray] = (
            OrderedDict()
        )  # least recently used first

    def _make_content(self, number: int, scene: Mapping[str, Any]) -> dict[str, Any]:
        """Return the content of an episode; a dataset of another tool gets one plot per numeric column."""
        if self.dataset.has_robocas_features:
            return super()._make_content(number, scene)
        episode = self.dataset.episode(number)
        features = self.dataset.info["features"]
        plots = [
            make_plot(name, "", _label_columns(features.get(name, {}), values.shape[1]), values)
            for name, values in episode.columns.items()
            if name not in self._indices and values.dtype != bool
        ]
        return {
            "instruction": episode.instruction,
            "steps": episode.steps,
            "subgoals": [],
            "plots": plots,
            "trace": None,
            "facts": {"Robot": self.dataset.info.get("robot_type")},
        }

    def _image(self, number: int, camera: str, kind: ImageKind, step: int) -> NDArray:
        episode = self.dataset.episode(number)
        if not 0 <= step < episode.steps:
            raise DatasetError("no such step", where=f"{self.root}, episode {number}", found=step)
        first = step - step % _AT_ONCE
        key = number, camera, kind, first
        with self._reading:
            if key not in self._decoded:
                check_inside(episode.find_video(camera, kind)[0], self.root)
                frames = episode.frames(camera, kind, first, min(_AT_ONCE, episode.steps - first))
                self._decoded[key] = np.stack(list(frames))
            self._decoded.move_to_end(key)
            while len(self._decoded) > 1 and sum(images.nbytes for images in self._decoded.values()) > _CACHE_BYTES:
                self._decoded.popitem(last=False)
            return self._decoded[key][step - first]


def _label_columns(feature: dict[str, Any], width: int) -> list[str]:
    names = feature.get("names")
    if isinstance(names, dict):
        names = [str(word) for part in names.values() for word in (part if isinstance(part, list) else [part])]
    return [str(name) for name in names] if names and len(names) == width else [str(i) for i in range(width)]


def _make_action_plots(recording: Recording) -> list[Plot]:
    """Return plots of the recorded actions: arm, gripper, and mobile base if it moves.

    The last state has no action, so the plots repeat the last action there.
    """
    values = np.concatenate([recording.actions, recording.actions[-1:]])
    arm = {7: 6, 8: 7, 10: 6, 11: 7}.get(values.shape[1])  # 6: end-effector deltas
    if arm is None:
        return [make_plot("Actions", "", [f"a{i + 1}" for i in range(values.shape[1])], values, steps=True)]
    names = ARM if arm == 7 else (*XYZ, *ROLL_PITCH_YAW)
    unit = "rad" if recording.control_mode == "pd_joint_pos" else ""
    plots = [
        make_plot(f"Action: arm, {recording.control_mode}", unit, names, values[:, :arm], steps=True),
        make_plot("Action: gripper, 1 = open", "", ("gripper",), values[:, arm : arm + 1], steps=True),
    ]
    base = values[:, arm + 1 :]
    return plots + ([make_plot("Action: mobile base", "", ("x", "y", "yaw"), base, steps=True)] if base.any() else [])


def _list_object_paths(
    recording: Recording, scene: Mapping[str, Any], ids: Any, base_in_world: NDArray
) -> list[dict[str, Any]]:
    """Return the objects {name, target, path} of the scene; a path is (T, 3), or (1, 3) without motion, world frame."""
    target = scene.get("target") or {}
    target_actor = f"object_{target['slot']}" if target else ""
    names = {thing["slot"]: thing["name"] for thing in scene.get("objects") or ()}
    shown = {
        f"object_{slot}": format_object_name(str(asset), names.get(slot, "")) for slot, asset in enumerate(ids or ())
    }
    shown[target_actor] = format_object_name(target.get("asset_id") or "", target.get("name") or "")
    found = []
    for actor, states in recording.states.get("actors", {}).items():
        path = states[:, :3].astype(float)
        if actor in ("ground", "room") or np.linalg.norm(transform_points(inverse(base_in_world), path[:1])) > _PARKED:
            continue
        still = np.ptp(path, axis=0).max() < _STILL
        name = shown.get(actor, actor.replace("_", " "))
        found.append({"name": name, "target": actor == target_actor, "path": path[:1] if still else path})
    return found
