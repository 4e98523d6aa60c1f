"""Estimates of the errors of camera poses from images of the robot."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robocas_ms3.baselines.keyframe.camera_correction import correct_frames, estimate_correction, estimate_corrections
from robocas_ms3.baselines.keyframe.perception import CameraFrame
from robocas_ms3.core.poses import from_rotation, inverse, transform_points
from robocas_ms3.robots.registry import find_robot
from robocas_ms3.robots.surface import RobotSurface

QPOS = np.array([0, 0, 0, 0, -1.02, 0, -2.51, 0, 1.35, 0.78, 0.04, 0.04])
SIZE, FOCAL = (1440, 1920), 960.0
INTRINSICS = np.array([[FOCAL, 0, 960], [0, FOCAL, 720], [0, 0, 1]])
# a camera 1.3 m in front of the arm that looks back at it: x to the left of the arm, y down
CAMERA = from_rotation([1.3, 0.2, 0.5], np.array([[0, 0, -1.0], [1, 0, 0], [0, -1, 0]]))


@pytest.fixture(scope="module")
def surface():
    return RobotSurface(find_robot(None)).compute_points(QPOS)


def render(points, normals, pose):
    """Return a depth image (mm) with the points that face the camera, each at the nearest sampled pixel."""
    depth = np.full(SIZE, 4000, np.int16)
    facing = np.einsum("ij,ij->i", normals, pose[:3, 3] - points) > 0
    x, y, z = transform_points(inverse(pose), points[facing]).T
    columns, rows = (
        np.round((FOCAL * of / z + middle - 2.5) / 4).astype(int) * 4 + 2 for of, middle in ((x, 960), (y, 720))
    )
    inside = (z > 0) & (rows >= 0) & (rows < SIZE[0]) & (columns >= 0) & (columns < SIZE[1])
    order = np.argsort(-z[inside])
    depth[rows[inside][order], columns[inside][order]] = np.round(1000 * z[inside][order])
    return depth


def make_frame(depth, pose):
    return CameraFrame(np.zeros((*SIZE, 3), np.uint8), depth, INTRINSICS, pose)


@pytest.mark.parametrize(
    ("shift", "turn_deg"),
    [((0.02, 0, 0), (0, 0, 0)), ((-0.04, 0.05, 0.03), (4, -3, 5)), ((0.06, -0.1, 0.08), (9, 6, -8))],
)
def test_the_error_of_a_pose_is_estimated(surface, shift, turn_deg):
    error = from_rotation(shift, Rotation.from_rotvec(turn_deg, degrees=True).as_matrix())
    nominal = CAMERA @ inverse(error)
    found = estimate_correction(make_frame(render(*surface, CAMERA), nominal), *surface)
    assert found is not None
    rest = inverse(error) @ found
    assert np.linalg.norm(rest[:3, 3]) < 0.006 and Rotation.from_matrix(rest[:3, :3]).magnitude() < np.deg2rad(0.5)


def test_a_pose_that_fits_is_not_changed(surface):
    depth = render(*surface, CAMERA)
    found = estimate_correction(make_frame(depth, CAMERA), *surface)
    assert found is not None and (found == np.eye(4)).all()


def test_without_the_robot_in_the_image_the_error_is_unknown(surface):
    assert estimate_correction(make_frame(np.full(SIZE, 4000, np.int16), CAMERA), *surface) is None
    covered = np.full(SIZE, 30, np.int16)  # 3 cm in front of the lens
    assert estimate_correction(make_frame(covered, CAMERA), *surface) is None
    nothing = np.zeros((0, 3))
    assert estimate_correction(make_frame(render(*surface, CAMERA), CAMERA), nothing, nothing) is None


def test_images_of_fixed_cameras_with_unknown_errors_are_left_out_if_another_camera_has_an_error(surface):
    depth, error = render(*surface, CAMERA), from_rotation([-0.04, 0.05, 0.03], np.eye(3))
    empty = np.full(SIZE, 4000, np.int16)
    frames = {
        "base_camera": make_frame(depth, CAMERA @ inverse(error)),
        "static_camera": make_frame(empty, CAMERA),
        "gripper_camera": make_frame(empty, CAMERA),
    }
    corrections = estimate_corrections(frames, *surface)
    corrected = correct_frames(frames, corrections, "gripper_camera")
    assert set(corrected) == {"base_camera", "gripper_camera"}
    assert np.allclose(corrected["base_camera"].camera_in_base[:3, 3], CAMERA[:3, 3], atol=0.006)
    assert corrected["gripper_camera"].camera_in_base.tolist() == CAMERA.tolist()


def test_images_are_not_changed_without_errors(surface):
    frames = {"base_camera": make_frame(render(*surface, CAMERA), CAMERA)}
    frames["static_camera"] = make_frame(np.full(SIZE, 4000, np.int16), CAMERA)
    corrections = estimate_corrections(frames, *surface)
    assert set(corrections) == {"base_camera"}
    assert correct_frames(frames, corrections, "gripper_camera") is frames
