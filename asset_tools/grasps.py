"""Sample antipodal force-closure grasps of a parallel gripper on a closed mesh, without a simulator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import KDTree
from trimesh.ray.ray_pyembree import RayMeshIntersector

from robocas_ms3.assets.annotations import GRIPPER_BOXES
from robocas_ms3.core.errors import AssetError

Array = NDArray[np.float64]

MAX_WIDTH = 0.074  # m between the contacts; the gripper opens 6 mm wider
MIN_FRICTION, MAX_FRICTION = 0.1, 1.0
GOOD_FRICTIONS = (0.2, 0.4)  # a grasp above a limit is dropped if a near grasp is below it
RAYS, PAIRS, ANGLES, POINTS = 4000, 1200, 12, 3000
JITTER = 0.4  # tangent of the cone angle for half of the rays; the others follow the normal
# m, TCP beyond the contacts; the first allows to grasp thin objects on a table without touching it
DEPTHS = np.array([-0.004, 0.0, 0.01, 0.02])
FINGER_HALF_WIDTH, FINGER_Z = 0.010, (-0.04, 0.0085)  # m, flat inner faces of the fingers, as in GRIPPER_BOXES
PAD_HALF_SIZE = (0.009, 0.010)  # m, along x and z: contact area of the pads
PAD_GIVE = 0.003  # m, points within this distance of a contact's plane are touched
MAX_STICKING_OUT = 0.004  # m, largest protrusion beyond the contacts between the fingers
MIN_PAD_SHARE = 0.15
CHUNK = 128


@dataclass(frozen=True)
class Grasps:
    """Grasps of an object; the order is by quality and by distance from earlier grasps.

    Attributes:
        tcp_in_object: (G, 4, 4) poses of the TCP in the object's frame, m. z is the approach direction, y is the
            closing direction, and the origin is between the finger tips.
        widths: (G,) required distance of the fingers, m.
        qualities: (G,) smallest friction coefficient for force closure, at least 0.1; smaller is better.
    """

    tcp_in_object: Array
    widths: Array
    qualities: Array

    def __len__(self) -> int:
        return len(self.widths)

    def concatenate(self, more: Grasps) -> Grasps:
        """Return the grasps of this set, followed by the grasps of ``more``."""
        pairs = zip(vars(self).values(), vars(more).values(), strict=True)
        return Grasps(*(np.concatenate(pair) for pair in pairs))


@dataclass(frozen=True)
class _Pairs:
    """N pairs of opposite contacts.

    Attributes:
        middles: (N, 3) midpoints between the two contacts, m.
        axes: (N, 3) unit vectors from one contact to the other.
        widths: (N,) distances of the two contacts, m.
        frictions: (N,) smallest friction coefficients for force closure.
    """

    middles: Array
    axes: Array
    widths: Array
    frictions: Array


def sample_grasps(
    closed: trimesh.Trimesh, center_of_mass: Array, rng: np.random.Generator, *, count: int = 400
) -> Grasps:
    """Sample grasps that the open gripper reaches straight, spread over directions and positions.

    Args:
        closed: watertight mesh, m; may be concave.
        center_of_mass: (3,) centre of mass in the mesh's frame, m.
        rng: random generator; equal states give equal grasps.
        count: maximum number of grasps.

    Returns:
        0 to ``count`` grasps; 0 if the object is too thick everywhere.

    Raises:
        AssetError: the mesh is empty or not closed.
    """
    if len(closed.faces) == 0 or not closed.is_watertight:
        raise AssetError(
            "cannot sample grasps on an open or empty mesh",
            expected="a watertight mesh with faces",
            found=f"{len(closed.faces)} faces, watertight: {closed.is_watertight}",
        )
    points = sample_surface_points(closed, POINTS, rng)[0]
    pairs = _contact_pairs(closed, rng)
    pair, rotations, depths = _reachable(pairs, points, rng)
    limit = 30 * count  # limits the time; the remaining candidates are still dense
    if len(pair) > limit:
        keep = np.sort(rng.choice(len(pair), limit, replace=False))
        pair, rotations, depths = pair[keep], rotations[keep], depths[keep]
    widths, shares = _touched(pairs, pair, rotations, depths, points, float(closed.area))
    poses = np.tile(np.eye(4), (len(pair), 1, 1))
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = pairs.middles[pair] + depths[:, None] * rotations[:, :, 2]
    frictions = pairs.frictions[pair]
    to_center = np.asarray(center_of_mass) - pairs.middles[pair]
    # a centre of mass far from the approach line rotates the object in the pads
    lever = np.linalg.norm(np.cross(to_center, rotations[:, :, 2]), axis=1)
    distance = np.linalg.norm(to_center, axis=1)
    scores = 0.5 * shares - 2.0 * (frictions - MIN_FRICTION) - lever / 0.15 - distance / 0.3
    left = np.flatnonzero(shares >= MIN_PAD_SHARE)
    left = left[_not_dominated(poses[left], frictions[left])]
    chosen = left[select_diverse_grasps(poses[left], scores[left], count)]
    return Grasps(poses[chosen], widths[chosen], frictions[chosen])


def sample_surface_points(
    mesh: trimesh.Trimesh, count: int, rng: np.random.Generator
) -> tuple[Array, NDArray[np.int_]]:
    """Sample points on a mesh, evenly over the area; return points (P, 3) and the face (P,) of each point."""
    area = np.cumsum(mesh.area_faces)
    faces = np.searchsorted(area, (np.arange(count) + rng.random(count)) / count * area[-1])
    faces = np.minimum(faces, len(area) - 1)
    u, v = rng.random((2, count, 1))
    root = np.sqrt(u)
    a, b, c = mesh.triangles[faces].transpose(1, 0, 2)
    return (1 - root) * a + root * (1 - v) * b + root * v * c, faces


def _contact_pairs(mesh: trimesh.Trimesh, rng: np.random.Generator) -> _Pairs:
    """Sample pairs of opposite contacts with rays into the body.

    A ray starts at a random point, the first contact. The second contact is the exit of the ray from the first wall or
    from the whole object.
    """
    points, faces = sample_surface_points(mesh, RAYS, rng)
    normals = np.asarray(mesh.face_normals)
    u, v = _across(normals[faces])
    radius = JITTER * np.sqrt(rng.random(RAYS)) * (rng.random(RAYS) < 0.5)
    turn = rng.uniform(0, 2 * np.pi, RAYS)
    rays = -normals[faces] + (radius * np.cos(turn))[:, None] * u + (radius * np.sin(turn))[:, None] * v
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    caster = RayMeshIntersector(mesh)
    found = caster.intersects_id(points + 1e-4 * rays, rays, multiple_hits=True, max_hits=12, return_locations=True)
    hit_faces, ray, hits = found[0], found[1], found[-1]
    distance = np.einsum("ij,ij->i", hits - points[ray], rays[ray])
    leaves = (np.einsum("ij,ij->i", normals[hit_faces], rays[ray]) > 0) & (distance > 1e-3)
    hit_faces, ray, distance = hit_faces[leaves], ray[leaves], distance[leaves]
    order = np.lexsort((distance, ray))
    hit_faces, ray, distance = hit_faces[order], ray[order], distance[order]
    changes = ray[1:] != ray[:-1]
    nearest_or_last = np.append(True, changes) | np.append(changes, True)
    keep = np.flatnonzero((distance <= MAX_WIDTH) & nearest_or_last[: len(ray)])
    hit_faces, ray, distance = hit_faces[keep], ray[keep], distance[keep]
    axes = rays[ray]
    cosines = np.minimum(
        -np.einsum("ij,ij->i", normals[faces[ray]], axes), np.einsum("ij,ij->i", normals[hit_faces], axes)
    )
    frictions = np.maximum(np.tan(np.arccos(np.clip(cosines, 0, 1))), MIN_FRICTION)
    # pairs with low friction first, in random order; others are used only where no better pair exists
    order = np.lexsort((rng.random(len(keep)), frictions > GOOD_FRICTIONS[-1]))
    order = order[frictions[order] <= MAX_FRICTION][:PAIRS]
    middles = points[ray] + 0.5 * distance[:, None] * axes
    return _Pairs(middles[order], axes[order], distance[order], frictions[order])


def _reachable(pairs: _Pairs, points: Array, rng: np.random.Generator) -> tuple[NDArray[np.int_], Array, Array]:
    """Rotate the gripper about each closing axis, and keep poses that it reaches on a straight path.

    Args:
        pairs: pairs of contacts.
        points: (P, 3) points on the object.
        rng: random generator.

    Returns:
        For each of K grasps the index (K,) of its pair, the rotation (K, 3, 3) of the TCP, and the distance (K,) of
        the TCP beyond the contacts in m.
    """
    count = len(pairs.widths)
    u, v = _across(pairs.axes)
    turn = (np.arange(ANGLES) + rng.random((count, 1)))[..., None] * (2 * np.pi / ANGLES)
    approach = (np.cos(turn) * u[:, None] + np.sin(turn) * v[:, None]).reshape(-1, 3)
    closing = np.repeat(pairs.axes, ANGLES, axis=0)
    rotations = np.stack([np.cross(closing, approach), closing, approach], axis=2, dtype=np.float64)
    pair = np.repeat(np.arange(count), ANGLES)
    clear = np.zeros((len(pair), len(DEPTHS)), dtype=bool)
    for start in range(0, len(pair), CHUNK):
        chunk = slice(start, start + CHUNK)
        x, y, z = to_local_frames(points, rotations[chunk], pairs.middles[pair[chunk]])
        x, y = np.abs(x), np.abs(y)
        free = np.ones((len(x), len(DEPTHS)), dtype=bool)
        for low, high in GRIPPER_BOXES:
            # the box sweeps all points behind its front during the approach, so only the rearmost point matters
            inside = (x <= high[0]) & (y >= low[1]) & (y <= high[1])
            rearmost = np.where(inside, z, np.float32(np.inf)).min(axis=1)
            free &= rearmost[:, None] - DEPTHS > high[2]
        clear[chunk] = free
    grasp, depth = np.nonzero(clear)
    return pair[grasp], rotations[grasp], DEPTHS[depth]


def _touched(
    pairs: _Pairs, pair: NDArray[np.int_], rotations: Array, depths: Array, points: Array, area: float
) -> tuple[Array, Array]:
    """Return the required distance (K,) of the fingers in m, and the touching fraction (K,) of the pads.

    The fraction is that of the pad with less contact. It is 0 if a finger would touch the object elsewhere before it
    reaches the contacts.
    """
    widths, shares = np.zeros(len(pair)), np.zeros(len(pair))
    expected = max(len(points) / area * 4 * PAD_HALF_SIZE[0] * PAD_HALF_SIZE[1], 2.0)
    for start in range(0, len(pair), CHUNK):
        chunk = slice(start, start + CHUNK)
        x, y, z = to_local_frames(points, rotations[chunk], pairs.middles[pair[chunk]])
        half = 0.5 * pairs.widths[pair[chunk]].astype(np.float32)
        depth = depths[chunk, None].astype(np.float32)
        x = np.abs(x)
        between = (x <= FINGER_HALF_WIDTH) & (np.abs(y) <= 0.04)
        between &= (z >= depth + FINGER_Z[0]) & (z <= depth + FINGER_Z[1])
        right = np.maximum(np.where(between, y, 0).max(axis=1), half)
        left = np.maximum(-np.where(between, y, 0).min(axis=1), half)
        pad = between & (x <= PAD_HALF_SIZE[0]) & (np.abs(z) <= PAD_HALF_SIZE[1])
        count_right = np.sum(pad & (np.abs(y - half[:, None]) <= PAD_GIVE), axis=1)
        count_left = np.sum(pad & (np.abs(y + half[:, None]) <= PAD_GIVE), axis=1)
        fits = (np.maximum(left, right) <= half + MAX_STICKING_OUT) & (left + right <= MAX_WIDTH + 0.002)
        widths[chunk] = left + right
        shares[chunk] = np.minimum(np.minimum(count_left, count_right) / expected, 1.0) * fits
    return widths, shares


def _not_dominated(poses: Array, frictions: Array) -> NDArray[np.int_]:
    """Return the indices of grasps that have no better grasp within about 30 deg and 2 cm.

    Args:
        poses: (N, 4, 4) poses of the TCP in the object's frame.
        frictions: (N,) required friction; a grasp is better if it is below a limit that the other grasp exceeds.
    """
    keep = np.ones(len(poses), dtype=bool)
    places = np.concatenate([poses[:, :3, 2] / 0.5, poses[:, :3, 3] / 0.02], axis=1)
    for limit in GOOD_FRICTIONS:
        firm, loose = np.flatnonzero(frictions <= limit), np.flatnonzero(keep & (frictions > limit))
        if len(firm) and len(loose):
            keep[loose] = KDTree(places[firm]).query(places[loose], distance_upper_bound=1.0)[0] >= 1.0
    return np.flatnonzero(keep)


def select_diverse_grasps(poses: Array, scores: Array, count: int) -> NDArray[np.int_]:
    """Select grasps with high scores that differ in approach direction, closing axis and position.

    Each step selects the grasp with the largest sum of its score and its distance from the grasps selected before.

    Args:
        poses: (N, 4, 4) poses of the TCP in the object's frame.
        scores: (N,) scores; higher is better.
        count: maximum number of grasps.

    Returns:
        Indices (K,) in the order of selection.
    """
    closing = poses[:, :3, 1]
    both_ways = np.einsum("ni,nj->nij", closing, closing).reshape(-1, 9)  # independent of the axis' sign
    if len(poses) == 0:
        return np.zeros(0, dtype=int)
    reach = max(0.04, float(np.ptp(poses[:, :3, 3], axis=0).max()) / 4)  # long objects: directions still matter
    places = np.concatenate([poses[:, :3, 2] / 0.4, both_ways / 0.8, poses[:, :3, 3] / reach], axis=1)
    apart, picked = np.full(len(poses), 2.0), []
    for _ in range(min(count, len(poses))):
        best = int(np.argmax(scores + apart))
        picked.append(best)
        apart = np.minimum(apart, np.linalg.norm(places - places[best], axis=1))
        apart[best] = -np.inf
    return np.array(picked, dtype=int)


def to_local_frames(points: Array, rotations: Array, origins: Array) -> tuple[NDArray[np.float32], ...]:
    """Transform points to C frames.

    Args:
        points: (P, 3) points.
        rotations: (C, 3, 3) rotation of each frame.
        origins: (C, 3) origin of each frame.

    Returns:
        Coordinates x, y and z, each (C, P), in float32 for speed.
    """
    axes = rotations.transpose(2, 0, 1).astype(np.float32)  # (3, C, 3)
    offset = np.einsum("aci,ci->ac", axes, origins.astype(np.float32))
    local = axes @ points.T.astype(np.float32) - offset[..., None]
    return local[0], local[1], local[2]


def _across(directions: Array) -> tuple[Array, Array]:
    """Return two arrays (N, 3) of unit vectors that are perpendicular to ``directions`` and to each other.

    Args:
        directions: (N, 3) unit vectors.
    """
    least = np.eye(3)[np.argmin(np.abs(directions), axis=1)]
    u = np.cross(directions, least)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return u, np.cross(directions, u)
