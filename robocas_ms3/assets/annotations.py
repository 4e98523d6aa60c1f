"""Resting poses, grasps and surface points of an object: ``annotations.npz``. Metres, the asset's frame."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from robocas_ms3.assets.hulls import Array
from robocas_ms3.core.documents import DAMAGED_FILE_ERRORS, open_arrays
from robocas_ms3.core.errors import AssetError

# The open gripper that grasps are annotated for, in the TCP frame (z approach, y closing), one half of it (the other is
# mirrored at y = 0): low and high corner, m. Upstream uses fingers 0.04..0.045 x +-0.01 x -0.09..0 and a palm +-0.1 x
# +-0.02 x -0.18..-0.09. These are the same parts of the Panda with 3 cm longer fingers: pads reach 8 mm beyond the TCP;
# knuckles and hand are wider and lower than upstream's.
GRIPPER_BOXES = np.array(
    [
        ((-0.010, 0.040, -0.040), (0.010, 0.046, 0.0085)),  # tip
        ((-0.012, 0.040, -0.075), (0.012, 0.067, -0.020)),  # knuckle
        ((-0.033, 0.000, -0.180), (0.033, 0.104, -0.067)),  # palm
    ]
)
GRIPPER_RADIUS = 0.22  # m from the TCP, holds all boxes


@dataclass(frozen=True)
class Annotations:
    """Annotations of an object. S stable poses, G grasps, P surface points; metres, asset frame.

    Attributes:
        resting_poses: (S, 4, 4) ``T_plane_object``: the object's frame in a frame whose z = 0 is the plane it rests
            on, its centre of mass at x = y = 0.
        footprints: (S, K, 2) what the object covers of that plane in each pose: convex polygons, counter-clockwise
            around the centre of mass, their last corner repeated to make up K.
        resting_probabilities: (S,) share of random drops that end in each pose; they sum to 1.
        display_pose: index of the pose in which the object stands upright, or -1.
        grasps_tcp_in_object: (G, 4, 4) TCP poses, z approach, y closing, origin midway between the finger tips.
        grasp_widths: (G,) finger opening the object needs, m.
        grasp_qualities: (G,) lowest friction coefficient that closes the grasp; smaller is better.
        surface_points: (P, 3) points on the visual mesh.
        surface_normals: (P, 3) their outward unit normals.
    """

    resting_poses: Array
    compute_footprints: Array
    resting_probabilities: Array
    display_pose: int
    grasps_tcp_in_object: Array
    grasp_widths: Array
    grasp_qualities: Array
    surface_points: Array
    surface_normals: Array

    def __post_init__(self) -> None:
        poses, grasps, points = len(self.resting_poses), len(self.grasp_widths), len(self.surface_points)
        shapes = {
            "resting_poses": (poses, 4, 4),
            "footprints": (poses, self.footprints.shape[1] if self.footprints.ndim == 3 else 3, 2),
            "resting_probabilities": (poses,),
            "grasps_tcp_in_object": (grasps, 4, 4),
            "grasp_widths": (grasps,),
            "grasp_qualities": (grasps,),
            "surface_points": (points, 3),
            "surface_normals": (points, 3),
        }
        for name, shape in shapes.items():
            found = getattr(self, name)
            if found.shape != shape or not np.isfinite(found).all():
                raise AssetError("wrong shape or non-finite numbers", where=name, expected=shape, found=found.shape)
        if poses == 0 or not -1 <= self.display_pose < poses:
            raise AssetError("no such resting pose", where="display_pose", found=f"{self.display_pose} of {poses}")

    def save(self, path: Path) -> None:
        arrays: dict[str, Any] = {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}
        np.savez_compressed(path, **arrays)

    @classmethod
    def load(cls, path: Path) -> Annotations:
        """Read ``annotations.npz``."""
        try:
            with open_arrays(path) as file:
                arrays = {f.name: file[f.name] for f in fields(cls)}
            for name, array in arrays.items():
                array.setflags(write=False)
                if array.dtype.kind not in "fiu" or (array.ndim == 0) is not (name == "display_pose"):
                    raise ValueError(f"{name} is {array.dtype} of shape {array.shape}")
            return cls(**{**arrays, "display_pose": int(arrays["display_pose"])})
        except (*DAMAGED_FILE_ERRORS, AssetError, KeyError) as error:
            fix = "Make the pack again."
            raise AssetError("can't read the annotations", where=path, found=error, fix=fix) from error

    def footprint(self, pose_index: int) -> Array:
        """Return the polygon (K, 2) that the object covers in a resting pose, each corner once, m."""
        corners = self.footprints[pose_index]
        return corners[~np.all(corners == np.roll(corners, 1, axis=0), axis=1)]


def compute_footprints(hulls: list[Array], poses: Array) -> Array:
    """Return what convex hulls, vertices (V, 3), cover of the plane in resting poses (S, 4, 4); see `Annotations`."""
    points = np.concatenate(hulls)
    polygons = []
    for pose in poses:
        flat = points @ pose[:2, :3].T + pose[:2, 3]
        polygons.append(flat[ConvexHull(flat).vertices])
    longest = max(len(polygon) for polygon in polygons)
    return np.stack([np.pad(polygon, ((0, longest - len(polygon)), (0, 0)), mode="edge") for polygon in polygons])
