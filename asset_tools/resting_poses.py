"""Find resting poses of an object on a plane from its convex hull, and verify them in the physics engine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from sapien import physx
from scipy.spatial import ConvexHull, QhullError

from asset_tools.stability import (
    BELOW,
    UPRIGHT_DEG,
    merge_poses,
    pool_probabilities,
    rocks_in_place,
    select_poses,
    stable_directions,
    toppling_angle,
)
from robocas_ms3.assets.hulls import find_box
from robocas_ms3.assets.physics import (
    RigidBody,
    add_body,
    add_ground,
    engine_settings,
    grid_origins,
    make_convex_shape,
    make_scene,
    pose_matrix,
)
from robocas_ms3.core.errors import AssetError

Array = np.ndarray

ROUNDS = 6  # simulated seconds until an object has to be at rest
MOVED, TURNED_DEG = 0.001, 2.0  # m and deg of motion in 1 s; less counts as rest
YAWS = tuple(np.arange(8) * 0.8)  # rad; a pose must be stable for each yaw, since the engine's contacts depend on it
DROP = 0.0005  # m above the plane at the start, as in scenes
MIN_TOPPLING_DEG = 3.0  # poses with a smaller toppling angle are dropped, unless they only rock
STEPS = 100  # number of time steps
RAREST = 0.02  # minimum probability of a pose

LIFT = np.zeros((4, 4))
LIFT[2, 3] = DROP
TURNS = [np.eye(4) for _ in YAWS]
for _turn, _yaw in zip(TURNS, YAWS, strict=True):
    _turn[:2, :2] = [[np.cos(_yaw), -np.sin(_yaw)], [np.sin(_yaw), np.cos(_yaw)]]


@dataclass(frozen=True)
class RestingPoses:
    """The S resting poses of an object, by descending probability.

    Attributes:
        poses: (S, 4, 4) ``T_plane_object``: pose of the object in a frame with the plane at z = 0 and the centre of
            mass at x = y = 0; the rotation is the shortest one, without yaw.
        probabilities: (S,) fraction of random drops that end in each pose; the sum is 1.
        display_pose: index of the pose in which the object's +z points up within 10 deg, or -1.
    """

    poses: Array
    probabilities: Array
    display_pose: int


@dataclass(frozen=True)
class _Body:
    solid: RigidBody
    points: Array  # (K, 3) corners of the hull of all hulls
    cooked: Array  # (L, 3) corners of the hull of the engine's shapes

    def rest(self, up: Array) -> Array:
        """Return the pose (4, 4) on the plane in which a direction (3,) of the object's frame points up."""
        pose = np.eye(4)
        pose[:3, :3] = _turn_up(up)
        pose[:2, 3] = -(pose[:2, :3] @ self.solid.center_of_mass)
        # the engine's shapes touch the plane; corners that it dropped may be at most BELOW under it
        pose[2, 3] = max(-(self.cooked @ pose[2, :3]).min(), -(self.points @ pose[2, :3]).min() - BELOW)
        return pose


def resting_poses(solid: RigidBody) -> RestingPoses:
    """Find the poses in which a placed object stays; deterministic.

    Poses with a probability below 2 % are dropped, unless all are rare. Probabilities of poses with equal height are
    added, since a cylinder has many poses on its side.

    Args:
        solid: the object; the table's friction is 0.99.

    Raises:
        AssetError: the hulls are flat, the centre of mass is outside of them, or no pose is stable.
    """
    vertices = np.concatenate([np.asarray(hull, float) for hull in solid.hulls])
    try:
        points = vertices[ConvexHull(vertices).vertices]
        # the engine drops corners of detailed hulls, so stability is computed from its shapes
        hull = ConvexHull(np.concatenate([_cooked(np.asarray(piece, float)) for piece in solid.hulls]))
    except (QhullError, ValueError, RuntimeError) as error:
        raise AssetError("the convex hulls enclose no volume", found=str(error).split("\n")[0]) from error
    directions, probabilities, heights = stable_directions(hull, solid.center_of_mass)
    kept = select_poses(directions, probabilities, heights, RAREST)
    probabilities = pool_probabilities(directions, probabilities, kept)
    body = _Body(solid, points, hull.points[hull.vertices])
    settled, which = _settle(body, directions[kept])
    settled, which = _firm(body, settled, which)
    if not which:
        raise AssetError(
            "the object has no stable pose", expected=f"one of {len(kept)} poses to be stable", fix="Check its mass."
        )
    directions, probabilities, _ = merge_poses(settled, probabilities[which], np.zeros(len(which)))
    poses = np.array([body.rest(up) for up in directions])
    upright = np.flatnonzero(poses[:, 2, 2] > np.cos(np.radians(UPRIGHT_DEG)))
    return RestingPoses(poses, probabilities / probabilities.sum(), int(upright[0]) if len(upright) else -1)


