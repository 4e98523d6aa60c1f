"""Drop an object many times: whether it comes to rest in a listed pose, without sinking in or trembling."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sapien import physx
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from robocas_ms3.assets.hulls import Hull, convex_faces, sample_surface
from robocas_ms3.assets.physics import (
    TIME_STEP,
    RigidBody,
    add_body,
    add_ground,
    engine_settings,
    grid_origins,
    make_scene,
    pose_matrix,
)

Array = np.ndarray

DROPS = 20
DROP_HEIGHT = 0.05  # m, of the lowest point
TIME_LIMIT = 2.0  # s, to be at rest within
WATCHED = 1.0  # s, that it is watched for afterwards
REST_ENERGY = 4.5e-4  # J per kg: an even 3 cm/s, which the tasks call at rest
SAME, SAME_DEG = 0.003, 3.0  # m in height and distance from the axis, or what a tilt moves its far end: still one pose
SPACING, MAX_POINTS = 0.004, 500  # m; of the points that poses are compared by
ONE_WAY = 0.8  # of its path is what a rolling object gets ahead; what rocks comes back, what rolls just at its end
LEAST_PATH = 0.01  # m
# An even roll has a kinetic energy of 0.7 m v^2 (a ball) to m v^2 (a pipe); in nine of ten steps, for facets bump.
CARRIED, MOSTLY = 0.5, 0.9
LOOK_EVERY = 10  # time steps between the poses in which a rolling object is looked at


@dataclass(frozen=True)
class DropReport:
    """What became of N drops.

    Attributes:
        ends: (N, 4, 4) last pose of the object's frame, on the plane z = 0 under the place it fell from.
        rest_times: (N,) s from letting go until it moved no more, or only rolled on; 3 s: it still moves.
        matches: (N,) which resting pose it lies in; -1: none that is listed.
        penetrations: (N,) m, deepest at the end: of corners below the plane, and of contacts as the engine sees them.
        jitters: (N,) J, largest kinetic energy in the last of the 3 s.
        rolling: (N,) bool: it wasn't at rest in time but for rolling on.
        good: (N,) bool: at rest in time, in a listed pose.
    """

    ends: Array
    rest_times: Array
    matches: Array
    penetrations: Array
    jitters: Array
    rolling: NDArray[np.bool_]
    good: NDArray[np.bool_]


def drop_test(solid: RigidBody, resting_poses: Array, *, seed: int = 0) -> DropReport:
    """Let an object fall 20 times from 5 cm above a table, turned at random, for 3 s; repeatable.

    It is at rest once its kinetic energy stays below 4.5e-4 J/kg for good; so what trembles is never at rest.

    Two poses are the same if the object fills the same heights and distances from the vertical through its centre of
    mass in both, to 3 mm or to 3 deg of its farthest point (95 % of points on its surface): this is true of poses that
    differ by a yaw, and of those that the object's own symmetry makes alike, however it is symmetric. A ball has one
    pose, a can has two: standing (either end up) and lying; a box has one for each pair of faces.

    A table without rolling resistance, which the engine doesn't have, doesn't stop a can. What only rolls counts as at
    rest from where that begins: from there to the end, for a second at least, it keeps to the listed poses in this
    sense, and gets ahead by 80 % of its path, with its energy in that. What rocks comes back, what trembles stays.

    Args:
        solid: the object.
        resting_poses: (S, 4, 4) ``T_plane_object``, those listed.
        seed: of the orientations.
    """
    poses, velocities, energies, sunk = _fall(solid, seed)
    last = round(WATCHED / TIME_STEP)
    moving = energies >= REST_ENERGY * solid.mass
    rest_times = TIME_STEP * (len(energies) - np.argmax(moving[::-1], axis=0)) * moving.any(axis=0)
    matches, rolling = np.full(DROPS, -1), np.zeros(DROPS, bool)
    compare = _Comparison(solid, resting_poses)
    for i in range(DROPS):
        matches[i] = compare.find(poses[-1, i])
        if rest_times[i] > TIME_LIMIT and matches[i] >= 0:
            since = compare.since(poses[::-LOOK_EVERY, i]) * LOOK_EVERY
            late = moving[-last:, i]
            carried = solid.mass * (velocities[-last:, i] ** 2).sum(axis=1) >= CARRIED * energies[-last:, i]
            rolling[i] = since >= last and np.mean(carried[late]) >= MOSTLY and _advances(velocities[-since:, i])
            if rolling[i]:
                rest_times[i] = TIME_STEP * max(len(energies) - since, 0)
    good = (rest_times <= TIME_LIMIT) & (matches >= 0)
    return DropReport(poses[-1], rest_times, matches, sunk, energies[-last:].max(axis=0), rolling, good)


def _advances(velocities: Array) -> bool:
    """Whether a motion (T, 2) goes one way on the whole."""
    path = TIME_STEP * np.linalg.norm(velocities, axis=1).sum()
    ahead = TIME_STEP * np.linalg.norm(velocities.sum(axis=0))
    return bool(path >= LEAST_PATH and ahead >= ONE_WAY * path)


def _fall(solid: RigidBody, seed: int) -> tuple[Array, Array, Array, Array]:
    """Poses (T, N, 4, 4), horizontal velocities (T, N, 2), kinetic energies (T, N), final penetrations (N,)."""
    vertices = np.concatenate([np.asarray(hull, float) for hull in solid.hulls])
    turns = Rotation.from_quat(np.random.default_rng(seed).normal(size=(DROPS, 4))).as_matrix()  # evenly over all
    origins = grid_origins(DROPS)
    steps = round((TIME_LIMIT + WATCHED) / TIME_STEP)
    poses, velocities, energies = np.zeros((steps, DROPS, 4, 4)), np.zeros((steps, DROPS, 2)), np.zeros((steps, DROPS))
    with engine_settings():
        scene = make_scene()
        bodies: list[physx.PhysxRigidDynamicComponent] = []
        for turn, origin in zip(turns, origins, strict=True):
            add_ground(scene, origin)
            pose = np.eye(4)
            pose[:3, :3] = turn
            pose[:3, 3] = origin + [0, 0, DROP_HEIGHT - (vertices @ turn[2]).min()]
            bodies.append(add_body(scene, solid, pose))
        for step in range(steps):
            scene.step()
            for i, body in enumerate(bodies):
                poses[step, i] = pose_matrix(body)
                velocities[step, i] = body.linear_velocity[:2]
                energies[step, i] = _energy(body, solid)
        sunk = np.array([max(0.0, -(vertices @ pose[2, :3]).min() - pose[2, 3]) for pose in poses[-1]])
        which: dict[object, int] = {body: i for i, body in enumerate(bodies)}
        system = scene.physx_system
        assert isinstance(system, physx.PhysxCpuSystem)
        for contact in system.get_contacts():
            i = next(which[body] for body in contact.bodies if body in which)
            sunk[i] = max([sunk[i], *(-point.separation for point in contact.points)])
    poses[..., :3, 3] -= origins
    return poses, velocities, energies, sunk


def _energy(body: physx.PhysxRigidDynamicComponent, solid: RigidBody) -> float:
    """Kinetic energy, J."""
    speed, spin = np.asarray(body.linear_velocity), np.asarray(body.angular_velocity)
    axes = (body.entity_pose * body.cmass_local_pose).to_transformation_matrix()[:3, :3]
    return 0.5 * float(solid.mass * (speed @ speed) + solid.inertia @ (spin @ axes) ** 2)


class _Comparison:
    """Which of the listed poses (S, 4, 4) a pose is the same as; see `drop_test`."""

    def __init__(self, solid: RigidBody, listed: Array) -> None:
        points = sample_surface([Hull(*convex_faces(np.asarray(hull, float))) for hull in solid.hulls], SPACING)
        self._points = points[:: len(points) // MAX_POINTS + 1]
        self._center = solid.center_of_mass
        reach = np.linalg.norm(self._points - self._center, axis=1).max()
        self._limit = max(SAME, reach * np.sin(np.radians(SAME_DEG)))
        self._listed = [self._profile(pose) for pose in listed]
        self._trees = [KDTree(profile) for profile in self._listed]

    def find(self, pose: Array) -> int:
        """The listed pose that is most like a pose (4, 4), or -1."""
        apart = [self._apart(pose, index) for index in range(len(self._listed))]
        return int(np.argmin(apart)) if min(apart) <= self._limit else -1

    def since(self, poses: Array) -> int:
        """How many of the first poses (T, 4, 4) are the same as a listed one."""
        likely = list(range(len(self._listed)))
        for count, pose in enumerate(poses):
            found = next((index for index in likely if self._apart(pose, index) <= self._limit), None)
            if found is None:
                return count
            likely.remove(found)
            likely.insert(0, found)  # the next one is much the same
        return len(poses)

    def _apart(self, pose: Array, index: int) -> float:
        profile = self._profile(pose)
        there, back = self._trees[index].query(profile)[0], KDTree(profile).query(self._listed[index])[0]
        return float(max(np.percentile(there, 95), np.percentile(back, 95)))

    def _profile(self, pose: Array) -> Array:
        """Height above the plane and distance from the vertical through the centre of mass, (P, 2), m."""
        placed = (self._points - self._center) @ pose[:3, :3].T
        heights = placed[:, 2] + pose[2, :3] @ self._center + pose[2, 3]
        return np.stack([heights, np.linalg.norm(placed[:, :2], axis=1)], axis=1)
