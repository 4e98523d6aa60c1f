"""An exact method for collision verdicts that shares no code with FCL, and the scenes it is applied to.

Two convex polytopes {x: A x <= b} intersect if and only if their half-spaces together are feasible, which a linear
program decides. `exact_verdicts.json` holds the scenes and the verdicts. To draw the scenes and to decide them again
(10 s):

    PYTHONPATH=. python tests/planning/exact_verdicts.py
"""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import trimesh
from planning_scenes import REST, Checker, corners
from scipy.optimize import linprog
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from robocas_ms3.planning.collision import FclWorld
from robocas_ms3.planning.protocol import AttachedBody, Obstacle, Shape
from robocas_ms3.planning.shapes import MARGIN, inflated
from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.robots.urdf import RobotFiles, robot_files

STORED = Path(__file__).parent / "exact_verdicts.json"
TOUCH = 1e-6  # m; pairs nearer to touching than this are undecided
VOXEL = 0.005  # m
STATIC = ("panda_link0", "base_link")
UNDECIDED = "undecided"
DECIMALS = 4  # of stored numbers: m and rad


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


@dataclass(frozen=True)
class Scene:
    """Obstacles, a held object and configurations, as `exact_verdicts.json` has them.

    Attributes:
        obstacles: each has the ``points`` (V, 3) of a hull, m, its ``pose`` in the base frame of the arm, and the
            ``room`` to keep to it, m.
        cubes: (P, 3) centres of occupied voxels in place of obstacles, m.
        held: None, or ``points`` (V, 3) of a hull and its ``pose`` in the frame of the TCP.
        configurations: joint positions (7,) in rad and the finger width in m, of each configuration.
        contacts: of each configuration, the names of links and obstacles that touch something.
        undecided: of each configuration, the names whose nearest pair is within `TOUCH` of a touch.
    """

    obstacles: list[dict[str, Any]]
    cubes: list[list[float]]
    held: dict[str, Any] | None
    configurations: list[list[float]]
    contacts: list[list[str]]
    undecided: list[list[str]]

    @property
    def body(self) -> AttachedBody | None:
        """The held object."""
        return AttachedBody(np.array(self.held["points"]), matrix(self.held["pose"])) if self.held else None

    def world(self, files: RobotFiles) -> FclWorld:
        """Return FCL's model of the scene."""
        world = make_world(files)
        obstacles = [
            Obstacle(f"obstacle {i}", Shape((np.array(o["points"]),)), matrix(o["pose"]), o["room"])
            for i, o in enumerate(self.obstacles)
        ]
        if self.cubes:
            world.set_points(np.array(self.cubes))
        else:
            world.set_obstacles(obstacles)
        world.attach(self.body)
        return world

    def decide(self, arm: ExactArm, index: int) -> tuple[list[str], list[str]]:
        """Return the names in contact, and the undecided ones, of a configuration by linear programs."""
        placed = [
            (f"obstacle {i}", Polytope.of(inflated(np.array(o["points"]), MARGIN + o["room"])[0]).at(matrix(o["pose"])))
            for i, o in enumerate(self.obstacles)
        ]
        cube = Polytope.of(corners(*[VOXEL / 2] * 3))
        placed += [("cloud", cube.at(matrix([*centre, 0, 0, 0, 1]))) for centre in self.cubes]
        *qpos, width = self.configurations[index]
        verdicts = arm.contacts(arm.at(np.array(qpos), width, self.body), placed)
        contacts = sorted(name for name, found in verdicts.items() if True in found)
        return contacts, sorted(name for name, found in verdicts.items() if True not in found and UNDECIDED in found)


def make_world(files: RobotFiles) -> FclWorld:
    return FclWorld(files.arm_urdf, files.arm_srdf, MOBILE_PANDA, voxel=VOXEL)


def matrix(pose: list[float]) -> np.ndarray:
    """Return the 4x4 matrix of x, y, z (m) and a quaternion x, y, z, w of any length."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_quat(pose[3:]).as_matrix(), pose[:3]
    return out


def load_scenes() -> dict[str, Scene]:
    return {name: Scene(**values) for name, values in json.loads(STORED.read_text(encoding="utf-8")).items()}


def draw_scenes(files: RobotFiles) -> dict[str, Scene]:
    """Draw scenes at random, without verdicts."""
    world, scenes = make_world(files), {}
    low, high = world.chain.lower, world.chain.upper

    def configurations(rng: np.random.Generator, wide: int) -> list[list[float]]:
        """Draw 40 configurations; every ``wide``-th one is from the whole joint range, the others are near the rest."""
        samples = [
            rng.uniform(low, high) if i % wide == 0 else np.clip(REST + rng.uniform(-0.6, 0.6, 7), low, high)
            for i in range(40)
        ]
        return [rounded([*qpos, (0.0, 0.03, 0.08)[i % 3]]) for i, qpos in enumerate(samples)]

    def held(rng: np.random.Generator) -> dict[str, Any]:
        return {
            "points": rounded(rng.uniform(-0.06, 0.06, (12, 3))),
            "pose": rounded([0, 0, 0.07, *rng.uniform(-1, 1, 4)]),
        }

    for seed in range(4):
        rng, obstacles = np.random.default_rng(seed), []
        for i in range(10):
            box = corners(*rng.uniform(0.01, 0.08, 3))
            points = box if i % 2 else rng.uniform(-0.08, 0.08, (int(rng.integers(5, 40)), 3))
            pose = [*rng.uniform((0.2, -0.25, 0.1), (0.6, 0.25, 0.6)), *rng.uniform(-1, 1, 4)]
            room = float(rng.choice((0.0, 0.01)))
            obstacles.append({"points": rounded(points), "pose": rounded(pose), "room": room})
        body = held(rng) if seed % 2 else None
        scenes[f"hulls {seed}"] = Scene(obstacles, [], body, configurations(rng, wide=4), [], [])
    for seed in range(2):
        rng = np.random.default_rng(100 + seed)
        samples = rng.uniform(low, high, (500, 7))
        free = world.free(samples)  # about as many configurations with a contact as without one
        chosen = [*samples[~free][:40], *samples[free][:60]]
        chosen = [rounded([*qpos, (0.0, 0.08)[i % 2]]) for i, qpos in enumerate(chosen)]
        scenes[f"arm alone {seed}"] = Scene([], [], None, chosen, [], [])
    for seed in range(3):
        rng = np.random.default_rng(200 + seed)
        points = rng.uniform((0.3, -0.3, 0.1), (0.7, 0.3, 0.6), (150, 3))
        cubes = rounded(np.unique(np.floor(points / VOXEL), axis=0) * VOXEL + VOXEL / 2)
        scenes[f"cloud {seed}"] = Scene(
            [], cubes, held(rng) if seed % 2 else None, configurations(rng, wide=1000), [], []
        )
    return scenes


def rounded(values: Any) -> list[Any]:
    return np.round(np.asarray(values, dtype=np.float64), DECIMALS).tolist()


def main() -> None:
    """Draw the scenes, decide them and store them."""
    files = robot_files()
    scenes, arm = draw_scenes(files), ExactArm(files.arm_urdf, files.arm_srdf, Checker(files.arm_urdf))
    for scene in scenes.values():
        for i in range(len(scene.configurations)):
            contacts, undecided = scene.decide(arm, i)
            scene.contacts.append(contacts)
            scene.undecided.append(undecided)
    lines = [
        f"{json.dumps(name)}: {json.dumps(scene.__dict__, separators=(',', ':'))}" for name, scene in scenes.items()
    ]
    STORED.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
