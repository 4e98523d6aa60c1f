"""How much of an object a camera sees (p_vis), by casting rays at its mesh: no renderer, no simulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from robocas_ms3.assets.pack import Part, VisualLevel
from robocas_ms3.scenes.placement import Array, transform

PixelBox = tuple[slice, slice]  # rows, columns


@dataclass(frozen=True)
class PinholeCamera:
    """A camera.

    Attributes:
        pose: (4, 4) in the world, SAPIEN's convention: x forward, y left, z up; m.
        width: pixels.
        height: pixels.
        fov_y: vertical field of view, rad.
    """

    pose: Array
    width: int = 512
    height: int = 512
    fov_y: float = np.pi / 2

    @property
    def focal_length(self) -> float:
        """Pixels."""
        return self.height / 2 / np.tan(self.fov_y / 2)

    def rays(self, box: PixelBox) -> Array:
        """(rows, columns, 3) directions in the world through the centres of pixels; x in the camera's frame is 1."""
        rows, columns = np.mgrid[box]
        left = (self.width / 2 - columns - 0.5) / self.focal_length
        up = (self.height / 2 - rows - 0.5) / self.focal_length
        return np.stack([np.ones(rows.shape), left, up], axis=-1) @ self.pose[:3, :3].T

    def pixel_box(self, points: Array) -> PixelBox:
        """Rows and columns within which points (P, 3) in the world appear; empty where they don't."""
        local = (points - self.pose[:3, 3]) @ self.pose[:3, :3]
        if local[:, 0].min() <= 1e-3:  # partly behind the camera: anywhere
            return slice(0, self.height), slice(0, self.width)
        row = self.height / 2 - local[:, 2] / local[:, 0] * self.focal_length
        column = self.width / 2 - local[:, 1] / local[:, 0] * self.focal_length
        low, high = np.floor([row.min(), column.min()]) - 1, np.ceil([row.max(), column.max()]) + 1
        size = (self.height, self.width)
        (r0, c0), (r1, c1) = (np.clip(edge, 0, size).astype(int).tolist() for edge in (low, high))
        return slice(r0, r1), slice(c0, c1)


def top_down_camera(
    center_xy: Array, support_z: float, *, height: float = 0.5, size: int = 512, fov: float = np.pi / 2
) -> PinholeCamera:
    """Upstream's selection camera: straight down from ``height`` above the support (defaults: upstream's).

    Args:
        center_xy: (2,) m, world, what it looks at.
        support_z: m, world.
        height: m.
        size: pixels, width and height.
        fov: rad.
    """
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([(0, 0, -1.0), (0, 1.0, 0), (1.0, 0, 0)])
    pose[:3, 3] = *center_xy, support_z + height
    return PinholeCamera(pose, size, size, fov)


