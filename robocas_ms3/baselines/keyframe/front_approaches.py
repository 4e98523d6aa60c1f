"""Approaches of grasps in a compartment: into it from the front, and out of it with the object."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from robocas_ms3.baselines.keyframe.handles import Handle
from robocas_ms3.baselines.keyframe.motion import Approach, ArmPaths
from robocas_ms3.core.poses import Array
from robocas_ms3.scenes.grasp_checks import HALF_TURN, PREGRASP_DISTANCE

_ENTRY_DISTANCES, _LIFT = (0.2, 0.15, 0.1, 0.06), 0.025  # m before the pre-grasp; m of the way out above the way in
_EXIT_DISTANCES = (0.06, 0.1, 0.15, 0.2, 0.25, 0.3)  # m from the pre-grasp back to poses on the way out
_MAX_ENTRIES = 32  # grasps for which approaches are planned
_FAR_OUT = 0.28  # m from the grasp to the end of the way out, horizontally, if the front is not known
_OUTSIDE = 0.12  # m from the front to the TCP outside of the compartment


@dataclass(frozen=True)
class Front:
    """Vertical plane before which the gripper is outside of a compartment, in the arm's base frame.

    Attributes:
        position: (3,) point on the plane, m.
        inwards: (3,) horizontal unit vector into the compartment.
    """

    position: Array
    inwards: Array

    @classmethod
    def from_handle(cls, handle: Handle) -> Front:
        """Return the plane before the handle of a closed door."""
        inwards = np.array([*handle.approach[:2], 0.0])
        inwards /= np.linalg.norm(inwards)
        return cls(handle.position - _OUTSIDE * inwards, inwards)

    def depths(self, points: Array) -> Array:
        """Return how far points (..., 3) are behind the plane, m."""
        return (points - self.position) @ self.inwards

    def move_out(self, tcp_in_base: Array) -> Array:
        """Return TCP poses (N, 4, 4) after a straight motion to the plane; poses before it stay."""
        moved = tcp_in_base.copy()
        moved[:, :3, 3] -= np.maximum(self.depths(moved[:, :3, 3]), 0)[:, None] * self.inwards
        return moved


def plan_front_approaches(
    paths: ArmPaths, grasps: Array, scores: Array, qpos: Array, front: Front | None, is_clear: Callable[[Array], bool]
) -> Iterator[Approach]:
    """Yield approaches of the best grasps from outside of a compartment, the one with the greatest score first.

    The gripper enters towards the object, and moves back out after a short lift. Approaches that do not leave the
    compartment, or are not clear before the pre-grasp, come last.

    Args:
        paths: kinematics of the arm.
        grasps: (G, 4, 4) TCP poses in the arm's base frame.
        scores: (G,) score of each grasp.
        qpos: (7,) present configuration, rad.
        front: front of the compartment; None: not known.
        is_clear: returns whether a path (n, 7) is clear of obstacles.
    """
    fallbacks = []
    for index in np.argsort(-scores, kind="stable")[:_MAX_ENTRIES].tolist():
        for grasp in (grasps[index], grasps[index] @ HALF_TURN):
            found = _plan_entry(paths, grasp, qpos, front)
            if found is None:
                continue
            assert found.exit_path is not None
            goes_out = _is_outside(paths.chain.tcp(found.exit_path[-1:])[0], grasp, front)
            ways = (_select_outer_part(paths, path, grasp) for path in (found.path[::-1], found.exit_path))
            if goes_out and all(is_clear(way) for way in ways):
                yield found
            else:
                fallbacks.append(found)
    yield from fallbacks


def _select_outer_part(paths: ArmPaths, exit_path: Array, grasp: Array) -> Array:
    """Return the part of a path (n, 7) from a grasp (4, 4) outwards that is beyond the pre-grasp."""
    away = np.linalg.norm(paths.chain.tcp(exit_path)[:, :3, 3] - grasp[:3, 3], axis=1)
    return exit_path[away > PREGRASP_DISTANCE]


def _is_outside(end: Array, grasp: Array, front: Front | None) -> bool:
    """Return whether a way out from a grasp (4, 4) to a pose (4, 4) leaves the compartment."""
    if front is None:
        return bool(np.linalg.norm(end[:2, 3] - grasp[:2, 3]) > _FAR_OUT)
    return bool(front.depths(end[:3, 3]) < _OUTSIDE / 2)


def _plan_entry(paths: ArmPaths, grasp: Array, qpos: Array, front: Front | None) -> Approach | None:
    """Return the approach of a grasp (4, 4) that starts as far before the pre-grasp as possible, or None."""
    before = _move_back(grasp, grasp[:3, 2], (PREGRASP_DISTANCE,))[0]
    inwards = np.array([*grasp[:2, 2], 0.0]) / np.linalg.norm(grasp[:2, 2])
    starts = _move_back(before, inwards, _ENTRY_DISTANCES)
    ends = _move_back(before, inwards, _EXIT_DISTANCES)
    raised = np.stack([grasp, before, *ends])
    raised[:, 2, 3] += _LIFT
    reachable, found = paths.reach(np.concatenate([[grasp, before], raised, starts]), qpos)
    if not reachable[:4].all():  # the grasp, the pre-grasp, and both raised
        return None
    exits = raised[2:][reachable[4 : -len(starts)]]
    entries = found[-len(starts) :][reachable[-len(starts) :]]
    entry_paths = ((start, _connect(paths, start, [before, grasp])) for start in entries)
    start, entry_path = next(((start, path) for start, path in entry_paths if path is not None), (qpos, None))
    if entry_path is None:
        return None
    lifted = _connect(paths, entry_path[-1], list(raised[:2]))
    if lifted is None:
        return None
    exit_path = _plan_exit(paths, lifted[-1], exits, front)
    return None if exit_path is None else Approach(grasp, start, entry_path, np.concatenate([lifted, exit_path]))


def _plan_exit(paths: ArmPaths, qpos: Array, exits: Array, front: Front | None) -> Array | None:
    """Return the path (n, 7) through poses (E, 4, 4) on the way out as far as there is one, or None.

    If the last pose is not outside, the gripper moves on perpendicularly to the front.
    """
    found = []
    for pose in exits:
        path = paths.straight(qpos, pose, sequential=False)
        if path is None:
            break
        found.append(path)
        qpos = path[-1]
        if front is not None and front.depths(pose[:3, 3]) <= 0:
            break
    if not found:
        return None
    last = paths.chain.tcp(qpos[None])[0]
    if front is not None and front.depths(last[:3, 3]) > 0:
        outwards = paths.straight(qpos, front.move_out(last[None])[0], sequential=False)
        if outwards is not None:
            found.append(outwards)
    return np.concatenate(found)


def _move_back(pose: Array, direction: Array, distances: tuple[float, ...]) -> Array:
    """Return the poses (N, 4, 4) at N distances in m from a pose (4, 4), against a direction (3,)."""
    poses = np.tile(pose, (len(distances), 1, 1))
    poses[:, :3, 3] -= np.outer(distances, direction)
    return poses


def _connect(paths: ArmPaths, qpos: Array, poses: list[Array]) -> Array | None:
    """Return straight paths (n, 7) through TCP poses (4, 4), one after another, or None."""
    found = []
    for pose in poses:
        path = paths.straight(qpos, pose, sequential=False)
        if path is None:
            return None
        found.append(path)
        qpos = path[-1]
    return np.concatenate(found)
