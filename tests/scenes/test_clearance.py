"""Impossible scenes are errors at loading, with the two things, the distance and the fix."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scene_models import load_scene

from robocas_ms3.assets.hulls import Hull
from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import ConfigError
from robocas_ms3.core.paths import protocols_dir
from robocas_ms3.robots.description_file import chain_poses
from robocas_ms3.robots.registry import PANDA
from robocas_ms3.scenes.clearance import overlap_depth
from robocas_ms3.scenes.config import bundled_configs, load_task_config
from robocas_ms3.scenes.model import SceneModel


def at(x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> dict:
    return {"position": [x, y, z], "yaw_deg": yaw}


TABLE = {"asset": "table", "pose": at(0.9, 1.0, yaw=-90)}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"furniture": {"table": TABLE, "twin": TABLE}},
            r"^furniture\.table and furniture\.twin overlap \(expected no overlap, found an overlap of 0\.\d+ m",
        ),
        ({"robot": at(0.9, 0.9, yaw=90)}, r"^robot and furniture\.table overlap .*Move one of them"),
        (
            {"furniture": {"table": {"asset": "table", "pose": at(0.9, 1, -0.3, -90)}}},
            "furniture.table and room overlap",
        ),
        ({"basket": {"asset": "basket", "pose": at(1.3, 0.9, 0.5)}}, "basket and furniture.table overlap"),
        ({"basket": {"asset": "basket", "pose": at(0.7, 0.15, 0.3)}}, "robot and basket overlap"),
        (
            {"basket": {"asset": "basket", "pose": at(3.7, 0.15)}},
            r"^the basket is out of the arm's reach \(expected at most 1\.03 m from its shoulder, found 2\.\d\d m\)",
        ),
        ({"robot": at(0.7, -1.2, yaw=90)}, "^surface 'top' is out of the arm's reach"),
    ],
)
def test_impossible_scenes_are_errors(changes, message):
    with pytest.raises(ConfigError, match=message):
        load_scene(**changes)


def test_arm_that_starts_inside_of_furniture_is_an_error():
    above = {"asset": "side_table", "pose": at(0.7, 0.15, 0.62)}
    with pytest.raises(
        ConfigError, match=r"start pose of the arm is inside of another body \(found furniture.above\). Move or turn"
    ):
        load_scene(furniture={"table": TABLE, "above": above})


def test_a_base_that_drives_reaches_farther():
    far = {"asset": "basket", "pose": at(1.9, -0.3)}
    with pytest.raises(ConfigError, match="the basket is out of the arm's reach"):
        load_scene(basket=far)
    load_scene(basket=far, base_motion=True)
    with pytest.raises(ConfigError, match=r"Move it or the robot: it is \d\.\d\d m"):
        load_scene(basket={"asset": "basket", "pose": at(3.7, 0.15)}, base_motion=True)


def test_configured_poses_of_randomised_things_are_not_checked():
    load_scene(basket={"asset": "basket", "pose": at(1.3, 0.9, 0.5)}, randomisation={"basket": {"position": 0.1}})


def test_bundled_configurations_have_clearance():
    pack = load_pack("builtin")
    configs = [name for name in bundled_configs() if "partnet" not in name]
    for config in [*configs, *protocols_dir().glob("*/configs/*.yaml")]:
        SceneModel.load(load_task_config(config), pack, pack)


def hull(mesh: trimesh.Trimesh) -> Hull:
    return Hull(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def test_overlaps_equal_hand_computed_depths():
    cube = trimesh.creation.box((1, 1, 1))
    assert overlap_depth(hull(cube), hull(cube.copy().apply_translation((0.7, 0.2, 0)))) == pytest.approx(0.3)
    assert overlap_depth(hull(cube), hull(cube.copy().apply_translation((1.1, 0, 0)))) == 0
    # two crossed edges: the face normals alone do not separate them
    one, other = cube.copy(), cube.copy()
    one.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 4, (0, 1, 0)))
    other.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 4, (1, 0, 0)))
    for gap in (0.05, -0.05):
        moved = other.copy().apply_translation((0, 0, np.sqrt(2) + gap))
        assert overlap_depth(hull(one), hull(moved)) == pytest.approx(max(-gap, 0))


def test_reach_is_checked_with_the_envelope_of_the_robot():
    far = load_task_config("pick_table_scattered").model_dump(mode="json") | {"robot": at(0.7, -1.2, yaw=90)}
    config, pack, panda = load_task_config(far), load_pack("builtin"), PANDA.description
    longer = replace(panda, envelope=replace(panda.envelope, reach=2.0))
    with pytest.raises(ConfigError, match="out of the arm's reach"):
        SceneModel.load(config, pack, pack, robot=replace(panda, envelope=replace(panda.envelope, reach=1.0)))
    for robot in (longer, replace(panda, envelope=None)):
        SceneModel.load(config, pack, pack, robot=robot)


def test_envelope_contains_the_arm():
    urdf, robot = PANDA.files().urdf, PANDA.description
    base = chain_poses(urdf, robot.root_link, robot.arm_base_link, np.zeros((1, 3)))[0]
    for start, qpos in (("rest", robot.arm_rest), ("evaluation", robot.arm_evaluation_start)):
        arm = np.array(qpos)[None]
        links = [
            base @ chain_poses(urdf, robot.arm_base_link, link, arm[:, :n])[0]
            for n, link in enumerate(robot.arm_links, 1)
        ]
        tcp = base @ chain_poses(urdf, robot.arm_base_link, robot.tcp_link, arm)[0]
        # the second link turns where the first does, the sixth where the fifth
        origins = np.array([base[:3, 3], *(links[i][:3, 3] for i in (0, 2, 3, 4, 6)), tcp[:3, 3]])
        np.testing.assert_allclose(robot.envelope.arm_at_start[start], origins, atol=1e-3)
    shoulder = chain_poses(urdf, robot.arm_base_link, robot.arm_links[0], np.zeros((1, 1)))[0][:3, 3]
    assert shoulder[2] == pytest.approx(robot.envelope.shoulder)
    many = np.random.default_rng(0).uniform(*np.array(robot.arm_limits).T, (20_000, 7))
    far = np.linalg.norm(
        chain_poses(urdf, robot.arm_base_link, robot.tcp_link, many)[:, :3, 3] - shoulder, axis=1
    ).max()
    assert robot.envelope.reach - 0.08 < far < robot.envelope.reach
