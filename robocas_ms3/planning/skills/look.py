"""Point the gripper camera at an object, and compute the visible fraction of the object."""

from __future__ import annotations

import numpy as np
from mani_skill.sensors.camera import CameraConfig
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.core.poses import from_wxyz, inverse
from robocas_ms3.planning.protocol import Array, Trajectory
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.robots.cameras import CameraSpec
from robocas_ms3.scenes.visibility import MeshScene, PinholeCamera, load_visual_mesh, make_ray_scene

FAR, NEAR = (0.4, 0.5), (0.2, 0.3)  # m from camera to target: first view, later views (RoboCAS-v0)
ELEVATION_DEG = (60.0, 90.0)  # elevation of the camera above the target (RoboCAS-v0)
VIEWS_SAMPLED, VIEWS_PLANNED = 384, 6


def look_at(arm: Arm, point_in_base: Array, distance: tuple[float, float]) -> None:
    """Move the gripper camera to a pose from which it views a point from above.

    Args:
        arm: context of the attempt.
        point_in_base: (3,) point in the arm's base frame, m.
        distance: minimum and maximum distance of the camera from the point, m.
    """
    arm.rise_until_free()
    with arm.planning_time():
        motion = plan_view(arm, point_in_base, distance)
    arm.follow(motion)


def plan_view(arm: Arm, point_in_base: Array, distance: tuple[float, float]) -> Trajectory:
    """Plan a motion to one of the nearest camera poses that view a point from above.

    Args:
        arm: context of the attempt.
        point_in_base: (3,) point in the arm's base frame, m.
        distance: minimum and maximum distance of the camera from the point, m. If the arm reaches no such camera pose,
            all distances from ``NEAR[0]`` to ``FAR[1]`` are tried.
    """
    tcp_in_camera = inverse(inverse(arm.scene.tcp_in_base) @ camera_in_base(arm))
    for least, greatest in (distance, (NEAR[0], FAR[1])):  # any distance, if a high table allows no such view
        views = sample_views(arm.rng, point_in_base, (least, greatest), VIEWS_SAMPLED)
        solved, qpos = arm.inverse_kinematics.nearest_solutions(views @ tcp_in_camera, arm.qpos)
        if solved.any():
            break
    else:
        raise PlanningError("look", "unreachable")
    qpos = qpos[solved]
    arm.planner.set_scene(arm.scene.obstacles())
    near = qpos[np.argsort(np.abs(qpos - arm.qpos).max(axis=1), kind="stable")]
    near = near[: 4 * VIEWS_PLANNED]
    goals = near[arm.planner.is_free(near, arm.planner.finger_width)][:VIEWS_PLANNED]
    if not len(goals):
        raise PlanningError("look", "goal_in_collision")
    return arm.planner.plan_to_qpos(arm.qpos, list(goals), stage="look")


def load_object_meshes(arm: Arm) -> None:
    """Load the meshes of all objects of the episode into the cache, which forked processes then share."""
    for asset, present in zip(arm.env.object_assets[0], arm.env.present[0].tolist(), strict=True):
        if present:
            make_ray_scene(load_visual_mesh(asset))


def measure_hidden_fraction(arm: Arm, slot: int) -> float:
    """Return the fraction of an object that other objects hide from the gripper camera.

    The fraction is 1 for an object out of view.

    The fraction is computed by ray casting without the robot, so that no renderer is needed.
    """
    env = arm.env
    config = _camera_config(arm)
    scale = 2  # half the resolution of the camera is sufficient
    pose = arm.scene.arm_base_in_world @ camera_in_base(arm)
    camera = PinholeCamera(pose, config.width // scale, config.height // scale, float(config.fov or np.pi / 2))
    slots = np.flatnonzero(env.present[0].cpu().numpy()).tolist()
    poses = np.stack([arm.scene.arm_base_in_world @ arm.scene.object_in_base(s) for s in slots])
    scenery = MeshScene([load_visual_mesh(env.object_assets[0][s]) for s in slots], poses)
    fraction = float(scenery.visible_fractions(camera)[slots.index(slot)])
    return 1.0 if np.isnan(fraction) else 1.0 - fraction


def camera_in_base(arm: Arm) -> Array:
    """Return the pose (4x4) of the gripper camera in the arm's base frame, with its random shift.

    The axes of the camera are x forward, y left, z up.
    """
    config = _camera_config(arm)
    link = arm.env.agent.robot.links_map[str(config.entity_uid)]
    camera_in_link = from_wxyz(config.pose.raw_pose[0]) @ _camera_shift(arm)
    return inverse(arm.scene.arm_base_in_world) @ from_wxyz(link.pose.raw_pose[0]) @ camera_in_link


def _camera_shift(arm: Arm) -> Array:
    return arm.env.camera_shifts[0, arm.env.agent.cameras.index(_hand_camera(arm))]


def _hand_camera(arm: Arm) -> CameraSpec:
    return next(camera for camera in arm.env.agent.cameras if camera.mount == "hand")


def _camera_config(arm: Arm) -> CameraConfig:
    return arm.env.agent.camera_config(_hand_camera(arm))


def sample_views(
    rng: np.random.Generator,
    point: Array,
    distance: tuple[float, float],
    count: int,
    *,
    elevation_deg: tuple[float, float] = ELEVATION_DEG,
    azimuth: tuple[float, float] = (-np.pi, np.pi),
) -> Array:
    """Sample camera poses (count, 4, 4) that view a point (3,) from above, with a random roll.

    The axes of the camera are x forward, y left, z up.

    Args:
        rng: random generator.
        point: (3,) point in some frame with z up, m.
        distance: minimum and maximum distance of the camera from the point, m.
        count: number of poses.
        elevation_deg: minimum and maximum elevation of the camera above the point, degrees.
        azimuth: minimum and maximum azimuth of the viewing direction, rad from the x axis.

    Returns:
        Poses (count, 4, 4) in the frame of the point.
    """
    elevation = np.deg2rad(rng.uniform(*elevation_deg, count))
    directions, roll = rng.uniform(*azimuth, count), rng.uniform(-np.pi, np.pi, count)
    # x (forward) is rotated down by the elevation and about the vertical by the azimuth
    turn = Rotation.from_euler("ZYX", np.column_stack([directions, elevation, roll]))
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = turn.as_matrix()
    poses[:, :3, 3] = point - rng.uniform(*distance, (count, 1)) * poses[:, :3, 0]
    return poses
