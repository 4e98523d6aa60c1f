"""Hold test: close the gripper around an object, lift and shake it, and check whether it stays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sapien
from numpy.typing import NDArray
from sapien import physx
from scipy.spatial.transform import Rotation

from robocas_ms3.assets.annotations import GRIPPER_BOXES
from robocas_ms3.assets.physics import (
    TIME_STEP,
    Array,
    RigidBody,
    add_body,
    engine_settings,
    grid_origins,
    make_scene,
    pose_matrix,
)
from robocas_ms3.core.errors import AssetError
from robocas_ms3.core.poses import inverse

# as in robots/agent.py and robots/urdf.py: drives in N/m and N s/m, N, m, kg, kg m2
STIFFNESS, DAMPING, FORCE_LIMIT = 1e3, 1e2, 100.0
OPEN, CLOSED = 0.04, -0.01  # m, drive targets of a finger; below 0, so that thin objects are gripped firmly too
FINGER_MASS, FINGER_INERTIA = 0.1, (6e-5, 6e-5, 6e-6)
FINGER_FRICTION, PATCH_RADIUS = 0.99, 0.1
PAD_HALF_WIDTH = 0.009  # m; the tip in GRIPPER_BOXES is 1 mm wider for clearance

CLOSING, LIFTING, SHAKING = 0.5, 0.5, 1.5  # s
LIFT = 0.1  # m
SWAY, BOB, TILT_DEG = 0.03, 0.03, 20.0  # +-m sideways, +-m up and down, +-deg
SWAY_HZ, BOB_HZ, TILT_HZ = 2.0, 2.0, 1.0
FADE = 0.375  # s, duration of fade-in and fade-out of the shaking; peaks are 6 m/s2 and 25 rad/s2
SLIPPED, TURNED_DEG = 0.02, 30.0  # m and deg of motion in the closed hand; more counts as dropped

_CARRIAGE_MASS, _CARRIAGE_INERTIA = 1.0, (0.01, 0.01, 0.01)
_CARRIAGE_STIFFNESS, _CARRIAGE_DAMPING = 1e6, 1e4  # deflects by 0.1 mm with the heaviest object
_HEIGHT = 0.5  # m above the grid position of each hand
_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])  # the TCP's z points to the ground
_DIAGONAL = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)  # diagonal between the closing axis and the width of the pads


@dataclass(frozen=True)
class _Hand:
    articulation: physx.PhysxArticulation
    carriages: list[physx.PhysxArticulationJoint]
    fingers: list[physx.PhysxArticulationJoint]
    palm: physx.PhysxArticulationLinkComponent  # its frame is the TCP's


def run_hold_test(solid: RigidBody, grasps_tcp_in_object: Array) -> NDArray[np.bool_]:
    """Simulate each grasp and return whether the object stays in the hand (G,); deterministic.

    The hand points down, and the object floats between the open fingers in the pose of the grasp. The hand closes, and
    gravity is switched on. The hand rises by 10 cm in 0.5 s. Then the hand shakes for 1.5 s: it moves by 3 cm along the
    diagonal of the pads at 2 Hz and by 3 cm up and down (up to 6 m/s2), and tilts by 20 deg at 1 Hz (up to 25 rad/s2).
    The object has stayed if, relative to the closed hand, its centre of mass moved by less than 2 cm and it rotated by
    less than 30 deg.

    Args:
        solid: the object.
        grasps_tcp_in_object: (G, 4, 4) poses of the TCP in the object's frame: z approach, y closing.
    """
    if len(grasps_tcp_in_object) == 0:
        return np.zeros(0, bool)
    turned = np.linalg.det(np.asarray(grasps_tcp_in_object)[:, :3, :3])
    if not np.allclose(turned, 1, atol=1e-3):
        expected, found = "rotations with determinant 1", f"determinants {turned.min():.3g} to {turned.max():.3g}"
        raise AssetError("invalid poses of grasps", expected=expected, found=found)
    with engine_settings():
        scene = make_scene(TIME_STEP)
        hands, objects = [], []
        for grasp, place in zip(grasps_tcp_in_object, grid_origins(len(grasps_tcp_in_object)), strict=True):
            tcp = _DOWN.copy()
            tcp[:3, 3] = place + [0, 0, _HEIGHT]
            hands.append(_add_hand(scene, tcp))
            body = add_body(scene, solid, tcp @ inverse(grasp))
            body.disable_gravity = True
            objects.append(body)
        for _ in range(round(CLOSING / TIME_STEP)):
            scene.step()
        before = _in_hand(hands, objects)
        for body in objects:
            body.disable_gravity = False
        for carriages in _motion():
            for hand in hands:
                for joint, (position, speed) in zip(hand.carriages, carriages, strict=True):
                    joint.set_drive_target(position)
                    joint.set_drive_velocity_target(speed)
            scene.step()
        after = _in_hand(hands, objects)
    center = np.append(solid.center_of_mass, 1)
    slipped = np.linalg.norm((after @ center - before @ center)[:, :3], axis=1)
    cosines = (np.einsum("nij,nij->n", before[:, :3, :3], after[:, :3, :3]) - 1) / 2
    return (slipped < SLIPPED) & (cosines > np.cos(np.radians(TURNED_DEG)))


def _motion() -> NDArray[np.float64]:
    """Return the targets of the three joints that move the hand: rise (m), sideways (m) and tilt (rad).

    Returns:
        (T, 3, 2) per time step, per joint: position and velocity.
    """
    rise = np.arange(1, round(LIFTING / TIME_STEP) + 1) * TIME_STEP / LIFTING
    time = np.arange(1, round(SHAKING / TIME_STEP) + 1) * TIME_STEP
    swell = np.clip(np.minimum(time, SHAKING - time) / FADE, 0, 1)
    swell = swell * swell * (3 - 2 * swell)
    positions = np.zeros((len(rise) + len(time), 3))
    positions[: len(rise), 0] = LIFT * rise * rise * (3 - 2 * rise)
    positions[len(rise) :, 0] = LIFT + BOB * swell * np.cos(2 * np.pi * BOB_HZ * time)
    positions[len(rise) :, 1] = SWAY * swell * np.sin(2 * np.pi * SWAY_HZ * time)
    positions[len(rise) :, 2] = np.radians(TILT_DEG) * swell * np.sin(2 * np.pi * TILT_HZ * time)
    speeds = np.diff(positions, axis=0, prepend=np.zeros((1, 3))) / TIME_STEP
    return np.stack([positions, speeds], axis=2)


def _in_hand(hands: list[_Hand], objects: list[physx.PhysxRigidDynamicComponent]) -> Array:
    """Return the pose (N, 4, 4) of each object in the TCP frame of its hand."""
    return np.array([inverse(pose_matrix(h.palm)) @ pose_matrix(o) for h, o in zip(hands, objects, strict=True)])


def _add_hand(scene: sapien.Scene, tcp_in_world: Array) -> _Hand:
    """Add an open hand to a scene, with three joints that lift, shift and tilt it.

    In this initial state, the frames of all links are equal to the TCP frame.

    Args:
        scene: the scene.
        tcp_in_world: (4, 4) initial pose of the TCP.
    """
    builder = scene.create_articulation_builder()
    builder.set_initial_pose(sapien.Pose(tcp_in_world))
    link = builder.create_link_builder()
    link.set_mass_and_inertia(_CARRIAGE_MASS, sapien.Pose(), _CARRIAGE_INERTIA)
    axes = (np.array([0.0, 0.0, -1.0]), _DIAGONAL, _DIAGONAL)
    for kind, axis in zip(("prismatic", "prismatic", "revolute"), axes, strict=True):
        link = builder.create_link_builder(link)
        link.set_mass_and_inertia(_CARRIAGE_MASS, sapien.Pose(), _CARRIAGE_INERTIA)
        frame = _along(axis)
        link.set_joint_properties(kind, [[-2.0, 2.0]], frame, frame)
    low, high = GRIPPER_BOXES[2]
    material = physx.PhysxMaterial(0.3, 0.3, 0.0)  # ManiSkill's default
    palm_low, palm_high = np.array([low[0], -high[1], low[2]]), high
    link.add_box_collision(sapien.Pose((palm_low + palm_high) / 2), (palm_high - palm_low) / 2, material)
    palm = link
    for side in (1.0, -1.0):
        finger = builder.create_link_builder(palm)
        finger.set_mass_and_inertia(FINGER_MASS, sapien.Pose(), FINGER_INERTIA)
        frame = _along(np.array([0.0, side, 0.0]))
        # the finger's frame is the TCP frame when closed, so its boxes are those of the open hand, shifted inwards
        finger.set_joint_properties("prismatic", [[0.0, OPEN]], frame, frame)
        rubber = physx.PhysxMaterial(FINGER_FRICTION, FINGER_FRICTION, 0.0)
        for number, (low, high) in enumerate(GRIPPER_BOXES[:2]):
            size, middle = high - low, (low + high) / 2 - [0, OPEN, 0]
            if number == 0:
                size[0] = 2 * PAD_HALF_WIDTH
            finger.add_box_collision(
                sapien.Pose(middle * [1, side, 1]),
                size / 2,
                rubber,
                patch_radius=PATCH_RADIUS,
                min_patch_radius=PATCH_RADIUS,
            )
    articulation = builder.build(fix_root_link=True)
    joints = articulation.active_joints
    for joint in joints[:3]:
        joint.set_drive_properties(_CARRIAGE_STIFFNESS, _CARRIAGE_DAMPING)
    for joint in joints[3:]:
        joint.set_drive_properties(STIFFNESS, DAMPING, FORCE_LIMIT)
        joint.set_drive_target(CLOSED)
    articulation.qpos = np.array([0, 0, 0, OPEN, OPEN], np.float32)
    for link in articulation.links:
        link.disable_gravity = True
    return _Hand(articulation, joints[:3], joints[3:], articulation.links[3])


def _along(axis: Array) -> sapien.Pose:
    """Return the frame of a joint whose x axis, the axis of motion, has the direction ``axis`` (3,)."""
    turn = Rotation.align_vectors([axis], [[1.0, 0.0, 0.0]])[0].as_quat()
    return sapien.Pose(q=turn[[3, 0, 1, 2]])
