"""FCL's collision verdicts equal those of an exact method that shares no code with it.

Two convex polytopes {x: A x <= b} intersect if and only if their half-spaces together are feasible, which a linear
program decides.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from planning_scenes import REST, Checker, corners
from scipy.optimize import linprog
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from robocas_ms3.planning.collision import FclWorld
from robocas_ms3.planning.protocol import AttachedBody, Obstacle, Shape
from robocas_ms3.planning.shapes import MARGIN, inflated
from robocas_ms3.robots.description import MOBILE_PANDA

TOUCH = 1e-6  # m; pairs nearer to touching than this are undecided
VOXEL = 0.005  # m
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
        self.parts = [(name, Polytope.of(vertices)) for name, vertices in checker.parts]
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


@dataclass(frozen=True)
class Scene:
    """Bodies or occupied voxels (P, 3), a held object, and configurations (7,) with their finger widths, m."""

    configurations: list[tuple[np.ndarray, float]]
    obstacles: list[Obstacle] | np.ndarray
    held: AttachedBody | None = None

    def decide(self, arm: ExactArm, qpos: np.ndarray, width: float) -> tuple[set[str], set[str]]:
        """Return the names in contact, and the undecided ones, by linear programs."""
        if isinstance(self.obstacles, np.ndarray):
            cube = Polytope.of(corners(*[VOXEL / 2] * 3))
            placed = [("cloud", cube.at(pose_at(centre))) for centre in self.obstacles]
        else:
            placed = [
                (body.name, Polytope.of(inflated(body.shape.hulls[0], MARGIN + body.room)[0]).at(body.pose_in_base))
                for body in self.obstacles
            ]
        verdicts = arm.contacts(arm.at(qpos, width, self.held), placed)
        contacts = {name for name, found in verdicts.items() if True in found}
        return contacts, {name for name, found in verdicts.items() if UNDECIDED in found} - contacts


def pose_at(position, turn=(0, 0, 0, 1)) -> np.ndarray:
    """Return the 4x4 matrix of a position (m) and a quaternion x, y, z, w of any length."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(turn).as_matrix(), position
    return pose


def held_object(rng: np.random.Generator) -> AttachedBody:
    return AttachedBody(rng.uniform(-0.06, 0.06, (12, 3)), pose_at([0, 0, 0.07], rng.uniform(-1, 1, 4)))


def configurations(world: FclWorld, rng: np.random.Generator, wide: int, count: int = 8) -> list:
    """Draw configurations; every ``wide``-th one is from the whole joint range, the others are near the rest."""
    low, high = world.chain.lower, world.chain.upper
    samples = [
        rng.uniform(low, high) if i % wide == 0 else np.clip(REST + rng.uniform(-0.6, 0.6, 7), low, high)
        for i in range(count)
    ]
    return [(qpos, (0.0, 0.03, 0.08)[i % 3]) for i, qpos in enumerate(samples)]


def hulls(world: FclWorld, rng: np.random.Generator, seed: int) -> Scene:
    obstacles = []
    for i in range(10):
        box = corners(*rng.uniform(0.01, 0.08, 3))
        points = box if i % 2 else rng.uniform(-0.08, 0.08, (int(rng.integers(5, 40)), 3))
        pose = pose_at(rng.uniform((0.2, -0.25, 0.1), (0.6, 0.25, 0.6)), rng.uniform(-1, 1, 4))
        obstacles.append(Obstacle(f"obstacle {i}", Shape((points,)), pose, float(rng.choice((0.0, 0.01)))))
    held = held_object(rng) if seed % 2 else None
    return Scene(configurations(world, rng, wide=4), obstacles, held)


def arm_alone(world: FclWorld, rng: np.random.Generator, seed: int) -> Scene:
    samples = rng.uniform(world.chain.lower, world.chain.upper, (200, 7))
    free = world.free(samples)  # as many configurations with a contact as without one
    chosen = [*samples[~free][:10], *samples[free][:10]]
    return Scene([(qpos, (0.0, 0.08)[i % 2]) for i, qpos in enumerate(chosen)], [])


def cloud(world: FclWorld, rng: np.random.Generator, seed: int) -> Scene:
    points = rng.uniform((0.3, -0.3, 0.1), (0.7, 0.3, 0.6), (150, 3))
    voxels = np.unique(np.floor(points / VOXEL), axis=0) * VOXEL + VOXEL / 2
    return Scene(configurations(world, rng, wide=1000), voxels, held_object(rng) if seed % 2 else None)


@pytest.fixture(scope="module")
def arm(panda_files, checker) -> ExactArm:
    return ExactArm(panda_files.arm_urdf, panda_files.arm_srdf, checker)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("draw", [hulls, arm_alone, cloud])
def test_verdicts_of_fcl_are_exact(panda_files, arm, draw, seed):
    world = FclWorld(panda_files.arm_urdf, panda_files.arm_srdf, MOBILE_PANDA)
    scene = draw(world, np.random.default_rng([seed, 1]), seed)
    world.set_scene(scene.obstacles)
    world.attach(scene.held)
    count = 0
    for qpos, width in scene.configurations:
        contacts, undecided = scene.decide(arm, qpos, width)
        found = set(world.collisions(qpos, width))
        assert found - undecided == contacts
        assert world.free(qpos[None], finger_width=width)[0] == (not found)
        count += len(contacts)
    assert count > 4
