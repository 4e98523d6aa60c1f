"""Camera calibration in the observations of policies."""

from __future__ import annotations

from functools import cache, partial

import numpy as np
import pytest

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.paths import protocols_dir
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec
from robocas_ms3.evaluation.rollouts.action_wrapper import PolicyActionWrapper, make_env_kwargs
from robocas_ms3.evaluation.rollouts.calibration import CameraCalibration
from robocas_ms3.evaluation.rollouts.rollout import EndConditions, EpisodeBatch
from robocas_ms3.robots.camera_models import CameraModel
from robocas_ms3.tasks.vector import make_vec

SIZE = (96, 72)
TABLE_TOP = 0.61 - 0.49  # m above the arm's base
STANDARD = ("base_camera", "gripper_camera", "static_camera")
SEEDS = (3, 4)


@cache
def observe(config: str, calibration: str = "nominal") -> Observations:
    """Return observations with depth of two envs after a step in a bundled configuration or in a file."""
    spec = PolicySpec(
        reference="tcp", cameras=dict.fromkeys(STANDARD, SIZE), depth=True, language="none", calibration=calibration
    )
    env = make_vec(
        "RoboCASPick-v1",
        2,
        backend="processes",
        arrays="numpy",
        workers=2,
        auto_reset=False,
        ignore_terminations=True,
        record_metrics=False,
        wrappers=[partial(PolicyActionWrapper, spec=spec, stepping="upstream")],
        config=config,
        **make_env_kwargs(spec, 5),
    )
    batch = EpisodeBatch(env, spec, EndConditions(10), 0.2, refill=True)
    batch.start_episodes([(i, EpisodeSpec(-1, i, "pick", "", "", "", seed, "")) for i, seed in enumerate(SEEDS)])
    list(batch.step(np.array([[0.03, 0.02, 0, 0, 0.1, 0.2, 1], [0, 0, 0.05, 0, 0, 0, 1]], np.float32)))
    found = batch.observe([1, 0])
    env.close()
    return found


def measure_table_height(seen: Observations, camera: str, row: int) -> float:
    """Return the most frequent height of surfaces above the floor, from a depth image and its calibration, m."""
    depth = seen.depths[camera][row, ..., 0] / 1000
    columns, lines = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    rays = np.linalg.inv(seen.intrinsics[camera][row]) @ np.stack([columns, lines, np.ones_like(lines)]).reshape(3, -1)
    points = rays * depth.ravel()
    pose = seen.camera_in_base[camera][row]
    heights = (pose[:3, :3] @ points + pose[:3, 3:])[2, depth.ravel() > 0]
    counts, edges = np.histogram(heights[heights > -0.3], bins=np.arange(-0.3, 0.6, 0.01) + 0.005)
    near = heights[np.abs(heights - edges[np.argmax(counts)] - 0.005) < 0.01]
    return float(np.median(near))


def test_intrinsics_of_the_size_of_the_policy():
    """90 degrees vertical field of view: f is half of the height."""
    seen = observe("pick_table_scattered")
    for camera in STANDARD:
        assert seen.intrinsics[camera].dtype == seen.camera_in_base[camera].dtype == np.float32
        np.testing.assert_allclose(seen.intrinsics[camera], [[[36, 0, 48], [0, 36, 36], [0, 0, 1]]] * 2, atol=1e-4)


def test_camera_poses_by_hand():
    """The base camera is 25 degrees down, 0.97 m above the arm's base; the gripper camera looks along the approach."""
    seen = observe("pick_table_scattered")
    s, c = np.sin(np.deg2rad(25)), np.cos(np.deg2rad(25))
    base = [[0, -s, c, 0], [-1, 0, 0, -0.3], [0, -c, -s, 0.97], [0, 0, 0, 1]]
    np.testing.assert_allclose(seen.camera_in_base["base_camera"], [base] * 2, atol=1e-5)
    for row in range(2):
        tcp = seen.tcp_in_base[row]
        pose = seen.camera_in_base["gripper_camera"][row]
        w, x, y, z = tcp[3:]
        approach = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
        np.testing.assert_allclose(pose[:3, 2], approach, atol=1e-5)
        np.testing.assert_allclose((pose[:3, 3] - tcp[:3]) @ approach, 0.05 - 0.1334, atol=1e-5)
    assert np.abs(np.diff(seen.camera_in_base["gripper_camera"], axis=0)).max() > 0.01  # each env has its own


@pytest.mark.parametrize("camera", STANDARD)
def test_depth_images_agree_with_the_calibration(camera):
    seen = observe("pick_table_scattered")
    for row in range(2):
        assert measure_table_height(seen, camera, row) == pytest.approx(TABLE_TOP, abs=0.003)


def test_nominal_calibration_does_not_contain_the_random_motion():
    config = str(protocols_dir() / "cameras-v1/configs/pick_table_scattered-far.yaml")
    plain, nominal, true = observe("pick_table_scattered"), observe(config), observe(config, "true")
    for camera in STANDARD:
        np.testing.assert_array_equal(nominal.images[camera], true.images[camera])
        np.testing.assert_array_equal(nominal.intrinsics[camera], plain.intrinsics[camera])
        moved = np.linalg.norm((true.camera_in_base[camera] - nominal.camera_in_base[camera])[:, :3, 3], axis=1)
        assert ((moved > 0.06) & (moved < 0.1 * np.sqrt(3) + 1e-6)).all()  # 6 to 10 cm per axis
        assert abs(moved[0] - moved[1]) > 1e-3  # each episode has its own motion
    np.testing.assert_allclose(nominal.camera_in_base["base_camera"], plain.camera_in_base["base_camera"], atol=1e-6)
    for row in range(2):
        for camera in STANDARD:
            assert measure_table_height(true, camera, row) == pytest.approx(TABLE_TOP, abs=0.005)


def test_world_cameras_move_with_the_measured_pose_of_the_robot():
    """The robot is at (1, 0, 0.5), turned by 90 degrees about z; the camera is at (1, 2, 1)."""
    camera = np.eye(4)
    camera[:3, 3] = 1, 2, 1
    model = {"side_camera": CameraModel(np.array([1.0, 1.0, 1.0, 1.0]), camera, "world", camera)}
    found = CameraCalibration(PolicySpec(cameras={"side_camera": (2, 2)}), [model, model])
    half = np.sqrt(0.5)
    obs = {
        "agent": {"tcp_in_arm_base": np.array([[0, 0, 0, 1, 0, 0, 0], [0.4, 0, 0, 1, 0, 0, 0]], np.float32)},
        "extra": {"tcp_pose": np.array([[0, 0, 0, 1, 0, 0, 0], [1, 0.4, 0.5, half, 0, 0, half]], np.float32)},
    }
    poses = found.compute_camera_in_base(np.array([1]), obs)["side_camera"]
    np.testing.assert_allclose(poses, [[[0, 1, 0, 2], [-1, 0, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]]], atol=1e-6)


def test_depth_without_cameras_is_refused():
    with pytest.raises(EvaluationError) as error:
        PolicySpec(depth=True)
    assert (error.value.where, error.value.found) == ("depth", "True")