def _cooked(piece: Array) -> Array:
    """Return the corners (V, 3) of the engine's shape for a convex hull; boxes are exact."""
    return piece if find_box(piece) is not None else make_convex_shape(piece, physx.PhysxMaterial(1, 1, 0)).vertices


def _turn_up(up: Array) -> Array:
    """Return the shortest rotation (3, 3) of a unit vector to +z; a half turn about x for -z."""
    x, y, z = up
    if z < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    k = 1 / (1 + z)
    return np.array([[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]])


def _settle(body: _Body, directions: Array) -> tuple[Array, list[int]]:
    """Place the object in each pose, and again in the pose that it reaches, until it stays.

    Returns:
        Stable up directions (M, 3), and the indices of the initial directions.
    """
    waiting, ups, found = list(range(len(directions))), directions.copy(), {}
    points = np.stack([body.solid.center_of_mass, np.zeros(3)])
    for _ in range(ROUNDS):
        placed = np.array([turn @ body.rest(ups[i]) for i in waiting for turn in TURNS])
        ends = _simulate(body, placed + LIFT)
        moves = np.linalg.norm(
            points @ (ends - placed)[:, :3, :3].transpose(0, 2, 1) + (ends - placed)[:, None, :3, 3], axis=2
        ).max(1)
        cosines = (np.einsum("nij,nij->n", placed[:, :3, :3], ends[:, :3, :3]) - 1) / 2
        calm = (moves < MOVED) & (cosines > np.cos(np.radians(TURNED_DEG)))
        tilted = ends[:, 2, :3] / np.linalg.norm(ends[:, 2, :3], axis=1, keepdims=True)
        for i, stays, landed in zip(
            waiting, calm.reshape(-1, len(YAWS)), tilted.reshape(-1, len(YAWS), 3), strict=True
        ):
            if stays.all():
                found[i] = ups[i]
            else:
                ups[i] = landed[int(stays.argmin())]  # final pose of the first object that moved
        waiting = [i for i in waiting if i not in found]
        if not waiting:
            break
    which = sorted(found)
    return np.array([found[i] for i in which]).reshape(-1, 3), which


def _firm(body: _Body, directions: Array, which: list[int]) -> tuple[Array, list[int]]:
    """Drop poses with small toppling angles, unless there are no others; arguments and result as in `_settle`."""
    if len(directions) == 0:
        return directions, which
    margins = np.array([toppling_angle(body.cooked, body.solid.center_of_mass, up) for up in directions])
    rocks = np.array([rocks_in_place(body.cooked - body.solid.center_of_mass, up) for up in directions])
    firm = np.flatnonzero((margins >= min(MIN_TOPPLING_DEG, margins.max())) | rocks)
    return directions[firm], [which[i] for i in firm]


def _simulate(body: _Body, starts: Array) -> Array:
    """Return the poses (N, 4, 4) after 1 s of objects placed in poses (N, 4, 4)."""
    offsets = grid_origins(len(starts))
    with engine_settings():
        scene = make_scene()
        objects = []
        for start, offset in zip(starts, offsets, strict=True):
            add_ground(scene, offset)
            pose = start.copy()
            pose[:3, 3] += offset
            objects.append(add_body(scene, body.solid, pose))
        for _ in range(STEPS):
            scene.step()
        ends = np.array([pose_matrix(free) for free in objects])
    ends[:, :3, 3] -= offsets
    return ends
