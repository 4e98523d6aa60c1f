"""The description agrees with the robot that is built from it, and with itself."""

import xml.etree.ElementTree as ET

import numpy as np

from robocas_ms3.assets.gripper import GRIPPER_BOXES
from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.robots.urdf import robot_files


def test_positions_are_where_the_slices_say():
    joints = np.array(MOBILE_PANDA.joints)
    assert joints[MOBILE_PANDA.base_slice].tolist() == list(MOBILE_PANDA.base_joints)
    assert joints[MOBILE_PANDA.arm_slice].tolist() == list(MOBILE_PANDA.arm_joints)
    assert joints[MOBILE_PANDA.finger_slice].tolist() == list(MOBILE_PANDA.finger_joints)
    limits = MOBILE_PANDA.base_limits + MOBILE_PANDA.arm_limits + MOBILE_PANDA.finger_limits
    assert len(limits) == len(joints) == 12


def test_its_links_are_the_robots():
    links = {link.get("name") for link in ET.parse(robot_files().urdf).getroot().iterfind("link")}
    own = MOBILE_PANDA
    assert {own.base_link, own.arm_base_link, own.hand_link, own.tcp_link, *own.arm_links, *own.finger_links} <= links
    assert own.base_link != own.arm_base_link


def test_grasps_are_annotated_for_a_gripper_as_wide():
    assert GRIPPER_BOXES[0, 0, 1] * 2 == MOBILE_PANDA.open_width == 0.08
