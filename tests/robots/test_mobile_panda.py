from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import sapien
from robot_checks import link_poses
from scipy.spatial.transform import Rotation

from robocas_ms3.robots.agent import RoboCASMobilePanda, RoboCASMobilePandaStockFingers
from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.robots.urdf import make_robot_files

EVALUATION = dict(zip(MOBILE_PANDA.arm_joints, MOBILE_PANDA.arm_evaluation_start, strict=True))


def test_simulated_robot_agrees_with_the_urdf(make_env):
    _, agent = make_env()
    assert tuple(joint.name for joint in agent.robot.active_joints) == MOBILE_PANDA.joints
    limits = np.array(MOBILE_PANDA.base_limits + MOBILE_PANDA.arm_limits + MOBILE_PANDA.finger_limits)
    assert agent.robot.get_qlimits()[0].numpy() == pytest.approx(limits, abs=1e-5)
    root = np.eye(4)
    root[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    root[:3, 3] = [0.7, 0.15, 0]
    fingers = dict.fromkeys(MOBILE_PANDA.finger_joints, 0.04)
    for link, pose in link_poses(make_robot_files().urdf, EVALUATION | fingers).items():
        simulated = agent.robot.links_map[link].pose.sp.to_transformation_matrix()
        assert simulated == pytest.approx(root @ pose, abs=1e-5), link


def test_observation_of_the_robot(make_env):
    env, agent = make_env(obs_mode="state_dict")
    observation = env.unwrapped.get_obs()["agent"]
    assert {key: tuple(value.shape) for key, value in observation.items()} == {
        "qpos": (1, 12),
        "qvel": (1, 12),
        "tcp_in_arm_base": (1, 7),
        "gripper_width": (1, 1),
    }
    assert observation["gripper_width"].item() == pytest.approx(0.08)
    expected = link_poses(make_robot_files().arm_urdf, EVALUATION)["panda_hand_tcp"]
    assert observation["tcp_in_arm_base"][0, :3].numpy() == pytest.approx(expected[:3, 3], abs=1e-5)
    rotation = Rotation.from_quat(observation["tcp_in_arm_base"][0, [4, 5, 6, 3]].numpy()).as_matrix()
    assert rotation == pytest.approx(expected[:3, :3], abs=1e-5)


def test_stock_fingers_are_a_second_robot(make_env):
    _, agent = make_env(robot=RoboCASMobilePandaStockFingers.uid)
    distance = agent.tcp.pose.p - agent.robot.links_map["panda_hand"].pose.p
    assert distance.norm().item() == pytest.approx(0.1034, abs=1e-5)
    assert RoboCASMobilePandaStockFingers.urdf_path != RoboCASMobilePanda.urdf_path


# Camera axes below are in the mount's frame: forward is the camera's x, up its z.
CAMERAS = {
    "base_camera": ("base_link", (0, -0.3, 1.2), (np.cos(0.43633), 0, -np.sin(0.43633)), 0.005, 5),
    "gripper_camera": ("panda_hand", (0.05, 0, 0.05), (0, 0, 1), 0.001, 5),
    "static_camera": (None, (1, 1.5, 1.5), (0, -0.5, -np.sqrt(0.75)), 0.05, 10),
}


def test_cameras_match_robocas_v0(make_env):
    _, agent = make_env()
    configs = {config.uid: config for config in agent._sensor_configs}
    assert list(configs) == list(CAMERAS)
    for uid, (mount, position, forward, near, far) in CAMERAS.items():
        config = configs[uid]
        assert (config.entity_uid, config.near, config.far) == (mount, near, far)
        assert (config.width, config.height, config.shader_pack) == (640, 480, "minimal")
        assert config.fov == pytest.approx(np.pi / 2)
        axes = config.pose.sp.to_transformation_matrix()
        assert axes[:3, 3] == pytest.approx(position)
        assert axes[:3, 0] == pytest.approx(forward, abs=1e-6)
    gripper = configs["gripper_camera"].pose.sp.to_transformation_matrix()
    assert gripper[:3, 2] == pytest.approx([1, 0, 0], abs=1e-6)  # up: away from the fingers, which are below


@pytest.mark.slow
def test_cameras_see_what_they_should():
    import mani_skill.envs  # noqa: F401

    try:
        env = gym.make(
            "Empty-v1",
            robot_uids=MOBILE_PANDA.uid,
            obs_mode="segmentation",
            sensor_configs=dict(width=160, height=120),
            sim_config=dict(sim_freq=100, control_freq=20),
        )
    except RuntimeError as error:
        pytest.skip(f"no render device: {error}")
    try:
        env.reset(seed=0)
        agent = env.unwrapped.agent
        agent.robot.set_pose(sapien.Pose([0.7, 0.15, 0], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]))
        agent.reset(agent.keyframes["evaluation"].qpos)
        observation = env.unwrapped.get_obs()
        images, cameras = observation["sensor_data"], observation["sensor_param"]
        assert list(images) == list(CAMERAS)
        # The gripper's image: both fingers, mirrored, in the lower half; the TCP between them.
        labels = images["gripper_camera"]["segmentation"][0, ..., 0].numpy()
        ids = {name: agent.robot.links_map[name].per_scene_id[0].item() for name in MOBILE_PANDA.finger_links}
        columns = {name: np.nonzero(labels == number)[1] for name, number in ids.items()}
        assert all(len(found) > 200 for found in columns.values())
        left, right = sorted(columns.values(), key=np.mean)
        assert left.max() < 80 < right.min()
        assert left.mean() + right.mean() == pytest.approx(159, abs=3)
        u, v = project(cameras["gripper_camera"], agent.tcp.pose.p[0].numpy())
        assert u == pytest.approx(80, abs=1)
        # The TCP is 0.0834 m ahead of the camera and 0.05 m below its axis; f = 60 pixels.
        assert v == pytest.approx(60 + 60 * 0.05 / 0.0834, abs=1)
        wrist = [agent.robot.links_map[f"panda_{link}"].per_scene_id[0].item() for link in ("link6", "link7", "hand")]
        for uid in ("base_camera", "static_camera"):
            u, v = project(cameras[uid], agent.tcp.pose.p[0].numpy())
            assert 0 < u < 160 and 0 < v < 120, uid
            assert np.isin(images[uid]["segmentation"].numpy(), wrist).sum() > 50, uid
    finally:
        env.close()


