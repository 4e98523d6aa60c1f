"""Drop test: measure whether a dropped object comes to rest in one of its annotated resting poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sapien import physx
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from robocas_ms3.assets.hulls import Hull, make_convex_mesh, sample_surface
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
TIME_LIMIT = 2.0  # s, limit for coming to rest
WATCHED = 1.0  # s of observation afterwards
REST_ENERGY = 4.5e-4  # J/kg, equal to 3 cm/s, the limit of the tasks
SAME, SAME_DEG = 0.003, 3.0  # m and deg, tolerance for equal poses
SPACING, MAX_POINTS = 0.004, 500  # m; points for the comparison of poses
ONE_WAY = 0.8  # displacement over path length of a rolling object; less for rocking
LEAST_PATH = 0.01  # m
# uniform rolling has a kinetic energy of 0.7 m v^2 (ball) to m v^2 (pipe); checked in 90 % of the steps, because of
# facets
CARRIED, MOSTLY = 0.5, 0.9
CHECK_INTERVAL = 10  # time steps between checks of the pose of a rolling object


@dataclass(frozen=True)
class DropReport:
    """Results of N drops of an object.

    Attributes:
        ends: (N, 4, 4) last poses of the object; the table is the plane z = 0, and x = y = 0 is below the start.
        rest_times: (N,) times from release to rest or to uniform rolling, s; 3 s: the object still moves.
        matches: (N,) index of the resting pose that equals the last pose; -1: none.
        penetrations: (N,) largest final depth of corners below the table and of contacts in PhysX, m.
        jitters: (N,) largest kinetic energy in the last second, J.
        rolling: (N,) whether the object rolls uniformly at the end, which counts as rest.
        good: (N,) whether the object was at rest within 2 s and ended in a resting pose of the list.
    """

    ends: Array
    rest_times: Array
    matches: Array
    penetrations: Array
    jitters: Array
    rolling: NDArray[np.bool_]
    good: NDArray[np.bool_]


def run_drop_test(solid: RigidBody, resting_poses: Array, *, seed: int = 0) -> DropReport:
    """Drop an object 20 times from 5 cm onto a table in random orientations and simulate 3 s.

    The result is deterministic.

    An object is at rest as soon as its kinetic energy stays below 4.5e-4 J/kg until the end. An object that trembles is
    never at rest.

    Two poses are compared by points on the surface: by their heights, and by their distances from the vertical line
    through the centre of mass. The poses are equal if 95 % of the points agree within 3 mm, or within 3 deg at the
    point farthest from the centre of mass. So poses that differ by yaw or by a symmetry of the object are equal. A ball
    has one pose. A can has two: upright (either end up) and on its side. A box has one per pair of faces.

    PhysX has no rolling resistance, so a can on its side does not stop. Uniform rolling therefore counts as rest. An
    object rolls uniformly if, for at least 1 s until the end, it stays in resting poses of the list and its
    displacement is at least 80 % of its path. Rocking and trembling objects do not meet this condition.

    Args:
        solid: the object.
        resting_poses: (S, 4, 4) ``T_plane_object``, the list of resting poses.
        seed: seed of the orientations.
    """
    poses, velocities, energies, sunk = _fall(solid, seed)
    last = round(WATCHED / TIME_STEP)
    moving = energies >= REST_ENERGY * solid.mass
    rest_times = TIME_STEP * (len(energies) - np.argmax(moving[::-1], axis=0)) * moving.any(axis=0)
    matches, rolling = np.full(DROPS, -1), np.zeros(DROPS, bool)
    compare = _Comparison(solid, resting_poses)
    for i in range(DROPS):
        matches[i] = compare.find_match(poses[-1, i])
        if rest_times[i] > TIME_LIMIT and matches[i] >= 0:
            since = compare.count_matches(poses[::-CHECK_INTERVAL, i]) * CHECK_INTERVAL
            late = moving[-last:, i]
            carried = solid.mass * (velocities[-last:, i] ** 2).sum(axis=1) >= CARRIED * energies[-last:, i]
            rolling[i] = since >= last and np.mean(carried[late]) >= MOSTLY and _advances(velocities[-since:, i])
            if rolling[i]:
                rest_times[i] = TIME_STEP * max(len(energies) - since, 0)
    good = (rest_times <= TIME_LIMIT) & (matches >= 0)
    return DropReport(poses[-1], rest_times, matches, sunk, energies[-last:].max(axis=0), rolling, good)


def _advances(velocities: Array) -> bool:
    """Return whether a motion with velocities (T, 2) in m/s has mainly one direction, over 1 cm."""
    path = TIME_STEP * np.linalg.norm(velocities, axis=1).sum()
    ahead = TIME_STEP * np.linalg.norm(velocities.sum(axis=0))
    return bool(path >= LEAST_PATH and ahead >= ONE_WAY * path)


def _fall(solid: RigidBody, seed: int) -> tuple[Array, Array, Array, Array]:
    """Simulate N drops of T time steps.

    Returns:
        Poses (T, N, 4, 4), horizontal velocities (T, N, 2) in m/s, kinetic energies (T, N) in J, and penetrations (N,)
        at the end in m.
    """
    vertices = np.concatenate([np.asarray(hull, float) for hull in solid.hulls])
    turns = Rotation.from_quat(
        np.random.default_rng(seed).normal(size=(DROPS, 4))
    ).as_matrix()  # uniform over all rotations
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
    """Return the kinetic energy of a body in J."""
    speed, spin = np.asarray(body.linear_velocity), np.asarray(body.angular_velocity)
    axes = (body.entity_pose * body.cmass_local_pose).to_transformation_matrix()[:3, :3]
    return 0.5 * float(solid.mass * (speed @ speed) + solid.inertia @ (spin @ axes) ** 2)


class _Comparison:
    """Comparison of poses of an object with its S resting poses, by the rule in `run_drop_test`."""

    def __init__(self, solid: RigidBody, listed: Array) -> None:
        points = sample_surface([Hull(*make_convex_mesh(np.asarray(hull, float))) for hull in solid.hulls], SPACING)
        self._points = points[:: len(points) // MAX_POINTS + 1]
        self._center = solid.center_of_mass
        reach = np.linalg.norm(self._points - self._center, axis=1).max()
        self._limit = max(SAME, reach * np.sin(np.radians(SAME_DEG)))
        self._listed = [self._profile(pose) for pose in listed]
        self._trees = [KDTree(profile) for profile in self._listed]

    def find_match(self, pose: Array) -> int:
        """Return the index of the resting pose that is most similar to ``pose`` (4, 4); -1 if none is equal."""
        apart = [self._apart(pose, index) for index in range(len(self._listed))]
        return int(np.argmin(apart)) if min(apart) <= self._limit else -1

    def count_matches(self, poses: Array) -> int:
        """Return how many of the first poses of (T, 4, 4) are equal to a resting pose without a gap."""
        likely = list(range(len(self._listed)))
        for count, pose in enumerate(poses):
            found = next((index for index in likely if self._apart(pose, index) <= self._limit), None)
            if found is None:
                return count
            likely.remove(found)
            likely.insert(0, found)  # the next pose is probably the same
        return len(poses)

    def _apart(self, pose: Array, index: int) -> float:
        profile = self._profile(pose)
        there, back = self._trees[index].query(profile)[0], KDTree(profile).query(self._listed[index])[0]
        return float(max(np.percentile(there, 95), np.percentile(back, 95)))

    def _profile(self, pose: Array) -> Array:
        """Return height above the table and distance from the vertical line (P, 2) of surface points, m.

        The vertical line passes through the centre of mass of the object in ``pose`` (4, 4).
        """
        placed = (self._points - self._center) @ pose[:3, :3].T
        heights = placed[:, 2] + pose[2, :3] @ self._center + pose[2, 3]
        return np.stack([heights, np.linalg.norm(placed[:, :2], axis=1)], axis=1)
