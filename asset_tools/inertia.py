"""Mass properties of solids."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation


def principal_inertia(closed: trimesh.Trimesh, mass: float) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """Moments (3,) in kg m2 about the centre of mass and their axes (wxyz) of a solid of even density."""
    return _principal(np.asarray(closed.moment_inertia) * (mass / closed.volume))


def piece_inertia(
    pieces: list[np.ndarray], mass: float
) -> tuple[np.ndarray, np.ndarray, tuple[float, float, float, float]]:
    """Mass properties of convex pieces of even density; what two pieces share counts twice.

    Returns:
        Centre of mass (3,) m, principal moments (3,) kg m2 about it, their axes (wxyz).
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


def to_tuple(values: np.ndarray) -> tuple[float, float, float]:
    """Round to 9 decimals, as in manifests."""
    x, y, z = (round(float(value), 9) for value in values)
    return x, y, z


def to_moments(values: np.ndarray) -> tuple[float, float, float]:
    """Round moments of inertia to 9 significant digits; they can be as small as 4e-10 kg m2."""
    x, y, z = (float(f"{value:.9g}") for value in values)
    return x, y, z
