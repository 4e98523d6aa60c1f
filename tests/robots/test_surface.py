"""Points on the surface of the robot."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from robocas_ms3.core.errors import RobotDescriptionError
from robocas_ms3.core.poses import inverse, transform_points
from robocas_ms3.robots.description_file import chain_poses
from robocas_ms3.robots.registry import find_robot
from robocas_ms3.robots.surface import RobotSurface

QPOS = np.array([0.1, -0.2, 0.5, 0, -1.02, 0, -2.51, 0, 1.35, 0.78, 0.04, 0.04])


@pytest.fixture(scope="module")
def surface():
    return RobotSurface(find_robot(None))


def test_points_do_not_depend_on_the_mobile_base(surface):
    points, normals = surface.compute_points(QPOS)
    assert points.shape == normals.shape and np.allclose(np.linalg.norm(normals, axis=1), 1)
    moved, turned = surface.compute_points(np.concatenate([[0.3, 0.4, -1.0], QPOS[3:]]))
    assert np.allclose(points, moved) and np.allclose(normals, turned)


def test_the_fingers_are_beside_the_tcp(surface):
    robot = find_robot(None).description
    points, _ = surface.compute_points(QPOS)
    closed, _ = surface.compute_points(np.concatenate([QPOS[:10], [0.0, 0.0]]))
    shifts = np.linalg.norm(points - closed, axis=1)
    fingers = shifts > 1e-6
    assert fingers.sum() == 4 * 400 and np.allclose(shifts[fingers], 0.04)  # tip and pad of two fingers
    urdf, arm = find_robot(None).files().urdf, QPOS[None, robot.arm_slice]
    tcp_in_base = chain_poses(urdf, robot.arm_base_link, robot.tcp_link, arm)[0]
    x, y, z = transform_points(inverse(tcp_in_base), points[fingers]).T  # y: closing direction, z: approach
    assert (np.abs(y) > 0.039).all() and (y > 0).sum() == 800
    assert np.abs(x).max() < 0.03 and z.max() < 0.03 and z.min() > -0.1


def test_an_unreadable_visual_mesh_is_an_error(tmp_path):
    files = find_robot(None).files()
    folder = shutil.copytree(files.folder, tmp_path / "robot")
    (folder / "visual" / "link3.glb").unlink()
    copy = replace(files, urdf=folder / files.urdf.name)
    with pytest.raises(RobotDescriptionError) as error:
        RobotSurface(replace(find_robot(None), files=lambda: copy))
    assert error.value.expected == "visual/link3.glb"


def test_the_scale_of_a_visual_mesh_scales_its_points(surface, tmp_path):
    files = find_robot(None).files()
    folder = shutil.copytree(files.folder, tmp_path / "robot")
    urdf = folder / files.urdf.name
    mesh = 'filename="visual/link0.glb"'
    urdf.write_text(urdf.read_text().replace(mesh, f'{mesh} scale="2 2 2"'))
    copy = replace(files, urdf=urdf)
    scaled, _ = RobotSurface(replace(find_robot(None), files=lambda: copy)).compute_points(QPOS)
    points, _ = surface.compute_points(QPOS)
    changed = np.linalg.norm(scaled - points, axis=1) > 1e-9
    assert changed.sum() == 400  # points are in the frame of link 0
    assert np.allclose(scaled[changed], 2 * points[changed])


def test_turning_the_first_joint_turns_all_links_but_the_first(surface):
    points, _ = surface.compute_points(QPOS)
    turned, _ = surface.compute_points(np.concatenate([QPOS[:3], [np.pi / 2], QPOS[4:]]))
    fixed = np.linalg.norm(points - turned, axis=1) < 1e-9
    assert fixed.sum() == 2 * 400  # base and link 0
    expected = np.stack([-points[~fixed][:, 1], points[~fixed][:, 0], points[~fixed][:, 2]], axis=1)
    assert np.allclose(turned[~fixed], expected)
