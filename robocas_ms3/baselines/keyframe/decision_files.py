"""Files of decisions with their images: the raw training data of `keyframe`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.baselines.keyframe.perception import CameraFrame
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import from_wxyz, transform_points
from robocas_ms3.datasets.candidate_images.images_file import CandidateImages, hash_decisions, images_path
from robocas_ms3.demos.candidates.candidates_file import CandidateFile
from robocas_ms3.robots.camera_models import to_intrinsic_matrix

RENDER_COMMAND = "robocas render-candidates CANDIDATES --views 3 --segmentation"


@dataclass(frozen=True)
class DecisionImage(CameraFrame):
    """Image of one camera with its segmentation (H, W), see `StepImages`."""

    segmentation: NDArray[np.uint8]

    def crop(self, left: int, top: int, width: int, height: int) -> DecisionImage:
        """Return a part of the image, in pixels."""
        part = (slice(top, top + height), slice(left, left + width))
        intrinsics = self.intrinsics - np.array([[0, 0, left], [0, 0, top], [0, 0, 0]])
        return DecisionImage(self.rgb[part], self.depth[part], intrinsics, self.camera_in_base, self.segmentation[part])


@dataclass(frozen=True)
class DecisionFile:
    """A candidates file with its images, and by row and slot the centres of the objects (D, K, 3) in the base frame."""

    candidates: CandidateFile
    images: CandidateImages
    hand_cameras: tuple[str, ...]
    other_cameras: tuple[str, ...]
    centers: NDArray[np.float64]

    def read_image(self, row: int, camera: str) -> DecisionImage:
        """Return the image of a camera at the decision of a row."""
        images = self.images
        return DecisionImage(
            images.rgb(row, camera),
            images.depth(row, camera),
            to_intrinsic_matrix(images.intrinsic(row, camera)),
            images.camera_in_base(row, camera),
            images.segmentation(row, camera),
        )


def open_decisions(path: Path, size: tuple[int, int]) -> DecisionFile:
    """Open a ``candidates.h5`` and its images.

    Raises:
        DatasetError: the file has another version; or its images are missing, or have no depth, segmentation or views,
            or another size than ``size`` (width and height in pixels).
    """
    file = CandidateFile(path)
    images = CandidateImages(images_path(path), hash_decisions(file))
    specs = file.recorded_env.cameras()
    hand = [camera.name for camera in specs if camera.mount == "hand" and camera.name in images.cameras]
    views = [name for name in images.cameras if name.startswith("view_")]
    for what, has, expected in (
        ("depth", images.has_depth, "depth images"),
        ("segmentation", images.has_segmentation, "segmentation images"),
        ("views", bool(views and hand), "views of a camera on the hand"),
        ("size", images.size == size, f"{size[0]} x {size[1]} pixels"),
    ):
        if not has:
            found = f"{images.size[0]} x {images.size[1]} pixels" if what == "size" else f"no {what}"
            fix = f"Render the images again: {RENDER_COMMAND} --size {size[0]} {size[1]} --overwrite."
            raise DatasetError(
                "these images do not suit keyframe", where=images.path, expected=expected, found=found, fix=fix
            )
    others = [camera.name for camera in specs if camera.mount != "hand" and camera.name in images.cameras]
    return DecisionFile(file, images, (hand[0], *views), tuple(others), _compute_centers(file))


def check_same_cameras(files: Sequence[DecisionFile]) -> None:
    """Raise `DatasetError` if files have images of different cameras, or different robots."""

    def describe(file: DecisionFile) -> str:
        robot = file.candidates.recorded_env.robot().description.uid
        return f"robot {robot}, cameras {', '.join([*file.other_cameras, *file.hand_cameras])}"

    for file in files[1:]:
        if (found := describe(file)) != (expected := describe(files[0])):
            what, fix = "the robots or cameras of the decision files differ", "Render all files with the same options."
            where = f"{files[0].images.path} and {file.images.path}"
            raise DatasetError(what, where=where, expected=expected, found=found, fix=fix)


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
