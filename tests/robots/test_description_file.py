"""URDF and SRDF files as the reader returns them, and malformed ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robocas_ms3.core.errors import RobotDescriptionError
from robocas_ms3.robots.description_file import RobotXml, read_joints

ARM = """<robot name="arm">
  <link name="base"/><link name="upper"/><link name="lower"/><link name="pad"/>
  <joint name="elbow" type="prismatic"><parent link="upper"/><child link="lower"/>
    <origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/><axis xyz="0 -1 0"/><limit lower="-1" upper="0.5"/></joint>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/><limit effort="3"/></joint>
  <joint name="wrist" type="fixed"><parent link="upper"/><child link="pad"/></joint>
</robot>"""


@pytest.fixture
def write(tmp_path):
    def write(text: str) -> Path:
        path = tmp_path / "arm.urdf"
        path.write_text(text)
        return path

    return write


def test_joints_between_two_links_are_in_order_from_the_root(write):
    joints = RobotXml(write(ARM)).joints_between("base", "lower")
    assert [(j.name, j.kind, j.parent, j.child) for j in joints] == [
        ("shoulder", "continuous", "base", "upper"),
        ("elbow", "prismatic", "upper", "lower"),
    ]
    shoulder, elbow = joints
    np.testing.assert_array_equal(shoulder.origin, np.eye(4))
    assert shoulder.axis.tolist() == [1, 0, 0]
    assert shoulder.limits is None
    np.testing.assert_allclose(elbow.origin, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-15)
    assert elbow.axis.tolist() == [0, -1, 0]
    assert elbow.limits == (-1, 0.5)


def test_a_fixed_joint_needs_no_axis(write):
    path = write(ARM.replace('type="fixed">', 'type="fixed"><axis xyz="0 0 0"/>'))
    assert RobotXml(path).joints()[2].axis.tolist() == [1, 0, 0]


@pytest.mark.parametrize(("root", "tip"), [("base", "none"), ("lower", "base"), ("pad", "lower")])
def test_unconnected_links_are_an_error(write, root, tip):
    path = write(ARM)
    with pytest.raises(RobotDescriptionError) as caught:
        RobotXml(path).joints_between(root, tip)
    assert caught.value.where == path


def test_a_loop_of_joints_is_an_error(write):
    loop = ARM.replace('<parent link="base"/>', '<parent link="lower"/>')
    with pytest.raises(RobotDescriptionError):
        RobotXml(write(loop)).joints_between("base", "lower")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("</robot>", ""),
        ('<child link="pad"/>', ""),
        ('<child link="pad"/>', "<child/>"),
        ('xyz="1 2 3"', 'xyz="1 2"'),
        ('xyz="1 2 3"', 'xyz="1 2 3m"'),
        ('xyz="1 2 3"', 'xyz="1 2 inf"'),
        ('upper="0.5"', 'upper="abc"'),
        ('<axis xyz="0 -1 0"/>', '<axis xyz="0 0 0"/>'),
        ('name="wrist" ', ""),
    ],
)
def test_a_malformed_file_is_an_error(write, old, new):
    assert old in ARM
    path = write(ARM.replace(old, new))
    with pytest.raises(RobotDescriptionError) as caught:
        read_joints(path, "base", "lower")
    assert caught.value.where == path
    assert str(caught.value.expected)
    assert str(caught.value.found)
    assert caught.value.fix
