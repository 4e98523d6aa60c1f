"""Numbers of the mobile Panda: joints, limits, configurations. Metres, radians, seconds."""

from __future__ import annotations

from math import pi

ROBOT_UID = "robocas_mobile_panda"

BASE_JOINTS: tuple[str, ...] = ("base_x_joint", "base_y_joint", "base_yaw_joint")
ARM_JOINTS: tuple[str, ...] = tuple(f"panda_joint{i}" for i in range(1, 8))
FINGER_JOINTS: tuple[str, ...] = ("panda_finger_joint1", "panda_finger_joint2")
JOINTS = BASE_JOINTS + ARM_JOINTS + FINGER_JOINTS
"""Active joints in the order of ``qpos``: x, y, yaw, 7 arm joints, 2 fingers."""
BASE_SLICE, ARM_SLICE, FINGER_SLICE = slice(0, 3), slice(3, 10), slice(10, 12)

BASE_LIMITS = ((-0.2, 0.8), (-0.8, 0.8), (-pi, pi / 2))
ARM_LIMITS = (
    (-2.8973, 2.8973),
    (-1.7628, 1.7628),
    (-2.8973, 2.8973),
    (-3.0718, -0.0698),
    (-2.8973, 2.8973),
    (-0.0175, 3.7525),
    (-2.8973, 2.8973),
)
FINGER_LIMITS = ((0.0, 0.04), (0.0, 0.04))
OPEN_FINGER = 0.04
"""Joint position of a finger of the open gripper, m."""
FINGER_TARGETS = (-0.01, OPEN_FINGER)
"""Target of a finger at the gripper actions -1 and +1, m: beyond closed, so that thin objects are pressed too."""

ARM_REST = (0.0, -1.02, 0.0, -2.51, 0.0, 1.35, 0.78)
ARM_EVALUATION_START = (-0.0276, 0.1581, 0.0, -1.8899, -0.0688, 2.7705, 0.7514)

ARM_VELOCITY_LIMIT = 0.5  # rad/s, every arm joint, for planned motion
ARM_ACCELERATION_LIMIT = 0.5  # rad/s^2

ARM_BASE_LINK = "panda_link0"
BASE_LINK = "base_link"
HAND_LINK = "panda_hand"
TCP_LINK = "panda_hand_tcp"
FINGER_LINKS: tuple[str, ...] = ("panda_leftfinger", "panda_rightfinger")

# Heights. The base body hangs 0.26 m below the base link: read as "the body stands on the floor", so the base link is
# 0.26 m above it and the arm's base 0.49 m. (At 0.23 m the evaluation start would put the TCP 3 cm above the 0.61 m
# table, among the objects; at 0.49 m it is 0.29 m above it.)
BASE_LINK_HEIGHT = 0.26
ARM_BASE_ABOVE_BASE_LINK = 0.23
PEDESTAL_SIZE = (0.25, 0.2, 0.2)
PEDESTAL_ABOVE_BASE_LINK = 0.13  # its centre

STOCK_TCP_IN_HAND = 0.1034  # z
FINGER_EXTENSION = 0.03
"""How much longer than stock the fingers are, m; moves the TCP to 0.1334 m from the hand."""
FINGER_FRICTION = 0.99
