"""From images and an instruction to an observed scene, by the networks of `keyframe`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.baselines.keyframe.config import DecisionSettings
from robocas_ms3.baselines.keyframe.gripper_crops import make_crops
from robocas_ms3.baselines.keyframe.handles import Handle
from robocas_ms3.baselines.keyframe.network import (
    BASKET,
    FIRST_NAME,
    HANDLE,
    OFFSET_UNIT,
    PULL_UNIT,
    ROBOT,
    STRIDE,
    KeyframeNetwork,
    make_inputs,
)
from robocas_ms3.baselines.keyframe.observed_scene import (
    NARROW_RADIUS,
    WIDE_RADIUS,
    ObservedObject,
    ObservedScene,
    cluster_votes,
    find_table_height,
    is_above_table,
    is_below_camera,
    is_in_workspace,
    sample_pixels,
    shrink_along_view,
    unproject,
)
from robocas_ms3.core.poses import Array
from robocas_ms3.scenes.relations import RELATIONS, Relation

_POINT_STEP = 2  # pixels between points of the cloud
_SURE = 0.6  # probability of an object or the basket in the images of a survey
_SURE_HANDLE, _MIN_HANDLE_CELLS = 0.4, 5  # probability and number of cells of a handle
_ROOF_RADIUS, _ROOF_CLEARANCE, _ROOF_CELLS = 0.2, 0.12, 60  # m around and above the objects; least number of cells
_BASKET_RADIUS = 0.4  # m from the median of the points to the farthest point of a basket
_EDGE = 2  # percent of the points of the basket that may be outside of its bounds


@dataclass(frozen=True)
class CameraFrame:
    """Image of one camera.

    Attributes:
        rgb: (H, W, 3) uint8.
        depth: (H, W) depth along the optical axis, mm; 0: no measurement.
        intrinsics: (3, 3) intrinsic matrix, pixels.
        camera_in_base: (4, 4) pose of the OpenCV camera frame in the arm's base frame.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[Any]
    intrinsics: NDArray[Any]
    camera_in_base: NDArray[Any]


@dataclass(frozen=True)
class Request:
    """Target and relation of an instruction.

    Attributes:
        names: (N,) probability of each object name.
        relation: relation that distinguishes the target from other objects of the same name, or None.
    """

    names: NDArray[np.float32]
    relation: Relation | None


@dataclass(frozen=True)
class Survey:
    """Result of a survey: the scene that the three cameras show.

    Attributes:
        focus: (2,) middle of the objects, m, in the arm's base frame.
        basket: (3,) middle of the basket in x and y, and the height of its rim, m; None: not seen.
        table: height of the surface, m.
        handle: handle of a door or drawer, or None.
        points: (P, 3) points on everything but the robot, m.
        has_objects: whether objects are seen; otherwise the focus is a default.
        has_roof: whether something is above the objects, so that they have to be grasped from the front.
    """

    focus: Array
    basket: Array | None
    table: float
    points: Array
    handle: Handle | None = None
    has_objects: bool = False
    has_roof: bool = False


@dataclass(frozen=True)
class _Cells:
    """Predictions for the cells (h, w) of an image, with vectors in the arm's base frame.

    Attributes:
        points: (h, w, 3) points on the surface, m.
        valid: (h, w) whether the depth was measured.
        classes: (h, w, C) probabilities of the classes.
        offsets: (h, w, 3) from the surface to the centre of the object, or to the grasp of the handle, m.
        pulls: (h, w, 3, 3) motion of the handle in m, approach, and axis of the bar.
    """

    points: Array
    valid: NDArray[np.bool_]
    classes: NDArray[np.float32]
    offsets: Array
    pulls: Array


