"""Resting poses, grasps and surface points of an object (``annotations.npz``) in the asset's frame, in metres."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from robocas_ms3.assets.hulls import Array
from robocas_ms3.core.documents import DAMAGED_FILE_ERRORS, open_npz
from robocas_ms3.core.errors import AssetError

# One half of the open gripper of the annotated grasps in the TCP frame (z approach, y closing); the other half is
# mirrored at y = 0. Boxes: low and high corner, m. RoboCAS-v0 uses fingers 0.04..0.045 x +-0.01 x -0.09..0 and a palm
# +-0.1 x +-0.02 x -0.18..-0.09. Here the boxes fit the Panda with 3 cm longer fingers: the pads end 8 mm beyond the
# TCP, and knuckles and hand are wider and lower.
GRIPPER_BOXES = np.array(
    [
        ((-0.010, 0.040, -0.040), (0.010, 0.046, 0.0085)),  # tip
        ((-0.012, 0.040, -0.075), (0.012, 0.067, -0.020)),  # knuckle
        ((-0.033, 0.000, -0.180), (0.033, 0.104, -0.067)),  # palm
    ]
)
GRIPPER_RADIUS = 0.22  # m, radius of a sphere around the TCP that contains all boxes


@dataclass(frozen=True)
class Annotations:
    """Annotations of an object with S resting poses, G grasps and P surface points; metres, asset frame.

    Attributes:
        resting_poses: (S, 4, 4) ``T_plane_object``: pose of the object on a horizontal plane, in a frame with z = 0 on
            the plane and x = y = 0 below the centre of mass.
        footprints: (S, K, 2) convex hull of the object's vertical projection in each resting pose, m: corners counter-
            clockwise, relative to the centre of mass. A polygon with fewer than K corners repeats the last corner.
        resting_probabilities: (S,) fraction of random drops that end in each pose; the sum is 1.
        display_pose: index of the resting pose in which the object is upright, or -1 if there is none.
        grasps_tcp_in_object: (G, 4, 4) TCP poses: z approach, y closing, origin between the finger tips.
        grasp_widths: (G,) distance of the fingers at the grasp, m.
        grasp_qualities: (G,) smallest friction coefficient for force closure; smaller is better.
        surface_points: (P, 3) points on the visual mesh.
        surface_normals: (P, 3) outward unit normals of the points.
    """

    resting_poses: Array
    footprints: Array
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
                found = "NaN or infinite values" if found.shape == shape else f"shape {found.shape}"
                raise AssetError("invalid array", where=name, expected=f"finite numbers of shape {shape}", found=found)
        if poses == 0 or not -1 <= self.display_pose < poses:
            raise AssetError(
                "no resting pose with this index",
                where="display_pose",
                expected=f"-1 to {poses - 1}" if poses else "at least one resting pose",
                found=self.display_pose,
            )

    def save(self, path: Path) -> None:
        arrays: dict[str, Any] = {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}
        np.savez_compressed(path, **arrays)

    @classmethod
    def load(cls, path: Path) -> Annotations:
        """Read the annotations of an object from ``annotations.npz``."""
        try:
            with open_npz(path) as file:
                arrays = {f.name: file[f.name] for f in fields(cls)}
            for name, array in arrays.items():
                array.setflags(write=False)
                if array.dtype.kind not in "fiu" or (array.ndim == 0) is not (name == "display_pose"):
                    raise ValueError(f"{name}: expected numbers, found {array.dtype} of shape {array.shape}")
            return cls(**{**arrays, "display_pose": int(arrays["display_pose"])})
        except (*DAMAGED_FILE_ERRORS, AssetError, KeyError) as error:
            fix = "Make the pack again."
            raise AssetError("cannot read the annotations", where=path, found=error, fix=fix) from error

    def footprint(self, pose_index: int) -> Array:
        """Return the corners (K, 2) of the footprint in one resting pose in m, without repeated corners."""
        corners = self.footprints[pose_index]
        return corners[~np.all(corners == np.roll(corners, 1, axis=0), axis=1)]


def compute_footprints(hulls: list[Array], poses: Array) -> Array:
    """Return `Annotations.footprints` (S, K, 2): the vertical projection of each resting pose.

    Args:
        hulls: vertices (V, 3) of each convex hull of the object, m, asset frame.
        poses: (S, 4, 4) resting poses.
    """
    points = np.concatenate(hulls)
    polygons = []
    for pose in poses:
        flat = points @ pose[:2, :3].T + pose[:2, 3]
        polygons.append(flat[ConvexHull(flat).vertices])
    longest = max(len(polygon) for polygon in polygons)
    return np.stack([np.pad(polygon, ((0, longest - len(polygon)), (0, 0)), mode="edge") for polygon in polygons])
