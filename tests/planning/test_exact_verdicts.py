"""Collision verdicts equal those of an exact method that shares no code with FCL: linear programs over half-spaces.

Two convex polytopes {x: A x <= b} intersect if and only if their half-spaces together are feasible. The scenes are
generated from fixed seeds.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
from planning_scenes import REST, Checker, corners
from scipy.optimize import linprog
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from robocas_ms3.planning.collision import FclWorld
from robocas_ms3.planning.protocol import AttachedBody, Obstacle, Shape
from robocas_ms3.planning.shapes import MARGIN, inflated
from robocas_ms3.robots.description import MOBILE_PANDA

TOUCH = 1e-6  # m; pairs nearer to touching than this are undecided
VOXEL = 0.005
STATIC = ("panda_link0", "base_link")
UNDECIDED = "undecided"


@dataclass(frozen=True)
class Polytope:
    """Vertices (V, 3), and half-spaces (H, 4): unit normals and offsets, normal x + offset <= 0."""

    vertices: np.ndarray
    planes: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> Polytope:
        hull = ConvexHull(points)
        return cls(points[hull.vertices], np.unique(hull.equations.round(12), axis=0))

    def at(self, pose: np.ndarray) -> Polytope:
        normals = self.planes[:, :3] @ pose[:3, :3].T
        offsets = self.planes[:, 3] - normals @ pose[:3, 3]
        return Polytope(self.vertices @ pose[:3, :3].T + pose[:3, 3], np.column_stack([normals, offsets]))


def intersect(a: Polytope, b: Polytope) -> bool | str:
    """Whether two polytopes intersect; undecided within ``TOUCH`` of a touch."""
    for first, second in ((a, b), (b, a)):
        gaps = (second.vertices @ first.planes[:, :3].T + first.planes[:, 3]).min(axis=0)
        if gaps.max() > TOUCH:  # a plane of one separates it from the other
            return False
    planes = np.concatenate([a.planes, b.planes])
    # The radius of the largest ball in both; negative: by how much all planes have to move out until there is a point.
    found = linprog(
        [0, 0, 0, -1],
        A_ub=np.column_stack([planes[:, :3], np.ones(len(planes))]),
        b_ub=-planes[:, 3],
        bounds=[(None, None)] * 4,
        method="highs",
    )
    assert found.status == 0
    return UNDECIDED if abs(found.x[3]) < TOUCH else bool(found.x[3] > 0)


class ExactArm:
    """Link polytopes, and the pairs of links that count, read from the URDF and SRDF by this test."""

    def __init__(self, urdf: Path, srdf: Path, checker: Checker) -> None:
        self.checker = checker
        root = ElementTree.parse(urdf).getroot()
        self.parts: list[tuple[str, Polytope]] = []
        for link in root.iterfind("link"):
            for collision in link.iterfind("collision"):
                pose, box = np.eye(4), collision.find("geometry/box")
                if (origin := collision.find("origin")) is not None:
                    pose[:3, 3] = [float(value) for value in origin.attrib["xyz"].split()]
                    angles = [float(value) for value in origin.attrib["rpy"].split()]
                    pose[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
                if box is not None:
                    points = corners(*(float(value) / 2 for value in box.attrib["size"].split()))
                else:
                    mesh = collision.find("geometry/mesh").attrib["filename"]
                    points = np.asarray(trimesh.load(urdf.parent / f"{mesh}.convex.stl").vertices)
                self.parts.append((link.attrib["name"], Polytope.of(points).at(pose)))
        adjacent = {(j.find("parent").attrib["link"], j.find("child").attrib["link"]) for j in root.iterfind("joint")}
        disabled = {
            (pair.attrib["link1"], pair.attrib["link2"])
            for pair in ElementTree.parse(srdf).getroot().iterfind("disable_collisions")
        }
        self.ignored = {frozenset(pair) for pair in adjacent | disabled}
        names = {name for name, _ in self.parts}
        rigid_with_tcp = {"panda_link7", "panda_hand", "panda_leftfinger", "panda_rightfinger"}
        self.ignored |= {frozenset((name, "attached")) for name in rigid_with_tcp & names}

    def at(self, qpos: np.ndarray, width: float, body: AttachedBody | None) -> list[tuple[str, Polytope]]:
        poses = {name: self.checker.poses(name, qpos[None], width / 2)[0] for name in {name for name, _ in self.parts}}
        placed = [(name, polytope.at(poses[name])) for name, polytope in self.parts]
        if body is not None:
            tcp = self.checker.poses("panda_hand_tcp", qpos[None], width / 2)[0]
            placed.append(("attached", Polytope.of(body.vertices).at(tcp @ body.object_in_tcp)))
        return placed

    def contacts(self, placed: list[tuple[str, Polytope]], obstacles: list[tuple[str, Polytope]]) -> dict[str, set]:
        """The verdicts on all pairs that each name is part of."""
        found: dict[str, set] = {name: {False} for name, _ in [*placed, *obstacles]}
        pairs = [
            (a, b)
            for a, b in itertools.combinations(placed, 2)
            if a[0] != b[0] and frozenset((a[0], b[0])) not in self.ignored
        ]
        pairs += [(a, b) for a in placed if a[0] not in STATIC for b in obstacles]
        for (first, a), (second, b) in pairs:
            verdict = intersect(a, b)
            found[first].add(verdict)
            found[second].add(verdict)
        return found


@pytest.fixture(scope="module")
def arm(panda_files, checker) -> ExactArm:
    return ExactArm(panda_files.arm_urdf, panda_files.arm_srdf, checker)


@pytest.fixture
def world(panda_files) -> FclWorld:
    return FclWorld(panda_files.arm_urdf, panda_files.arm_srdf, MOBILE_PANDA, voxel=VOXEL)


def random_pose(rng: np.random.Generator, position: np.ndarray) -> np.ndarray:
    pose, quaternion = np.eye(4), rng.uniform(-1, 1, 4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), position
    return pose


def random_qpos(rng: np.random.Generator, world: FclWorld, *, wide: bool) -> np.ndarray:
    low, high = world.chain.lower, world.chain.upper
    return rng.uniform(low, high) if wide else np.clip(REST + rng.uniform(-0.6, 0.6, 7), low, high)


def compare(found: list[str], exact: dict[str, set]) -> tuple[int, int, int]:
    """Compare all names of one configuration; return how many are equal and hit, equal and free, and undecided."""
    hit = free = undecided = 0
    for name, verdicts in exact.items():
        if True not in verdicts and UNDECIDED in verdicts:
            undecided += 1
            continue
        assert (name in found) == (True in verdicts), name
        hit, free = hit + (True in verdicts), free + (True not in verdicts)
    return hit, free, undecided


@pytest.mark.parametrize("seed", range(4))
def test_links_bodies_and_held_objects(arm, world, seed):
    """Boxes and hulls of random points in reach of the arm; half of the scenes with a held object."""
    rng = np.random.default_rng(seed)
    obstacles, exact_obstacles = [], []
    for i in range(10):
        points = (
            corners(*rng.uniform(0.01, 0.08, 3)) if i % 2 else rng.uniform(-0.08, 0.08, (int(rng.integers(5, 40)), 3))
        )
        room, pose = float(rng.choice((0.0, 0.01))), random_pose(rng, rng.uniform((0.2, -0.25, 0.1), (0.6, 0.25, 0.6)))
        obstacles.append(Obstacle(f"obstacle {i}", Shape((points,)), pose, room))
        exact_obstacles.append((f"obstacle {i}", Polytope.of(inflated(points, MARGIN + room)[0]).at(pose)))
    world.set_obstacles(obstacles)
    body = (
        AttachedBody(rng.uniform(-0.06, 0.06, (12, 3)), random_pose(rng, np.array([0, 0, 0.07]))) if seed % 2 else None
    )
    world.attach(body)
    counts = np.zeros(3, dtype=int)
    for i in range(40):
        qpos, width = random_qpos(rng, world, wide=i % 4 == 0), (0.0, 0.03, 0.08)[i % 3]
        exact = arm.contacts(arm.at(qpos, width, body), exact_obstacles)
        found = world.contacts(qpos, width)
        counts += compare(found, exact)
        assert world.free(qpos[None], finger_width=width)[0] == (found == [])
    hit, free, undecided = counts
    assert hit >= 30 and free >= 600
    assert undecided <= 2


@pytest.mark.parametrize("seed", range(2))
def test_self_collisions_over_the_whole_joint_range(arm, world, seed):
    rng, counts = np.random.default_rng(100 + seed), np.zeros(3, dtype=int)
    samples = np.array([random_qpos(rng, world, wide=True) for _ in range(500)])
    free_by_world = world.free(samples)
    for i, qpos in enumerate([*samples[~free_by_world][:40], *samples[free_by_world][:60]]):
        width = (0.0, 0.08)[i % 2]
        counts += compare(world.contacts(qpos, width), arm.contacts(arm.at(qpos, width, None), []))
    hit, free, undecided = counts
    assert hit >= 30 and free >= 400
    assert undecided <= 1


@pytest.mark.parametrize("seed", range(3))
def test_point_clouds(arm, world, seed):
    """Each point stands for the cube of the voxel grid that it is in."""
    rng = np.random.default_rng(200 + seed)
    points = rng.uniform((0.3, -0.3, 0.1), (0.7, 0.3, 0.6), (150, 3))
    cubes = np.unique(np.floor(points / VOXEL), axis=0) * VOXEL + VOXEL / 2
    body = (
        AttachedBody(rng.uniform(-0.06, 0.06, (12, 3)), random_pose(rng, np.array([0, 0, 0.07]))) if seed % 2 else None
    )
    world.attach(body)
    world.set_points(points)
    cube, shifts = Polytope.of(corners(*[VOXEL / 2] * 3)), np.tile(np.eye(4), (len(cubes), 1, 1))
    shifts[:, :3, 3] = cubes
    exact_cloud, counts = [("cloud", cube.at(shift)) for shift in shifts], np.zeros(3, dtype=int)
    for i in range(40):
        qpos, width = random_qpos(rng, world, wide=False), (0.0, 0.03, 0.08)[i % 3]
        exact = arm.contacts(arm.at(qpos, width, body), exact_cloud)
        counts += compare(world.contacts(qpos, width), exact)
    hit, free, undecided = counts
    assert hit >= 20 and free >= 200
    assert undecided <= 2
