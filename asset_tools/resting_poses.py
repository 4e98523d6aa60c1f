"""Poses in which an object rests on a plane: found on its convex hull, then proved in the physics engine."""

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
    cook,
    engine_settings,
    grid_origins,
    make_scene,
    pose_matrix,
)
from robocas_ms3.core.errors import AssetError

Array = np.ndarray

ROUNDS = 6  # seconds an object may roll until it stays
MOVED, TURNED_DEG = 0.001, 2.0  # in one second, afresh: less is at rest
YAWS = tuple(np.arange(8) * 0.8)  # rad: it must stay however it is turned, for the engine's contacts depend on it
DROP = 0.0005  # m above the plane at the start: scenes leave a gap as well
MIN_TOPPLING_DEG = 3.0  # a pose that gives way to less is no pose to put things down in, unless it only rocks
STEPS = 100  # of TIME_STEP
RAREST = 0.02  # probability of a pose

LIFT = np.zeros((4, 4))
LIFT[2, 3] = DROP
TURNS = [np.eye(4) for _ in YAWS]
for _turn, _yaw in zip(TURNS, YAWS, strict=True):
    _turn[:2, :2] = [[np.cos(_yaw), -np.sin(_yaw)], [np.sin(_yaw), np.cos(_yaw)]]


@dataclass(frozen=True)
class RestingPoses:
    """How an object rests on a plane. S poses, the most probable first.

    Attributes:
        poses: (S, 4, 4) ``T_plane_object``: the object's frame in a frame whose z = 0 is the plane, the centre of
            mass at x = y = 0; turned from the object's own axes the shortest way, so with no yaw of their own.
        probabilities: (S,) share of random drops that end in each; they sum to 1.
        display_pose: index of the pose in which the object's +z points up within 10 deg, or -1.
    """

    poses: Array
    probabilities: Array
    display_pose: int


@dataclass(frozen=True)
class _Body:
    solid: RigidBody
    points: Array  # (K, 3) corners of the hull of everything
    cooked: Array  # (L, 3) the same of the shapes that the engine makes of it

    def rest(self, up: Array) -> Array:
        """Pose (4, 4) that stands the object on the plane with a direction (3,) of its own frame up."""
        pose = np.eye(4)
        pose[:3, :3] = _turn_up(up)
        pose[:2, 3] = -(pose[:2, :3] @ self.solid.center_of_mass)
        # the engine's shapes touch the plane, but corners it dropped may not reach far below
        pose[2, 3] = max(-(self.cooked @ pose[2, :3]).min(), -(self.points @ pose[2, :3]).min() - BELOW)
        return pose


def resting_poses(solid: RigidBody) -> RestingPoses:
    """Find the poses in which an object stays where it is put. The same input gives the same poses.

    Poses of less than 2 % are left out, unless all are rare. Those of one height count together: a cylinder has many
    on its side.

    Args:
        solid: the object; the table's friction is 0.99.

    Raises:
        AssetError: the hulls are flat, the centre of mass is outside of them, or no pose stays.
    """
    vertices = np.concatenate([np.asarray(hull, float) for hull in solid.hulls])
    try:
        points = vertices[ConvexHull(vertices).vertices]
        # the engine drops corners of detailed hulls: what is stable is decided on the shapes it really has
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
        raise AssetError("the object stays in no pose", expected=f"one of {len(kept)} to hold", fix="Check its mass.")
    directions, probabilities, _ = merge_poses(settled, probabilities[which], np.zeros(len(which)))
    poses = np.array([body.rest(up) for up in directions])
    upright = np.flatnonzero(poses[:, 2, 2] > np.cos(np.radians(UPRIGHT_DEG)))
    return RestingPoses(poses, probabilities / probabilities.sum(), int(upright[0]) if len(upright) else -1)


def _cooked(piece: Array) -> Array:
    """Return the corners (V, 3) of the engine's shape of a convex hull; boxes are exact."""
    return piece if find_box(piece) is not None else cook(piece, physx.PhysxMaterial(1, 1, 0)).vertices


def _turn_up(up: Array) -> Array:
    """Shortest rotation (3, 3) that takes a unit vector to +z; half a turn about x for -z."""
    x, y, z = up
    if z < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    k = 1 / (1 + z)
    return np.array([[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]])


def _settle(body: _Body, directions: Array) -> tuple[Array, list[int]]:
    """Put the object down in each pose, and afresh in the one it ends in, until it stays where it was put.

    Returns:
        the up directions (M, 3) that stay, and which of the given ones led there.
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
                ups[i] = landed[int(stays.argmin())]  # where the first that moved came to lie
        waiting = [i for i in waiting if i not in found]
        if not waiting:
            break
    which = sorted(found)
    return np.array([found[i] for i in which]).reshape(-1, 3), which


def _firm(body: _Body, directions: Array, which: list[int]) -> tuple[Array, list[int]]:
    """Leave out poses that a touch would topple, unless there are no others; arguments and result as of `_settle`."""
    if len(directions) == 0:
        return directions, which
    margins = np.array([toppling_angle(body.cooked, body.solid.center_of_mass, up) for up in directions])
    rocks = np.array([rocks_in_place(body.cooked - body.solid.center_of_mass, up) for up in directions])
    firm = np.flatnonzero((margins >= min(MIN_TOPPLING_DEG, margins.max())) | rocks)
    return directions[firm], [which[i] for i in firm]


def _simulate(body: _Body, starts: Array) -> Array:
    """Poses (N, 4, 4) one second after the object was put down in each of the poses (N, 4, 4), one object each."""
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
