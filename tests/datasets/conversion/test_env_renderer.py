"""Rendering of recorded states with the cameras of ManiSkill."""

import json
import shutil

import gymnasium as gym
import h5py
import numpy as np
import pytest

from robocas_ms3.cli.convert import main
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.checks import depth as geometry
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.conversion.convert import convert
from robocas_ms3.datasets.conversion.env_renderer import EnvRenderer
from robocas_ms3.datasets.conversion.settings import ConversionSettings
from robocas_ms3.datasets.images.image_files import ImageOptions
from robocas_ms3.demos.recordings.trajectory_file import TrajectoryFile

ENV_ID = "robocas_ms3:RoboCASPick-v1"
SIZE = (96, 72)
STEPS = 9

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, needs_renderer):
    """A short motion of the real environment in the generator's form, and what its cameras and links were like then."""
    path = tmp_path_factory.mktemp("recorded") / "F.h5"
    env = gym.make(
        ENV_ID,
        obs_mode="rgb+depth",
        control_mode="pd_joint_pos",
        sensor_configs=dict(zip(("width", "height"), SIZE, strict=True)),
    )
    base = env.unwrapped
    obs, _ = env.reset(seed=11)
    goal = np.array([0.3, 0.3, 0.2, -1.7, 0.1, 2.0, 1.2])
    states, seen, tcp, actions = [base.get_state_dict()], [obs["sensor_data"]], [base.agent.tcp.pose], []
    start = base.agent.robot.get_qpos()[0, 3:10].numpy()
    for step in range(STEPS):
        arm = start + (goal - start) * min(1, (step + 1) / 6)
        actions.append(np.append(arm, 1 if step < 5 else -1).astype(np.float32))
        obs, *_ = env.step(actions[-1])
        states.append(base.get_state_dict())
        seen.append(obs["sensor_data"])
        tcp.append(base.agent.tcp.pose)
    instruction = base.get_language_instruction()[0]
    env.close()
    with h5py.File(path, "w") as file:
        group = file.create_group("traj_0")
        group["actions"] = np.stack(actions)
        for kind in ("actors", "articulations"):
            for name in states[0][kind]:
                group[f"env_states/{kind}/{name}"] = np.concatenate([state[kind][name].numpy() for state in states])
    goals = [
        {"goal_type": "move and grasp", "goal_description": "grasp it", "goal_range": [0, 4]},
        {"goal_type": "transfer object", "goal_description": "drop it", "goal_range": [5, STEPS - 1]},
    ]
    episode = {
        "episode_id": 0, "episode_seed": 11, "control_mode": "pd_joint_pos", "elapsed_steps": STEPS,
        "reset_kwargs": {"seed": 11}, "success": True, "robocas": {"instruction": instruction, "subgoals": goals},
    }  # fmt: skip
    env_info = {"env_id": ENV_ID, "env_kwargs": {"control_mode": "pd_joint_pos", "obs_mode": "none"}}
    metadata = {"env_info": env_info, "episodes": [episode], "robocas": {"control_freq": 20}}
    path.with_suffix(".json").write_text(json.dumps(metadata))
    return path, seen, [pose.to_transformation_matrix()[0].numpy() for pose in tcp]


@pytest.fixture(scope="module")
def recording(recorded):
    with TrajectoryFile(recorded[0]) as file:
        yield file.read_recording(0)


@pytest.fixture(scope="module")
def source(recorded, recording):
    with TrajectoryFile(recorded[0]) as file:
        frames = EnvRenderer(file.env, "pd_joint_pos", ImageOptions(size=SIZE))
    frames.load_scene(recording)
    yield frames
    frames.close()


def shown(source, recording, index):
    (frame,) = source.frames(recording, np.array([index]))
    return frame


def test_rendered_states_equal_the_recorded_images(source, recording, recorded):
    _, seen, tcp = recorded
    for index in (0, 4, STEPS):
        frame = shown(source, recording, index)
        by_kinematics = recording.compute_motion(np.array([index])).tcp_in_world[0]
        np.testing.assert_allclose(by_kinematics, tcp[index], atol=1e-5)
        for camera in frame.rgb:
            then = seen[index][camera]
            difference = np.abs(frame.rgb[camera].astype(int) - then["rgb"][0].numpy()).max(axis=2)
            assert np.mean(difference > 8) < 0.01, (index, camera)
            deeper = np.abs(frame.depth[camera].astype(int) - then["depth"][0, ..., 0].numpy())
            assert np.mean(deeper > 2) < 0.01, (index, camera)


def test_boxes_contain_the_target(recorded, recording):
    """A visible centre of the target is inside its box."""
    with TrajectoryFile(recorded[0]) as file:
        frames = EnvRenderer(file.env, "pd_joint_pos", ImageOptions(size=SIZE, boxes=True))
    frames.load_scene(recording)
    frame = shown(frames, recording, 0)
    base, cameras = frames.env.unwrapped, frames.cameras()
    centre = base.target_center(base.object_states)[0]
    seen = 0
    for camera, (left, top, right, bottom) in frame.boxes.items():
        assert 0 <= left <= right < SIZE[0]
        assert 0 <= top <= bottom < SIZE[1]
        matrix = base.scene.sensors[camera].camera.get_extrinsic_matrix()[0].numpy()
        x, y, z = matrix[:3, :3] @ np.asarray(centre) + matrix[:3, 3]
        fx, fy, cx, cy = cameras[camera].intrinsic
        column, row = round(fx * x / z + cx - 0.5), round(fy * y / z + cy - 0.5)
        inside = 0 <= column < SIZE[0] and 0 <= row < SIZE[1]
        if inside and abs(frame.depth[camera][row, column] / 1000 - z) < 0.03:
            seen += 1
            assert left <= column <= right
            assert top <= row <= bottom
    frames.close()
    assert seen
    assert frame.boxes.keys() <= frame.rgb.keys()


