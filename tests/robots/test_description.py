"""The description agrees with the robot that is built from it, and with itself."""

from dataclasses import replace

import numpy as np
import pytest

from robocas_ms3.assets.annotations import GRIPPER_BOXES
from robocas_ms3.core.errors import ExtensionError, RobocasError
from robocas_ms3.robots.cameras import CameraSpec
from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.robots.quantities import Quantity
from robocas_ms3.robots.registry import DEFAULT_ROBOT, PANDA, ROBOTS, find_robot


def test_slices_select_the_joints_of_each_part():
    joints = np.array(MOBILE_PANDA.joints)
    assert joints[MOBILE_PANDA.base_slice].tolist() == list(MOBILE_PANDA.base_joints)
    assert joints[MOBILE_PANDA.arm_slice].tolist() == list(MOBILE_PANDA.arm_joints)
    assert joints[MOBILE_PANDA.finger_slice].tolist() == list(MOBILE_PANDA.finger_joints)
    limits = MOBILE_PANDA.base_limits + MOBILE_PANDA.arm_limits + MOBILE_PANDA.finger_limits
    assert len(limits) == len(joints) == 12


def test_grasp_annotations_fit_the_gripper_width():
    assert GRIPPER_BOXES[0, 0, 1] * 2 == MOBILE_PANDA.open_width == 0.08


@pytest.mark.parametrize(
    ("part", "what"),
    [("arm_joints", 7), ("arm_limits", 7), ("base_joints", 3), ("finger_links", 2), ("arm_rest", 7)],
)
def test_another_number_of_joints_is_an_error(part, what):
    fewer = getattr(MOBILE_PANDA, part)[:-1]
    with pytest.raises(
        RobocasError, match=rf"six, {part}: wrong number of entries \(expected {what}, found {what - 1}\)"
    ):
        replace(MOBILE_PANDA, uid="six", **{part: fewer})


def test_robots_are_registered_by_their_uids():
    assert DEFAULT_ROBOT == "robocas_mobile_panda"
    assert find_robot(None) is find_robot(DEFAULT_ROBOT) is PANDA
    assert {name: spec.description.uid for name, spec in ROBOTS.items()} == {name: name for name in ROBOTS}
    with pytest.raises(ExtensionError, match="here: no such robot .*Did you mean robocas_mobile_panda"):
        find_robot("robocas_mobile_pandas", where="here")


def test_an_entry_point_with_another_name_than_its_uid_is_refused(monkeypatch):
    monkeypatch.setitem(ROBOTS.builtin, "other", PANDA)
    message = "name of the entry point differs from the uid of the robot .expected robocas_mobile_panda, found other"
    with pytest.raises(ExtensionError, match=message):
        find_robot("other")


@pytest.mark.parametrize("name", ["top", "Side_camera", "../side_camera", ""])
def test_an_invalid_camera_name_is_refused(name):
    with pytest.raises(ExtensionError):
        CameraSpec(name)


def test_an_optional_quantity_has_no_lerobot_feature():
    with pytest.raises(ValueError):
        Quantity("gap", "float32", ("T", 1), "m", "between the pads", lerobot_feature="observation.gap", optional=True)
