"""Table scene of known boxes, and the links of the arm according to its URDF."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.robots.description_file import RobotXml, chain_poses

REST = np.array([0, -1.02, 0, -2.51, 0, 1.35, 0.78])


@dataclass(frozen=True)
class Box:
    """Box in the arm's base frame: centre, edge lengths (m), yaw (rad)."""

    center: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float = 0.0

    def matrix(self) -> np.ndarray:
        return Rotation.from_euler("z", self.yaw).as_matrix()

    def surface(self, spacing: float = 0.005) -> np.ndarray:
        """Points (P, 3) on all six faces, at most ``spacing`` apart."""
        faces = []
        for axis in range(3):
            u, v = (i for i in range(3) if i != axis)
            grids = [np.linspace(-s / 2, s / 2, int(np.ceil(s / spacing)) + 1) for s in (self.size[u], self.size[v])]
            a, b = (grid.ravel() for grid in np.meshgrid(*grids))
            for side in (-1, 1):
                face = np.zeros((len(a), 3))
                face[:, u], face[:, v], face[:, axis] = a, b, side * self.size[axis] / 2
                faces.append(face)
        return np.concatenate(faces) @ self.matrix().T + np.array(self.center)


def table_scene(seed: int, count: int = 15) -> list[Box]:
    """Return a table top 4 cm below the arm's base with boxes on it."""
    rng = np.random.default_rng(seed)
    boxes = [Box((0.6, 0.0, -0.045), (0.5, 0.7, 0.01))]
    for _ in range(count):
        size = rng.uniform(0.04, 0.12, 3)
        x, y = rng.uniform((0.4, -0.3), (0.8, 0.3))
        boxes.append(Box((x, y, -0.04 + size[2] / 2), tuple(size), rng.uniform(-3, 3)))
    return boxes


def cloud(boxes: list[Box], spacing: float = 0.005) -> np.ndarray:
    return np.concatenate([box.surface(spacing) for box in boxes])


class Checker:
    """Link poses and collision shapes according to the URDF."""

    def __init__(self, urdf: Path) -> None:
        self._file = RobotXml(urdf)
        self.parts: list[tuple[str, np.ndarray]] = []  # link, and vertices of a convex part in its frame
        for link in self._file.root.iterfind("link"):
            for collision in link.iterfind("collision"):
                shape = collision.find("geometry")
                box = shape.find("box")
                if box is not None:
                    mesh = trimesh.creation.box([float(v) for v in box.attrib["size"].split()])
                else:
                    mesh = trimesh.load(urdf.parent / f"{shape.find('mesh').attrib['filename']}.convex.stl")
                mesh.apply_transform(self._file.read_origin(collision))
                self.parts.append((link.attrib["name"], np.asarray(mesh.vertices)))

    def poses(self, link: str, qpos: np.ndarray, finger: float = 0.04) -> np.ndarray:
        """Poses (T, 4, 4) of a link in the arm's base at configurations (T, 7)."""
        positions = np.column_stack([qpos, np.full(len(qpos), finger)])
        return chain_poses(self._file.path, MOBILE_PANDA.arm_base_link, link, positions)

    def link_pose(self, link: str, qpos: np.ndarray) -> np.ndarray:
        return self.poses(link, np.asarray(qpos)[None])[0]


def top_down(x: float, y: float, z: float, yaw: float = 0.0) -> np.ndarray:
    """Return a TCP pose that points straight down; at yaw 0 its x axis is that of the base."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", yaw).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = x, y, z
    return pose


def corners(x: float, y: float, z: float) -> np.ndarray:
    return np.array(list(itertools.product((-x, x), (-y, y), (-z, z))))


def pose_error(found: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """Return the distance (m) and the angle (rad) between two poses (4, 4)."""
    cosine = (np.trace(found[:3, :3].T @ expected[:3, :3]) - 1) / 2
    sine = np.linalg.norm(found[:3, :3] - expected[:3, :3]) / (2 * np.sqrt(2))  # sin(angle / 2), exact for small angles
    angle = 2 * np.arcsin(min(1.0, float(sine))) if cosine > 0 else float(np.arccos(np.clip(cosine, -1, 1)))
    return float(np.linalg.norm(found[:3, 3] - expected[:3, 3])), angle
