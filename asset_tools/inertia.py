"""Compute mass properties of solids, and round them as in manifests."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation


def compute_principal_inertia(
    closed: trimesh.Trimesh, mass: float
) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """Compute the principal moments of inertia of a solid of uniform density.

    Args:
        closed: watertight mesh, m.
        mass: mass of the solid, kg.

    Returns:
        The moments (3,) about the centre of mass in kg m2, and the rotation wxyz of the principal axes in the mesh's
        frame.
    """
    return _principal(np.asarray(closed.moment_inertia) * (mass / closed.volume))


def compute_piece_inertia(
    pieces: list[np.ndarray], mass: float
) -> tuple[np.ndarray, np.ndarray, tuple[float, float, float, float]]:
    """Compute the mass properties of a body of convex pieces of uniform density; overlaps count twice.

    Args:
        pieces: points (V, 3) of each piece, m.
        mass: mass of the body, kg.

    Returns:
        The centre of mass (3,) in m, the principal moments (3,) about the centre of mass in kg m2, and the rotation
        wxyz of the principal axes in the frame of the pieces.
    """
    hulls = [trimesh.convex.convex_hull(piece) for piece in pieces]
    volumes = np.array([hull.volume for hull in hulls])
    masses = mass * volumes / volumes.sum()
    center = masses @ np.array([hull.center_mass for hull in hulls]) / mass
    tensor = np.zeros((3, 3))
    for hull, share in zip(hulls, masses, strict=True):
        offset = hull.center_mass - center
        tensor += hull.moment_inertia * share / hull.volume
        tensor += share * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    return center, *_principal(tensor)


def _principal(tensor: np.ndarray) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    if np.abs(tensor - np.diag(np.diag(tensor))).max() < 1e-9 * np.trace(tensor):
        return np.diag(tensor).copy(), (1.0, 0.0, 0.0, 0.0)
    moments, vectors = np.linalg.eigh(tensor)
    if np.linalg.det(vectors) < 0:
        vectors[:, 0] *= -1
    x, y, z, w = (float(value) for value in Rotation.from_matrix(vectors).as_quat())
    return moments, (w, x, y, z)


def round_vector(values: np.ndarray) -> tuple[float, float, float]:
    """Round the three numbers of a vector to 9 decimals, the precision of manifests."""
    x, y, z = (round(float(value), 9) for value in values)
    return x, y, z


def round_moments(values: np.ndarray) -> tuple[float, float, float]:
    """Round three moments of inertia to 9 significant digits, since they can be as small as 4e-10 kg m2."""
    x, y, z = (float(f"{value:.9g}") for value in values)
    return x, y, z