@lru_cache(maxsize=512)
def _mesh_of(path: Path, _changed_ns: int) -> trimesh.Trimesh:
    mesh = trimesh.load(path, force="mesh", process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def object_mesh(asset: Part, level: VisualLevel = "fast") -> trimesh.Trimesh:
    """The mesh that is rendered, in the asset's frame; shared, so not to be changed."""
    path = asset.visual(level)
    return _mesh_of(path, path.stat().st_mtime_ns)


class Scenery:
    """Meshes where they stand, ready for rays from any number of cameras.

    Args:
        meshes: K meshes.
        poses: (K, 4, 4) in the world.
        occluders: further meshes with their poses, which only hide.
    """

    def __init__(
        self, meshes: Sequence[trimesh.Trimesh], poses: Array, occluders: Sequence[tuple[trimesh.Trimesh, Array]] = ()
    ) -> None:
        placed = [*zip(meshes, poses, strict=True), *occluders]
        self._vertices = [transform(pose, mesh.vertices) for mesh, pose in placed]
        self._faces = [np.asarray(mesh.faces) for mesh, _ in placed]
        self._count = len(meshes)
        self._owner = np.repeat(np.arange(len(placed)), [len(faces) for faces in self._faces])
        # embree computes in single precision: near the meshes that is far finer than a pixel, wherever the world's origin
        self._origin = np.concatenate(self._vertices).mean(axis=0) if placed else np.zeros(3)
        self._all: EmbreeScene | None = None
        self._single: dict[int, EmbreeScene] = {}

    def hit_ids(self, camera: PinholeCamera) -> NDArray[np.int_]:
        """(height, width) index of the mesh that each pixel shows; K and above: occluders; -1: none."""
        ids = np.full((camera.height, camera.width), -1)
        if len(self._owner):
            if self._all is None:
                self._all = self._scene_of(range(len(self._faces)))
            box = camera.pixel_box(np.concatenate(self._vertices))
            hits = self._cast(self._all, camera, box)
            ids[box] = np.where(hits >= 0, self._owner[hits], -1)
        return ids

    def full_mask(self, camera: PinholeCamera, index: int) -> NDArray[np.bool_]:
        """(height, width) pixels that one mesh would fill with everything else hidden."""
        if index not in self._single:
            self._single[index] = self._scene_of([index])
        mask = np.zeros((camera.height, camera.width), dtype=bool)
        box = camera.pixel_box(self._vertices[index])
        mask[box] = self._cast(self._single[index], camera, box) >= 0
        return mask

    def visible_pixels(self, camera: PinholeCamera) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
        """(K,) pixels in which each mesh is seen, and (K,) pixels it would fill with everything else hidden."""
        ids, counts = self.hit_ids(camera), np.zeros((2, self._count), dtype=int)
        for index in range(self._count):
            full = self.full_mask(camera, index)
            counts[:, index] = (full & (ids == index)).sum(), full.sum()
        return counts[0], counts[1]

    def visible_shares(self, camera: PinholeCamera) -> Array:
        """(K,) p_vis of each mesh, in 0..1; NaN where the camera would not see it at all."""
        visible, full = self.visible_pixels(camera)
        return visible / np.where(full > 0, full, np.nan)

    def visible_share(self, camera: PinholeCamera, index: int) -> float:
        """p_vis of one mesh; 1 minus it is the hidden share."""
        full = self.full_mask(camera, index)
        seen = full & (self.hit_ids(camera) == index)
        return float(seen.sum() / full.sum()) if full.any() else np.nan

    def _scene_of(self, indices: Sequence[int]) -> EmbreeScene:
        triangles = np.concatenate([self._vertices[i][self._faces[i]] for i in indices])
        scene = EmbreeScene(robust=True)  # no ray slips through between two triangles
        TriangleMesh(scene, (triangles - self._origin).astype(np.float32))
        return scene

    def _cast(self, scene: EmbreeScene, camera: PinholeCamera, box: PixelBox) -> NDArray[np.int_]:
        """Index of the first triangle met by the ray through each pixel of a box; -1: none."""
        directions = camera.rays(box)
        if directions.size == 0:
            return np.full(directions.shape[:2], -1)
        rays = directions.reshape(-1, 3).astype(np.float32)
        origins = np.tile((camera.pose[:3, 3] - self._origin).astype(np.float32), (len(rays), 1))
        return scene.run(origins, rays).astype(int).reshape(directions.shape[:2])


def visible_shares(
    camera: PinholeCamera,
    meshes: Sequence[trimesh.Trimesh],
    poses: Array,
    *,
    occluders: Sequence[tuple[trimesh.Trimesh, Array]] = (),
) -> Array:
    """p_vis = visible / full projected area of each mesh, as in the paper.

    Args:
        camera: where from.
        meshes: K meshes.
        poses: (K, 4, 4) in the world.
        occluders: further meshes with their poses, which only hide.

    Returns:
        (K,) in 0..1; NaN where the camera would not see a mesh at all.
    """
    return Scenery(meshes, poses, occluders).visible_shares(camera)
