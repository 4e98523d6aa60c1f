"""Draw the appearance of a scene (room finishes, lights, cameras) from separate random streams."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from robocas_ms3.assets.pack import LoadedFurniture
from robocas_ms3.scenes.config.randomisation import CameraRandomisation
from robocas_ms3.scenes.config.task import TaskConfig
from robocas_ms3.scenes.placement import Array

_ROOM, _LIGHTS, _CAMERAS = range(200, 203)  # random streams; sample.py has the streams of layouts


@dataclass(frozen=True)
class Lights:
    """Lights of an episode.

    Attributes:
        ambient: intensity of the ambient light.
        directional: intensity of both directional lights.
        direction: (3,) unit vector along the slanted light, world frame.
    """

    ambient: float
    directional: float
    direction: Array


def draw_finishes(config: TaskConfig, room: LoadedFurniture, seed: int) -> dict[str, str]:
    finishes = dict(config.room.finishes)
    rng = np.random.default_rng([seed, _ROOM])
    for part in sorted(config.randomisation.room or ()):
        known = config.randomisation.finishes.get(part, room.asset.finishes[part])
        finishes[part] = known[int(rng.integers(len(known)))]
    return finishes


def draw_lights(config: TaskConfig, seed: int) -> Lights:
    lights, limits = config.lights, config.randomisation.lights
    direction = np.array(lights.direction) / np.linalg.norm(lights.direction)
    if limits is None:
        return Lights(lights.ambient, lights.directional, direction)
    rng = np.random.default_rng([seed, _LIGHTS])
    ambient, directional = rng.uniform(*limits.ambient), rng.uniform(*limits.directional)
    vector = rng.normal(size=3)
    turn = Rotation.from_rotvec(vector / np.linalg.norm(vector) * rng.uniform() * np.deg2rad(limits.direction_deg))
    return Lights(float(ambient), float(directional), turn.apply(direction))


def draw_camera_shifts(config: TaskConfig, cameras: int, seeds: Sequence[int]) -> Array:
    """Draw the random motions (N, C, 4, 4) of C cameras in their frames, in N sub-scenes with these seeds.

    They are the identity without ``randomisation.cameras``.
    """
    limits = config.randomisation.cameras
    if limits is None:
        return np.tile(np.eye(4), (len(seeds), cameras, 1, 1))
    return np.array([[draw_camera_shift(limits, camera, seed) for camera in range(cameras)] for seed in seeds])


def draw_camera_shift(limits: CameraRandomisation, camera: int, seed: int) -> Array:
    """Draw the random motion (4, 4) of a camera in the camera frame.

    Args:
        limits: ranges of shift and rotation.
        camera: index of the camera, which selects the random stream.
        seed: seed of the episode.
    """
    rng = np.random.default_rng([seed, _CAMERAS, camera])
    shift = np.eye(4)
    shift[:3, 3] = _scale_magnitudes(
        rng.uniform(-limits.position, limits.position, 3), limits.min_position, limits.position
    )
    angles = _scale_magnitudes(
        rng.uniform(-limits.rotation_deg, limits.rotation_deg, 3), limits.min_rotation_deg, limits.rotation_deg
    )
    shift[:3, :3] = Rotation.from_euler("xyz", np.deg2rad(angles)).as_matrix()
    return shift


def _scale_magnitudes(drawn: Array, least: float, most: float) -> Array:
    """Map values in [-most, most] to magnitudes in [least, most] with the same signs."""
    return drawn if least == 0 else np.copysign(least + np.abs(drawn) * (1 - least / most), drawn)
