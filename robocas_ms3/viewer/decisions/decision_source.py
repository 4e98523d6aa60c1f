"""Decisions of a candidates file with their outcome classes, images and views, for the page and the contact sheet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from robocas_ms3.assets.pack import BodyFiles, load_pack
from robocas_ms3.core.errors import AssetError, DatasetError, RobocasError
from robocas_ms3.core.poses import from_wxyz, transform_points
from robocas_ms3.core.text import format_object_name
from robocas_ms3.datasets.candidate_images.images_file import CandidateImages, hash_decisions, images_path
from robocas_ms3.demos.candidates.candidates_file import CandidateFile, Decision
from robocas_ms3.scenes.lookup import find_container
from robocas_ms3.viewer.decisions.outcomes import classify_outcomes
from robocas_ms3.viewer.decisions.strokes import Stroke, make_strokes
from robocas_ms3.viewer.decisions.views import CameraView, Region, View, find_region, make_top_view, project_stroke

Array = NDArray[np.float64]
_NEARLY_ALL = 0.8  # of the candidates that the best camera shows
_NO_CORNERS: Array = np.empty((0, 3))
_IN_FRONT = 0.08  # m; a surface that is nearer by this distance hides a candidate


@dataclass(frozen=True)
class Line:
    """Line of a candidate in a view: pixels (P, 2), and whether it is dashed."""

    pixels: Array
    dashed: bool


@dataclass(frozen=True)
class ObjectOutline:
    """Object in a view.

    Attributes:
        name: name of the object.
        target: whether it is the instructed target.
        pixel: (2,) position; NaN: behind the camera.
        outline: (P, 2) outline; empty: unknown.
    """

    name: str
    target: bool
    pixel: Array
    outline: Array


@dataclass(frozen=True)
class DecisionView:
    """View of a decision with its objects and candidates.

    Attributes:
        view: the projection.
        candidates: lines of each candidate; empty: not visible.
        objects: the objects, lowest first.
        region: part of the image with the candidates and the target.
        visible: number of candidates that are inside the image and start in front of all surfaces.
    """

    view: View
    candidates: list[list[Line]]
    objects: list[ObjectOutline]
    region: Region
    visible: int


class DecisionSource:
    """Decisions of a candidates file.

    Args:
        path: file ``candidates.h5``.
        images: file with the images; None: the default file next to it, if it exists.

    Attributes:
        file: the candidates file.
        images: the images; None: there are none.
        note: sentences for the top of the page about missing images.
        outcomes: outcome class (N,) of each candidate.

    Raises:
        DatasetError: the candidates file is damaged; or ``images`` is missing, damaged, or shows other decisions.
    """

    def __init__(self, path: Path, images: Path | None = None) -> None:
        self.file = CandidateFile(path)
        self.outcomes = classify_outcomes(self.file)
        self.images, self.note = None, ""
        images_file = images or images_path(self.file.path)
        if images is None and not images_file.is_file():
            self.note = f"There are no images. Render them with `robocas render-candidates {self.file.path.name}`."
            return
        try:
            self.images = CandidateImages(images_file, hash_decisions(self.file))
        except DatasetError as error:
            if images is not None:
                raise
            self.note = f"The images are not shown. `{images_file.name}`: {error.what}. {error.fix}"

    def __len__(self) -> int:
        return len(self.file)

    def decision(self, row: int) -> Decision:
        """Return the decision in a row; raise DatasetError if there is none."""
        return self.file.decision(row)

    def name_object(self, decision: Decision, slot: int, *, with_id: bool = False) -> str:
        """Return the name of the object in a slot, possibly with its id if the two differ; "" if there is none."""
        if not 0 <= slot < len(decision.values["present"]) or not decision.values["present"][slot]:
            return ""
        asset, name = (str(decision.values[key][slot]) for key in ("object_id", "object_name"))
        return format_object_name(asset, name) if with_id or not name else name

    def views(self, row: int) -> list[DecisionView]:
        """Return the views of a decision: those of the cameras, if there are images, and the plot from above."""
        decision = self.decision(row)
        candidates = decision.candidates
        ends = np.where(np.isnan(candidates["end_in_base"]), candidates["final_in_base"], candidates["end_in_base"])
        strokes = [
            make_strokes(str(primitive), start, end)
            for primitive, start, end in zip(candidates["primitive"], candidates["start_in_base"], ends, strict=True)
        ]
        found = []
        if images := self.images:
            for name in images.cameras:
                view = CameraView(name, images.size, images.intrinsic(row, name), images.true_camera_in_base(row, name))
                depth = images.depth(row, name) if images.has_depth else None
                found.append(self._make_view(view, decision, strokes, depth))
        top = make_top_view(_list_points(decision, strokes))
        return [*found, self._make_view(top, decision, strokes, None)]

    def _make_view(
        self, view: View, decision: Decision, strokes: Sequence[list[Stroke]], depth: NDArray[np.uint16] | None
    ) -> DecisionView:
        lines = [
            [
                Line(pixels, stroke.dashed and part == 0)
                for stroke in of
                for part, pixels in enumerate(project_stroke(view, stroke))
            ]
            for of in strokes
        ]
        poses = decision.values["object_in_base"]
        objects = []
        present = np.flatnonzero(decision.values["present"])
        basket = decision.values["basket_in_base"]
        if np.isfinite(basket).all():
            pixel = view.project(basket[None, :3].astype(np.float64))[0][0]
            objects.append(ObjectOutline("basket", False, pixel, _project_outline(view, self._basket_corners, basket)))
        for slot in present[np.argsort(poses[present, 2])]:
            pixel = view.project(poses[slot : slot + 1, :3].astype(np.float64))[0][0]
            corners = self._corners.get(str(decision.values["object_id"][slot]), _NO_CORNERS)
            outline = _project_outline(view, corners, poses[slot])
            target = slot == decision.values["target_slot"]
            objects.append(ObjectOutline(self.name_object(decision, slot), bool(target), pixel, outline))
        shown = [line.pixels for of in lines for line in of if not line.dashed]
        shown += [thing.pixel[None] for thing in objects if thing.target]
        hidden = _find_hidden(view, decision.candidates["start_in_base"][:, :3], depth)
        visible = sum(_is_inside(of, view.size) and not behind for of, behind in zip(lines, hidden, strict=True))
        return DecisionView(view, lines, objects, find_region(view, shown), visible)

    @cached_property
    def _corners(self) -> dict[str, Array]:
        """Corners (P, 3) of the convex hull of each object of the pack by id; empty if the pack is not installed."""
        try:
            pack = load_pack(self.file.recorded_env.kwargs.get("pack", "builtin"), usage=False)
        except AssetError:
            return {}
        found = {}
        for asset in np.unique(self.file.decisions["object_id"][self.file.decisions["present"]]):
            if str(asset) in pack.objects:
                found[str(asset)] = _find_corners(pack.objects[str(asset)])
        return found

    @cached_property
    def _basket_corners(self) -> Array:
        """Corners (P, 3) of the convex hull of the basket; empty if it is unknown."""
        try:
            config = self.file.recorded_env.task_config()
            return _find_corners(find_container(load_pack("builtin"), config.basket)) if config.basket else _NO_CORNERS
        except RobocasError:
            return _NO_CORNERS


def choose_view(views: Sequence[DecisionView]) -> DecisionView:
    """Return the camera view that shows most candidates, and of about as good ones the closest.

    Without cameras the result is the plot from above, which is the last view.
    """
    cameras = views[:-1] or views
    most = max(shown.visible for shown in cameras)
    good = [shown for shown in cameras if shown.visible >= _NEARLY_ALL * most]
    return min(good, key=lambda shown: shown.region[2] / shown.view.size[0])


def _is_inside(lines: Sequence[Line], size: tuple[int, int]) -> bool:
    """Return whether a candidate is visible, and all its lines that are not dashed are inside the image."""
    pixels = [line.pixels for line in lines if not line.dashed]
    return bool(pixels) and all(((points >= 0) & (points <= size)).all() for points in pixels)


def _find_hidden(view: View, points: NDArray, depth: NDArray[np.uint16] | None) -> NDArray[np.bool_]:
    """Return which points (P, 3) are hidden behind a surface; none without a depth image (H, W) in mm."""
    if not isinstance(view, CameraView) or depth is None:
        return np.zeros(len(points), bool)
    pixels, scale = view.project(points.astype(np.float64))
    hidden = np.zeros(len(points), bool)
    for index, (column, row) in enumerate(pixels):
        if np.isfinite(column) and 0 <= column < view.size[0] and 0 <= row < view.size[1]:
            surface = depth[int(row), int(column)] / 1000
            hidden[index] = 0 < surface < view.intrinsic[0] / scale[index] - _IN_FRONT
    return hidden


def _find_corners(asset: BodyFiles) -> Array:
    """Return the corners (P, 3) of the convex hull of an asset, in its frame."""
    points = np.concatenate(asset.hulls)
    return points[ConvexHull(points).vertices]


def _project_outline(view: View, corners: Array, pose: NDArray) -> Array:
    """Return the convex outline (P, 2) of corners (P, 3) at a pose in a view; empty if it is unknown or not visible."""
    if not len(corners) or not np.isfinite(pose).all():
        return np.empty((0, 2))
    pixels, _ = view.project(transform_points(from_wxyz(pose.astype(np.float64)), corners))
    return pixels[ConvexHull(pixels).vertices] if np.isfinite(pixels).all() else np.empty((0, 2))


def _list_points(decision: Decision, strokes: Sequence[list[Stroke]]) -> Array:
    """Return all finite points (P, 3) of objects and candidates, of the TCP, and in release decisions of the basket."""
    values = decision.values
    points = [values["object_in_base"][values["present"], :3], values["tcp_in_base"][None, :3]]
    if values["kind"] == "release":
        points.append(values["basket_in_base"][None, :3])
    points += [stroke.points for of in strokes for stroke in of]
    found = np.concatenate(points).astype(np.float64)
    return found[np.isfinite(found).all(axis=1)]
