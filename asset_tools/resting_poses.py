"""Find resting poses of an object on a plane from its convex hull, and verify them in PhysX."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from sapien import physx
from scipy.spatial import ConvexHull, QhullError

from asset_tools.stability import (
    BELOW,
    UPRIGHT_DEG,
    compute_toppling_angle,
    find_stable_directions,
    merge_poses,
    pool_probabilities,
    rocks_in_place,
    select_poses,
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
            mass at x = y = 0. The rotation is the shortest rotation to this pose, so it has no yaw.
        probabilities: (S,) estimated fraction of random drops that end in each pose; the sum is 1.
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

    def place_with_up(self, up: Array) -> Array:
        """Return the pose (4, 4) on the plane z = 0 in which ``up``, (3,) in the object's frame, is up."""
        pose = np.eye(4)
        pose[:3, :3] = _turn_up(up)
        pose[:2, 3] = -(pose[:2, :3] @ self.solid.center_of_mass)
        # the engine's shapes touch the plane; corners that it dropped may be at most BELOW under it
        pose[2, 3] = max(-(self.cooked @ pose[2, :3]).min(), -(self.points @ pose[2, :3]).min() - BELOW)
        return pose


def find_resting_poses(solid: RigidBody) -> RestingPoses:
    """Find the poses in which an object stays when it is placed on a table; deterministic.

    The function drops poses with a probability below 2 %, unless all poses are rarer. For this limit, the
    probabilities of poses with equal height of the centre of mass are added, since a cylinder has many poses on its
    side.

    Args:
        solid: the object; the friction coefficient of the table is 0.99.

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
    directions, probabilities, heights = find_stable_directions(hull, solid.center_of_mass)
    kept = select_poses(directions, probabilities, heights, RAREST)
    probabilities = pool_probabilities(directions, probabilities, kept)
    body = _Body(solid, points, hull.points[hull.vertices])
    settled, which = _settle(body, directions[kept])
    settled, which = _firm(body, settled, which)
    if not which:
        raise AssetError(
            "the object has no stable pose",
            expected="at least one stable pose",
            found=f"none of {len(kept)} poses was stable",
            fix="Check the mass of the object.",
        )
    directions, probabilities, _ = merge_poses(settled, probabilities[which], np.zeros(len(which)))
    poses = np.array([body.place_with_up(up) for up in directions])
    upright = np.flatnonzero(poses[:, 2, 2] > np.cos(np.radians(UPRIGHT_DEG)))
    return RestingPoses(poses, probabilities / probabilities.sum(), int(upright[0]) if len(upright) else -1)


def _cooked(piece: Array) -> Array:
    """Return the corners (V, 3) of the shape that PhysX makes of a convex hull; a box keeps its corners."""
    return piece if find_box(piece) is not None else make_convex_shape(piece, physx.PhysxMaterial(1, 1, 0)).vertices


def _turn_up(up: Array) -> Array:
    """Return the shortest rotation (3, 3) from a unit vector (3,) to +z; for -z, a half turn about x."""
    x, y, z = up
    if z < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    k = 1 / (1 + z)
    return np.array([[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]])


def _settle(body: _Body, directions: Array) -> tuple[Array, list[int]]:
    """Simulate the object from each pose, and again from the pose that it reached, until it stays.

    Args:
        body: the object.
        directions: (N, 3) directions of the object's frame that point up in the poses.

    Returns:
        The up directions (M, 3) of the poses in which the object stayed, and the M indices of the poses at the start.
    """
    waiting, ups, found = list(range(len(directions))), directions.copy(), {}
    points = np.stack([body.solid.center_of_mass, np.zeros(3)])
    for _ in range(ROUNDS):
        placed = np.array([turn @ body.place_with_up(ups[i]) for i in waiting for turn in TURNS])
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
    """Drop poses with toppling angles below 3 deg, unless all are smaller or the object only rocks.

    Args:
        body: the object.
        directions: (M, 3) up directions of the poses.
        which: M indices of the poses.

    Returns:
        The directions and indices of the remaining poses.
    """
    if len(directions) == 0:
        return directions, which
    margins = np.array([compute_toppling_angle(body.cooked, body.solid.center_of_mass, up) for up in directions])
    rocks = np.array([rocks_in_place(body.cooked - body.solid.center_of_mass, up) for up in directions])
    firm = np.flatnonzero((margins >= min(MIN_TOPPLING_DEG, margins.max())) | rocks)
    return directions[firm], [which[i] for i in firm]


def _simulate(body: _Body, starts: Array) -> Array:
    """Simulate N separate copies of an object from poses (N, 4, 4).

    Return their poses (N, 4, 4) after 1 s.
    """
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
