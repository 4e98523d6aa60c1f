from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import trimesh

from robocas_ms3.robots.meshes import write_boxes_glb
from robocas_ms3.robots.urdf import make_robot_files


def colours(scene: trimesh.Scene) -> set[tuple[int, ...]]:
    return {tuple(mesh.visual.material.baseColorFactor) for mesh in scene.geometry.values()}


def triangles(scene: trimesh.Scene) -> int:
    return sum(len(mesh.faces) for mesh in scene.geometry.values())


@pytest.mark.parametrize("name", ["link0", "link6", "hand"])
def test_visual_meshes_are_light_and_keep_shape_and_colours(name):
    spec = importlib.util.find_spec("mani_skill")
    source = Path(spec.submodule_search_locations[0]) / "assets/robots/panda/franka_description/meshes/visual"
    shipped = trimesh.load(source / f"{name}.glb", force="scene")
    light = trimesh.load(make_robot_files().folder / "visual" / f"{name}.glb", force="scene")
    assert triangles(shipped) > 7000
    assert triangles(light) <= 1100
    assert light.bounds == pytest.approx(shipped.bounds, abs=2.5e-3)
    assert colours(light) == colours(shipped)


def test_whole_robot_has_under_10_k_triangles():
    meshes = (make_robot_files().folder / "visual").glob("*.glb")
    assert sum(triangles(trimesh.load(path, force="scene")) for path in meshes) < 10_000


def test_boxes_have_their_positions_and_colours(tmp_path):
    write_boxes_glb(
        tmp_path / "boxes.glb", [((0.2, 0.4, 0.6), (1, 0, 0), (1, 0, 0)), ((0.1, 0.1, 0.1), (0, 0, 2), (0, 1, 0))]
    )
    scene = trimesh.load(tmp_path / "boxes.glb", force="scene")
    assert scene.bounds == pytest.approx(np.array([[-0.05, -0.2, -0.3], [1.1, 0.2, 2.05]]))
    assert colours(scene) == {(255, 0, 0, 255), (0, 255, 0, 255)}
