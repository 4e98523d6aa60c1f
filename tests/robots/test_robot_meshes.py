from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import trimesh

from robocas_ms3.robots.meshes import decimate_glb, write_boxes_glb
from robocas_ms3.robots.urdf import robot_files


def colours(scene: trimesh.Scene) -> set[tuple[int, ...]]:
    return {tuple(mesh.visual.material.baseColorFactor) for mesh in scene.geometry.values()}


def triangles(scene: trimesh.Scene) -> int:
    return sum(len(mesh.faces) for mesh in scene.geometry.values())


@pytest.mark.parametrize("name", ["link0", "link6", "hand"])
def test_visual_meshes_are_light_and_keep_shape_and_colours(name):
    spec = importlib.util.find_spec("mani_skill")
    source = Path(spec.submodule_search_locations[0]) / "assets/robots/panda/franka_description/meshes/visual"
    shipped = trimesh.load(source / f"{name}.glb", force="scene")
    light = trimesh.load(robot_files().folder / "visual" / f"{name}.glb", force="scene")
    assert triangles(shipped) > 7000
    assert triangles(light) <= 1100
    assert light.bounds == pytest.approx(shipped.bounds, abs=2.5e-3)
    assert colours(light) == colours(shipped)


def test_whole_robot_has_under_10_k_triangles():
    meshes = (robot_files().folder / "visual").glob("*.glb")
    assert sum(triangles(trimesh.load(path, force="scene")) for path in meshes) < 10_000


def test_decimation_reaches_its_target_on_a_sphere(tmp_path):
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.1)  # 5120 triangles
    sphere.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(baseColorFactor=[10, 20, 30, 255])
    )
    trimesh.Scene(sphere).export(tmp_path / "sphere.glb")
    assert decimate_glb(tmp_path / "sphere.glb", tmp_path / "light.glb", 500) == pytest.approx(500, abs=10)
    light = trimesh.load(tmp_path / "light.glb", force="scene")
    vertices = np.vstack([mesh.vertices for mesh in light.geometry.values()])
    assert np.linalg.norm(vertices, axis=1) == pytest.approx(0.1, abs=2e-3)
    assert colours(light) == {(10, 20, 30, 255)}


def test_boxes_are_where_they_are_told(tmp_path):
    write_boxes_glb(
        tmp_path / "boxes.glb", [((0.2, 0.4, 0.6), (1, 0, 0), (1, 0, 0)), ((0.1, 0.1, 0.1), (0, 0, 2), (0, 1, 0))]
    )
    scene = trimesh.load(tmp_path / "boxes.glb", force="scene")
    assert scene.bounds == pytest.approx(np.array([[-0.05, -0.2, -0.3], [1.1, 0.2, 2.05]]))
    assert colours(scene) == {(255, 0, 0, 255), (0, 255, 0, 255)}
