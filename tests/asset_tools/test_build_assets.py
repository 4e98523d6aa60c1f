"""What the manifest says of an object that was made, and what is asked of it."""

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals

from asset_tools.build import build_object
from asset_tools.sources import ObjectSource

SIDE, MASS = 0.004, 1e-4  # m, kg


def die():
    box = trimesh.creation.box([SIDE] * 3)
    uv = np.zeros((len(box.vertices), 2))
    box.visual = TextureVisuals(uv=uv, image=Image.new("RGB", (4, 4), "white"))
    return box


def test_a_tiny_thing_has_moments_of_inertia(tmp_path):
    """m a2 / 6 = 2.7e-10 kg m2: rounded to a nanounit it would have none."""
    mesh = die()
    asset = build_object(ObjectSource("die", "die", "toy", mesh, mesh.copy(), MASS), tmp_path)
    assert asset.inertia == pytest.approx([MASS * SIDE**2 / 6] * 3, rel=1e-8)
    assert asset.grasp_count >= 50 or asset.no_grasps_because
