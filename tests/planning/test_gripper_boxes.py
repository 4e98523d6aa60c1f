from xml.etree import ElementTree

import numpy as np

from robocas_ms3.assets.annotations import GRIPPER_BOXES
from robocas_ms3.robots.description import MOBILE_PANDA


def test_boxes_hold_the_real_fingers_and_hand(panda_files, checker):
    """Every collision shape of the open left finger and of the hand lies in the boxes, to 1.5 mm."""
    tcp_in_hand = MOBILE_PANDA.stock_tcp_in_hand + MOBILE_PANDA.finger_extension
    finger = np.concatenate(checker.surfaces["panda_leftfinger"]) + [0, MOBILE_PANDA.open_finger, 0.0584 - tcp_in_hand]
    hand = np.concatenate(checker.surfaces["panda_hand"]) - [0, 0, tcp_in_hand]
    points = np.concatenate([finger, hand]) * [1, 1, 1]
    points[:, 1] = np.abs(points[:, 1])
    gaps = [
        np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0), axis=1) for low, high in GRIPPER_BOXES
    ]
    assert np.min(gaps, axis=0).max() < 1.5e-3
    joints = {j.attrib["name"]: j for j in ElementTree.parse(panda_files.arm_urdf).getroot().iterfind("joint")}
    assert joints["panda_finger_joint1"].find("origin").attrib["xyz"] == "0 0 0.0584"
