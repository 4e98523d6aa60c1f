"""What the engine makes of hulls, on a CPU and as a GPU takes them."""

import numpy as np
import trimesh

from robocas_ms3.assets.cooked_hulls import MAX_SHRINKAGE, HullViolation, cook_hulls, find_hull_violations
from robocas_ms3.assets.hulls import write_hulls
from robocas_ms3.core.paths import builtin_packs_dir


def box(*size):
    return np.array([[x, y, z] for x in (0, size[0]) for y in (0, size[1]) for z in (0, size[2])])


def prism(sides, radius=0.05, length=0.1):
    """A regular prism along z: two rings of corners, one face per side and two ends."""
    angles = np.arange(sides) * 2 * np.pi / sides
    ring = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.concatenate([np.column_stack([ring, np.full(sides, z)]) for z in (0, length)])


def written(folder, hulls):
    folder.mkdir(parents=True)
    write_hulls(folder / "hulls.obj", hulls)


def test_hulls_that_a_gpu_shrinks_or_rejects_are_reported(tmp_path):
    # a ball of 42 corners has 80 triangles; a prism of 56 has 28 + 2 faces
    ball = 0.05 * np.asarray(trimesh.creation.icosphere(subdivisions=1).vertices)
    written(tmp_path / "ball", [box(0.1, 0.1, 0.1), ball])
    written(tmp_path / "column", [prism(28, radius=0.2)])
    written(tmp_path / "desk" / "links" / "drawer", [ball])
    # both are a metre long and 2 mm thick, but boxes are never cooked
    written(tmp_path / "rods", [box(1.0, 0.002, 0.002), prism(6, radius=0.001, length=1.0)])
    found = find_hull_violations(tmp_path)
    lost = found[0].cooked.shrinkage
    assert MAX_SHRINKAGE < lost < 0.05
    assert [str(fault) for fault in found] == [
        f"ball: hull 1 shrinks by {1e3 * lost:.1f} mm on a GPU",
        f"desk/links/drawer: hull 0 shrinks by {1e3 * lost:.1f} mm on a GPU",
        "rods: hull 1 is too slender on a GPU",
    ]


def test_a_hull_that_the_engine_rejects_is_reported():
    (cooked,) = cook_hulls([np.eye(3)])  # no body of three points
    assert cooked.shrinkage == np.inf
    assert str(HullViolation("dot", 2, "CPU", cooked)) == "dot: hull 2 cannot be built on a CPU"


def test_hulls_of_the_builtin_pack_do_not_shrink():
    assert find_hull_violations(builtin_packs_dir() / "builtin") == []
