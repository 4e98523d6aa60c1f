import itertools

import numpy as np
import pytest

from robocas_ms3.assets.physics import RigidBody

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def corners(x, y, z):
    return np.array(list(itertools.product((-x / 2, x / 2), (-y / 2, y / 2), (-z / 2, z / 2))))


@pytest.fixture
def block():
    """Make a solid box of a size (x, y, z) m and a mass in kg, about its middle."""

    def make(x, y, z, mass=0.2, friction=0.99):
        inertia = mass / 12 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
        return RigidBody([corners(x, y, z)], mass, np.zeros(3), inertia, IDENTITY, friction)

    return make