def test_rendering_does_not_step_physics(source, recording):
    state = recording.state(5)
    shown(source, recording, 5)
    now = source.env.unwrapped.get_state_dict()
    for kind, arrays in state.items():
        for name, array in arrays.items():
            np.testing.assert_allclose(now[kind][name].numpy()[:, :7], array[:, :7], atol=1e-6, err_msg=name)


def test_camera_poses_equal_the_declared_ones(source):
    """By hand, OpenCV axes: base camera 1.2 - 0.23 m above the arm's base, 25 deg down; gripper camera along z."""
    cameras = source.cameras()
    s, c = np.sin(np.deg2rad(25)), np.cos(np.deg2rad(25))
    expected = {
        "base_camera": [[0, -s, c, 0], [-1, 0, 0, -0.3], [0, -c, -s, 0.97]],
        "gripper_camera": [[0, -1, 0, 0.05], [1, 0, 0, 0], [0, 0, 1, 0.05 - 0.1334]],
        "static_camera": [[-1, 0, 0, 1], [0, np.sqrt(0.75), -0.5, 1.5], [0, -0.5, -np.sqrt(0.75), 1.5]],
    }
    for name, pose in expected.items():
        np.testing.assert_allclose(cameras[name].camera_in_parent[:3], pose, atol=2e-5, err_msg=name)
        np.testing.assert_allclose(cameras[name].intrinsic, [36, 36, 48, 36], atol=1e-4)


def test_depth_agrees_with_the_cameras(source, recording):
    steps = []
    for index in (0, 5, STEPS):
        frame = shown(source, recording, index)
        motion = recording.compute_motion(np.array([index]))
        parents = {"gripper_camera": motion.tcp_in_world[0], "base_camera": motion.arm_base_in_world[0]}
        steps.append(
            [
                geometry.DepthView(
                    *(n, frame.depth[n], m.intrinsic, parents.get(n, np.eye(4)) @ m.camera_in_parent),
                    on_gripper=m.parent == "ee",
                )
                for n, m in source.cameras().items()
            ]
        )
    assert list(geometry.check_depth_views(steps)) == []
    # The table's top is a plane at 0.61 m: most of its points agree to the millimetre.
    heights = steps[0][-1].points()[:, 2]
    assert np.median(np.abs(heights[np.abs(heights - 0.61) < 0.01] - 0.61)) < 0.0025


def test_different_scene_is_refused(source, recording):
    import dataclasses

    def spoiled(**changes):
        return dataclasses.replace(recording, **changes)

    moved = {kind: dict(arrays) for kind, arrays in recording.states.items()}
    moved["actors"]["object_3"] = moved["actors"]["object_3"] + np.float32(0.01)
    with pytest.raises(DatasetError, match="seed 11, object_3: the rebuilt scene differs.* 17.3 mm off"):
        source.load_scene(spoiled(states=moved))
    fewer = {kind: dict(arrays) for kind, arrays in recording.states.items()}
    del fewer["actors"]["object_3"]
    with pytest.raises(DatasetError, match="the rebuilt scene differs"):
        source.load_scene(spoiled(states=fewer))
    with pytest.raises(DatasetError, match="expected fly away"):
        source.load_scene(spoiled(instruction="fly away"))
    source.load_scene(recording)


def test_refused_scene_leaves_no_files(recorded, tmp_path):
    path = shutil.copy(recorded[0], tmp_path / "F.h5")
    metadata = json.loads(recorded[0].with_suffix(".json").read_text())
    metadata["episodes"][0]["episode_seed"] = 12
    (tmp_path / "F.json").write_text(json.dumps(metadata))
    with pytest.raises(DatasetError, match="episode 0, seed 12, object_0: the rebuilt scene differs"):
        convert(ConversionSettings(path, tmp_path / "out", embeddings=False, video=False, size=SIZE))
    assert {entry.name for entry in tmp_path.iterdir()} == {"F.h5", "F.json"}


def test_a_real_dataset_is_valid(recorded, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(ConversionSettings(recorded[0], out, embeddings=False, size=SIZE)) == 0
    assert "1 episode, 4 steps" in capsys.readouterr().out  # states 0, 4, 8, 9
    assert {path.name for path in (out / "preview").iterdir()} == {"episode_0000000.mp4", "contact_sheet.png"}
    assert validate(out).violations == []
    with np.load(out / "episode_0000000" / "episode_info.npz") as arrays:
        assert arrays["gripper_status"].tolist() == [True, True, False, False]
        # The mobile base is at (0.7, 0.15), turned by 90 deg; the arm's base above it.
        np.testing.assert_allclose(arrays["agv_pose"], [[0.7, 0.15, np.pi / 2]] * 4, atol=1e-3)
        np.testing.assert_allclose(arrays["base_pos"][:, :2], [[0.7, 0.15]] * 4, atol=1e-3)