def project(camera: dict, point: np.ndarray) -> tuple[float, float]:
    """Pixel of a world point, by the camera's own OpenCV parameters."""
    in_camera = camera["extrinsic_cv"][0].numpy() @ np.append(point, 1.0)
    u, v, depth = camera["intrinsic_cv"][0].numpy() @ in_camera[:3]
    assert depth > 0
    return u / depth, v / depth


def test_gripper_holds_a_box(make_env):
    """A free 0.3 kg box, 5 cm wide, held against gravity, swung about, and let go."""
    env, agent = make_env(fresh=True)
    scene = env.unwrapped.scene
    arm = MOBILE_PANDA.arm_evaluation_start
    builder = env.unwrapped.scene.create_actor_builder()
    material = sapien.physx.PhysxMaterial(0.99, 0.99, 0.0)
    builder.add_box_collision(half_size=[0.04, 0.025, 0.03], material=material, density=0.3 / (0.08 * 0.05 * 0.06))
    builder.initial_pose = agent.tcp.pose.sp
    box = builder.build("box")
    assert not agent.is_grasping(box).item()
    # Weightless until the fingers have it.
    box._bodies[0].disable_gravity = True
    for _ in range(10):
        env.step(np.array([*arm, -1], np.float32))
    box._bodies[0].disable_gravity = False
    assert agent.is_grasping(box).item()
    assert agent.gripper_width.item() == pytest.approx(0.05, abs=1.5e-3)
    for finger in (agent.finger1_link, agent.finger2_link):
        force = scene.get_pairwise_contact_forces(finger, box).norm().item()
        assert 25 < force < 45  # stiffness 1000 N/m x (0.025 + 0.01) m = 35 N
    held = (agent.tcp.pose.inv() * box.pose).p
    for angle in np.concatenate([np.linspace(0, 0.3, 12), np.linspace(0.3, -0.3, 24), np.full(10, -0.3)]):
        env.step(np.array([arm[0] + angle, *arm[1:6], arm[6] + angle, -1], np.float32))
    slip = ((agent.tcp.pose.inv() * box.pose).p - held).norm().item()
    assert slip < 1e-3
    assert agent.is_static().item()
    for _ in range(10):
        env.step(np.array([*MOBILE_PANDA.arm_evaluation_start, 1], np.float32))
    assert not agent.is_grasping(box).item()
    assert box.pose.p[0, 2] < 0.5  # it fell


def test_is_static_ignores_the_fingers(make_env):
    _, agent = make_env()
    qvel = np.zeros(12)
    qvel[10] = 1.0
    agent.robot.set_qvel(qvel)
    assert agent.is_static().item()
    for joint in (0, 5):
        qvel[joint] = 0.3
        agent.robot.set_qvel(qvel)
        assert not agent.is_static().item()
        assert agent.is_static(threshold=0.4).item()
        qvel[joint] = 0
