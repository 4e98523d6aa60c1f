"""File with the images of the decisions of a ``candidates.h5``, next to it.

The file ``candidates_images.h5`` has a group per camera with D rows, one per decision, in the order of ``decisions``::

    base_camera/rgb             PNG, 8 bit RGB
    base_camera/depth           PNG, 16 bit, mm, 0 = no depth
    base_camera/intrinsic       (D, 4) fx, fy, cx, cy in pixels
    base_camera/camera_in_base  (D, 4, 4) pose of the OpenCV camera frame in the arm's base frame

The attribute ``decisions`` identifies the decisions that are shown; see `hash_decisions`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.documents import DocumentError, check_regular_file
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.text import one_line
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.images.image_files import ImageOptions
from robocas_ms3.datasets.sources.episode_source import ImageKind
from robocas_ms3.demos.candidates.candidates_file import CandidateFile
from robocas_ms3.demos.recordings.trajectory_hdf5 import check_links

FORMAT, VERSION = "robocas-candidate-images", 1
"""Attributes ``format`` and ``version`` of the file."""
_RENDER = "Render the images with robocas render-candidates."
_RENDER_AGAIN = "Render the images again: robocas render-candidates --overwrite."


@dataclass(frozen=True)
class CameraImages:
    """Images of one camera at N decisions.

    Attributes:
        rgb: PNG of the RGB image per decision.
        depth: PNG of the depth image per decision; empty without depth.
        intrinsic: (N, 4) fx, fy, cx, cy in pixels.
        camera_in_base: (N, 4, 4) pose of the OpenCV camera frame in the arm's base frame.
    """

    rgb: list[bytes]
    depth: list[bytes]
    intrinsic: NDArray[np.float32]
    camera_in_base: NDArray[np.float32]


def images_path(candidates: Path) -> Path:
    """Return the default path of the images of a candidates file: ``candidates_images.h5`` next to it."""
    return candidates.with_name(f"{candidates.stem}_images.h5")


def hash_decisions(file: CandidateFile) -> str:
    """Return a hash of the decisions of a candidates file: of seeds, steps, and poses of the objects."""
    digest = hashlib.sha256()
    for name in ("seed", "decision", "step", "object_in_base"):
        digest.update(np.ascontiguousarray(file.decisions[name]).tobytes())
    return digest.hexdigest()


def create_datasets(file: h5py.File, options: ImageOptions, rows: int) -> None:
    """Create the datasets of an images file for ``rows`` decisions, with the cameras and kinds of the options."""
    png = h5py.vlen_dtype(np.uint8)
    for camera in options.cameras:
        group = file.create_group(camera)
        for kind in options.kinds:
            group.create_dataset(kind, (rows,), png)
        group.create_dataset("intrinsic", (rows, 4), np.float32)
        group.create_dataset("camera_in_base", (rows, 4, 4), np.float32)


def write_images(file: h5py.File, first: int, images: Mapping[str, CameraImages]) -> None:
    """Write the images of consecutive decisions by camera, the first one to the row ``first``."""
    for camera, found in images.items():
        group: Any = file[camera]
        rows = slice(first, first + len(found.rgb))
        group["intrinsic"][rows], group["camera_in_base"][rows] = found.intrinsic, found.camera_in_base
        for kind in schema.IMAGE_KINDS:
            for row, data in enumerate(getattr(found, kind), first):
                group[kind][row] = np.frombuffer(data, np.uint8)


def read_images(file: h5py.File) -> dict[str, CameraImages]:
    """Read all images of an open images file, by camera."""
    found = {}
    for camera, group in file.items():
        kinds = {kind: [row.tobytes() for row in group[kind]] if kind in group else [] for kind in schema.IMAGE_KINDS}
        found[camera] = CameraImages(
            **kinds, intrinsic=group["intrinsic"][:], camera_in_base=group["camera_in_base"][:]
        )
    return found


class CandidateImages:
    """Reader of an images file; it opens the file for each call, so it can be pickled and forked.

    Args:
        path: of the images file.
        decisions: result of `hash_decisions` for the candidates file; None: it is not compared.

    Attributes:
        path: of the images file.
        cameras: names of the cameras.
        has_depth: whether there are depth images.
        size: width and height of the images in pixels.

    Raises:
        DatasetError: the file is missing or damaged, or shows the decisions of another candidates file.
    """

    def __init__(self, path: Path | str, decisions: str | None = None) -> None:
        self.path = Path(path)
        with self._open() as file:
            check_links(file, self.path)
            attributes: dict[str, Any] = dict(file.attrs)
            found = attributes.get("format"), attributes.get("version")
            if found != (FORMAT, VERSION):
                what, expected = "not a file with images of decisions", f"format {FORMAT!r}, version {VERSION}"
                raise DatasetError(what, where=self.path, expected=expected, found=f"{found[0]!r}, {found[1]}")
            if decisions is not None and attributes["decisions"] != decisions:
                what = "these images show other decisions than the candidates file"
                raise DatasetError(what, where=self.path, fix=_RENDER_AGAIN)
            self.cameras = tuple(str(name) for name in attributes["cameras"])
            groups: list[Any] = [file[camera] for camera in self.cameras]
            self.has_depth = all("depth" in group for group in groups)
        height, width = self.rgb(0, self.cameras[0]).shape[:2]
        self.size = width, height

    def rgb(self, row: int, camera: str) -> NDArray[np.uint8]:
        """Return the RGB image (H, W, 3) of a camera at the decision of a row."""
        return cv2.cvtColor(self._decode(row, camera, "rgb"), cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)

    def depth(self, row: int, camera: str) -> NDArray[np.uint16]:
        """Return the depth image (H, W) of a camera at the decision of a row, mm, 0 = no depth."""
        return self._decode(row, camera, "depth")

    def intrinsic(self, row: int, camera: str) -> NDArray[np.float64]:
        """Return fx, fy, cx, cy (4,) of a camera in pixels."""
        return np.asarray(self._read(row, camera, "intrinsic"), np.float64)

    def camera_in_base(self, row: int, camera: str) -> NDArray[np.float64]:
        """Return the pose (4, 4) of the OpenCV camera frame in the arm's base frame."""
        return np.asarray(self._read(row, camera, "camera_in_base"), np.float64)

    def _decode(self, row: int, camera: str, kind: ImageKind) -> NDArray[Any]:
        data = self._read(row, camera, kind)
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
        if image is None:
            where = f"{self.path}, {camera}/{kind}, row {row}"
            raise DatasetError("this image is damaged", where=where, fix=_RENDER_AGAIN)
        return image

    def _read(self, row: int, camera: str, name: str) -> NDArray[Any]:
        with self._open() as file:
            dataset: Any = file[f"{camera}/{name}"]
            if not 0 <= row < len(dataset):
                raise DatasetError("no such decision", where=self.path, expected=f"0 to {len(dataset) - 1}", found=row)
            return np.asarray(dataset[row])

    @contextmanager
    def _open(self) -> Iterator[h5py.File]:
        try:
            check_regular_file(self.path)
            with h5py.File(self.path, "r") as file:
                yield file
        except FileNotFoundError as error:
            raise DatasetError("no such images file", where=self.path, fix=_RENDER) from error
        except (OSError, KeyError, ValueError, TypeError, RuntimeError, DocumentError) as error:
            raise DatasetError(
                "damaged images file", where=self.path, found=one_line(error), fix=_RENDER_AGAIN
            ) from error