class Perception:
    """Segmentation of images, and scores of grasps.

    Args:
        network: trained networks.
        settings: settings of the decisions.
    """

    def __init__(self, network: KeyframeNetwork, settings: DecisionSettings) -> None:
        self._network, self._settings = network, settings
        self._device = next(network.parameters()).device

    def read_instruction(self, embedding: NDArray[np.float32]) -> Request:
        """Return what an instruction with this sentence embedding (384,) asks for."""
        with torch.inference_mode():
            names, relations = self._network.instruction(torch.from_numpy(embedding)[None].to(self._device))
        relation = int(relations[0].argmax())
        return Request(names[0].softmax(dim=0).cpu().numpy(), RELATIONS[relation - 1] if relation else None)

    def survey(self, frames: list[CameraFrame], default_table: float) -> Survey:
        """Find the objects, the basket, a handle and the height of the surface in the images of all cameras."""
        objects, basket, others, below, handles, everything = [], [], [], [], [], []
        for frame in frames:
            cells = self._classify(frame)
            seen = cells.valid & (cells.classes[..., ROBOT] < 0.3)
            inside = seen & is_in_workspace(cells.points)
            everything.append(cells.points[seen])
            is_object, is_basket = cells.classes[..., FIRST_NAME:].sum(-1), cells.classes[..., BASKET]
            objects.append(cells.points[inside & (is_object > _SURE)])
            basket.append(cells.points[seen & (is_basket > _SURE)])
            is_other = seen & (is_object < 0.2) & (is_basket < 0.2)
            others.append(cells.points[is_other])
            below.append(cells.points[is_other & inside & is_below_camera(cells.points, frame.camera_in_base)])
            is_handle = inside & (cells.classes[..., HANDLE] > _SURE_HANDLE)
            grasps = (cells.points + cells.offsets)[is_handle]
            handles.append(np.concatenate([grasps[:, None], cells.pulls[is_handle]], axis=1))
        surfaces, found, rim = np.concatenate(others), np.concatenate(objects), np.concatenate(basket)
        supports = np.concatenate(below)
        table = find_table_height(supports, found) if len(supports) else default_table
        found = found[found[:, 2] > table + 0.005]
        has_objects = len(found) >= 10
        focus = np.median(found[:, :2], axis=0) if has_objects else np.array([0.6, 0.0])
        has_roof = False
        if has_objects:
            roof = np.percentile(found[:, 2], 95) + _ROOF_CLEARANCE
            above = (surfaces[:, 2] > roof) & (np.linalg.norm(surfaces[:, :2] - focus, axis=1) < _ROOF_RADIUS)
            has_roof = int(above.sum()) >= _ROOF_CELLS
        handle = _find_handle(np.concatenate(handles))
        return Survey(focus, _find_basket(rim), table, np.concatenate(everything), handle, has_objects, has_roof)

    def observe(self, frame: CameraFrame, request: Request, table: float) -> ObservedScene:
        """Return the objects and the points in the workspace of an image of the gripper camera."""
        cells, settings = self._classify(frame), self._settings
        size = frame.depth.shape
        names = cells.classes[..., FIRST_NAME:]
        target = names @ request.names / max(float(request.names.max()), 1e-6)
        target = np.minimum(target, 1.0)
        probability = names.sum(-1)
        pixels = sample_pixels(size, _POINT_STEP)
        points, valid = unproject(frame.depth, frame.intrinsics, frame.camera_in_base, pixels)
        step = np.ix_(*pixels)
        valid &= _enlarge(cells.classes[..., ROBOT], size)[step] < 0.4
        valid &= is_in_workspace(points) & is_above_table(points, table)
        cloud, rows = points[valid], np.flatnonzero(valid.ravel())
        number_of_cell = _cells_of_points(valid.shape, cells.valid.shape)[rows]
        large_object = _enlarge(probability, size)[step][valid]

        def find(
            mask: NDArray[np.bool_], of: NDArray[np.float32], label: int, *, separates_copies: bool = False
        ) -> list[ObservedObject]:
            where = np.flatnonzero(mask)
            votes = (cells.points + cells.offsets).reshape(-1, 3)[where]
            found = []
            clustered, radius = votes, WIDE_RADIUS
            if separates_copies and len(votes):
                clustered, radius = shrink_along_view(votes, frame.camera_in_base[:3, 3]), NARROW_RADIUS
            for group in cluster_votes(clustered, max(1, settings.min_points * _POINT_STEP**2 // STRIDE**2), radius):
                member = np.zeros(mask.size, dtype=bool)
                member[where[group]] = True
                on_object = member[number_of_cell]
                if on_object.sum() >= settings.min_points:
                    certainty = float(of.reshape(-1)[where[group]].mean())
                    found.append(ObservedObject(on_object, votes[group].mean(axis=0), label, certainty))
            return found

        inside = cells.valid & is_in_workspace(cells.points)
        is_target = inside & (target > settings.target_probability)
        targets = find(is_target, target, -1, separates_copies=request.relation is not None)
        is_object = inside & (probability > settings.object_probability)
        labels = names.argmax(-1)
        objects = [
            one
            for label in np.unique(labels[is_object]).tolist()
            for one in find(is_object & (labels == label), names[..., label], label)
        ]
        return ObservedScene(cloud, large_object > settings.object_probability, targets, objects)

    def score_grasps(self, scene: ObservedScene, mask: NDArray[np.bool_], grasps: Array, table: float) -> Array:
        """Return the predicted probability of success of grasps (G, 4, 4) of the object with the points ``mask``."""
        crops, poses = make_crops(scene.points, mask.astype(np.float32), grasps, table)
        with torch.inference_mode():
            logits = self._network.grasp(*(torch.from_numpy(of).to(self._device) for of in (crops, poses)))
        return logits.sigmoid().cpu().numpy().astype(np.float64)

    def _classify(self, frame: CameraFrame) -> _Cells:
        inputs = make_inputs(frame.rgb, frame.depth, frame.intrinsics, frame.camera_in_base)
        image = torch.from_numpy(inputs)[None].to(self._device).contiguous(memory_format=torch.channels_last)
        with torch.inference_mode():
            logits, offsets, pulls = self._network.segmentation(image)
        classes = logits[0].softmax(dim=0).permute(1, 2, 0).cpu().numpy()
        in_camera = OFFSET_UNIT * offsets[0].permute(1, 2, 0).cpu().numpy().astype(np.float64)
        pixels = sample_pixels(frame.depth.shape, STRIDE, STRIDE // 2)
        points, valid = unproject(frame.depth, frame.intrinsics, frame.camera_in_base, pixels)
        to_base = frame.camera_in_base[:3, :3].T
        vectors = pulls[0].permute(1, 2, 0).cpu().numpy().astype(np.float64).reshape(*classes.shape[:2], 3, 3)
        return _Cells(points, valid, classes, in_camera @ to_base, vectors @ to_base * [[PULL_UNIT], [1], [1]])


def _find_basket(points: Array) -> Array | None:
    """Return the middle of the basket (x, y) and the height of its rim (z) from points (P, 3) on it, or None.

    Points far from the median are left out. At the outline of the basket, cells may show the floor or a wall.
    """
    if len(points) < 20:
        return None
    points = points[np.linalg.norm(points - np.median(points, axis=0), axis=1) < _BASKET_RADIUS]
    if not len(points):  # several distant groups
        return None
    low, high = np.percentile(points, [_EDGE, 100 - _EDGE], axis=0)
    return np.array([*(low[:2] + high[:2]) / 2, high[2]])


def _find_handle(cells: Array) -> Handle | None:
    """Return a handle from the predictions (C, 4, 3) of its cells: grasp, motion, approach and bar; or None.

    It is the largest one that can be pulled, or else the largest one.
    """
    groups = cluster_votes(cells[:, 0], _MIN_HANDLE_CELLS, WIDE_RADIUS)
    handles = [Handle(*np.median(cells[group], axis=0)) for group in groups]
    return next((handle for handle in handles if handle.can_be_pulled), handles[0] if handles else None)


def _enlarge(cells: NDArray[np.float32], size: tuple[int, ...]) -> NDArray[np.float32]:
    large = cv2.resize(cells.astype(np.float32), (size[1], size[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(large, np.float32)


def _cells_of_points(points: tuple[int, ...], cells: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the index of the cell of each point (rows x columns)."""
    rows = np.arange(points[0]) * _POINT_STEP // STRIDE
    columns = np.arange(points[1]) * _POINT_STEP // STRIDE
    return (rows[:, None] * cells[1] + columns[None]).reshape(-1)
