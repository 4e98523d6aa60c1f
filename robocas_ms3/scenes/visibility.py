"""Measure the visible fraction of objects (p_vis) by ray casting. No renderer, no simulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from robocas_ms3.assets.pack import BodyFiles, VisualLevel
from robocas_ms3.core.poses import transform_points
from robocas_ms3.scenes.placement import Array

PixelBox = tuple[slice, slice]  # rows, columns

SELECTION_CAMERA_HEIGHT = 0.5  # m above the support, as in RoboCAS-v0
_FAR = 1e30  # embree returns a greater distance for a ray without a hit
_scenes: WeakKeyDictionary[trimesh.Trimesh, EmbreeScene] = WeakKeyDictionary()


@dataclass(frozen=True)
class PinholeCamera:
    """A camera of ``width`` x ``height`` pixels without distortion.

    Attributes:
        pose: (4, 4) pose in the world in SAPIEN's convention (x forward, y left, z up), m.
        fov_y: vertical field of view, rad.
    """

    pose: Array
    width: int = 512
    height: int = 512
    fov_y: float = np.pi / 2

    @property
    def focal_length(self) -> float:
        return self.height / 2 / np.tan(self.fov_y / 2)

    def ray_directions(self, box: PixelBox) -> Array:
        """Return directions (rows, columns, 3) of the rays through pixel centres, camera frame, x = 1."""
        rows, columns = np.mgrid[box]
        left = (self.width / 2 - columns - 0.5) / self.focal_length
        up = (self.height / 2 - rows - 0.5) / self.focal_length
        return np.stack([np.ones(rows.shape), left, up], axis=-1)

    def pixel_box(self, points: Array) -> PixelBox:
        """Return the rows and columns of the image that contain points (P, 3) in the world.

        They are empty if all points are out of view.
        """
        local = (points - self.pose[:3, 3]) @ self.pose[:3, :3]
        if local[:, 0].min() <= 1e-3:  # partly behind the camera: the whole image
            return slice(0, self.height), slice(0, self.width)
        row = self.height / 2 - local[:, 2] / local[:, 0] * self.focal_length
        column = self.width / 2 - local[:, 1] / local[:, 0] * self.focal_length
        low, high = np.floor([row.min(), column.min()]) - 1, np.ceil([row.max(), column.max()]) + 1
        size = (self.height, self.width)
        (r0, c0), (r1, c1) = (np.clip(edge, 0, size).astype(int).tolist() for edge in (low, high))
        return slice(r0, r1), slice(c0, c1)


def top_down_camera(center_xy: Array, support_z: float, *, size: int = 512) -> PinholeCamera:
    """Return RoboCAS-v0's selection camera: `SELECTION_CAMERA_HEIGHT` above a support, looking down.

    Args:
        center_xy: (2,) point below the camera in the world, m.
        support_z: height of the support in the world, m.
        size: width and height of the image, pixels.
    """
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([(0, 0, -1.0), (0, 1.0, 0), (1.0, 0, 0)])
    pose[:3, 3] = *center_xy, support_z + SELECTION_CAMERA_HEIGHT
    return PinholeCamera(pose, size, size)


@lru_cache(maxsize=512)
def _load_mesh(path: Path, _changed_ns: int) -> trimesh.Trimesh:
    mesh = trimesh.load(path, force="mesh", process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def load_visual_mesh(asset: BodyFiles, level: VisualLevel = "fast") -> trimesh.Trimesh:
    """Load the visual mesh of an asset in the asset's frame.

    All callers get the same object, so do not change it.
    """
    path = asset.visual_path(level)
    return _load_mesh(path, path.stat().st_mtime_ns)


class MeshScene:
    """Scene of meshes in which cameras cast rays.

    Args:
        meshes: K meshes.
        poses: (K, 4, 4) poses of the meshes in the world.
    """

    def __init__(self, meshes: Sequence[trimesh.Trimesh], poses: Array) -> None:
        self._placed = list(zip(meshes, poses, strict=True))

    def visible_fractions(self, camera: PinholeCamera) -> Array:
        """Return the visible fraction (p_vis in the paper) of each mesh (K,).

        It is the visible area of the image of the mesh / the area that it would have without the other meshes.

        The fraction is in [0, 1]; NaN if the mesh is out of view.
        """
        ids, full = self.render_segmentation(camera)
        visible = np.bincount(ids[ids >= 0], minlength=len(full))
        return visible / np.where(full > 0, full, np.nan)

    def render_segmentation(self, camera: PinholeCamera) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
        """Render a segmentation image, and count the pixels of each mesh without occlusion by other meshes.

        Returns:
            Image (height, width) of mesh indices, -1 for the background. Number of pixels (K,) that each mesh would
            have without the other meshes.
        """
        nearest = np.full((camera.height, camera.width), np.inf)
        ids, full = np.full(nearest.shape, -1), np.zeros(len(self._placed), dtype=int)
        for i, (mesh, pose) in enumerate(self._placed):
            box, depths = _cast_rays(camera, mesh, pose)
            closer = depths < nearest[box]
            nearest[box][closer] = depths[closer]
            ids[box][closer] = i
            full[i] = (depths < np.inf).sum()
        return ids, full


def _cast_rays(camera: PinholeCamera, mesh: trimesh.Trimesh, pose: Array) -> tuple[PixelBox, Array]:
    """Return the pixel box of a mesh in the image, and the depth (rows, columns) in this box, m.

    The depth is infinite where the mesh is not hit.
    """
    box = camera.pixel_box(transform_points(pose, mesh.vertices))
    # rays are cast in the mesh's frame: its search tree is built once, and single precision is sufficient
    to_mesh = pose[:3, :3].T
    position = to_mesh @ (camera.pose[:3, 3] - pose[:3, 3])
    directions = camera.ray_directions(box) @ (to_mesh @ camera.pose[:3, :3]).T
    shape = directions.shape[:2]
    if 0 in shape:
        return box, np.full(shape, np.inf)
    directions = directions.reshape(-1, 3).astype(np.float32)
    origins = np.tile(position.astype(np.float32), (len(directions), 1))
    depths = make_ray_scene(mesh).run(origins, directions, query="DISTANCE").astype(float)
    return box, np.where(depths < _FAR, depths, np.inf).reshape(shape)


def make_ray_scene(mesh: trimesh.Trimesh) -> EmbreeScene:
    """Return the ray casting scene of a mesh. Each process builds it only once."""
    if mesh not in _scenes:
        scene = EmbreeScene(robust=True)  # no ray passes between two adjacent triangles
        TriangleMesh(scene, mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))
        _scenes[mesh] = scene
    return _scenes[mesh]
