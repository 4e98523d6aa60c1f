import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from robocas_ms3.assets.kinematics import joint_frame, joint_motion, link_poses
from robocas_ms3.assets.manifest import Joint, Link


def link(name, joint, parent=""):
    return Link(name=name, parent=parent, joint=joint, mass=1, center_of_mass=(0, 0, 0), inertia=(1, 1, 1))


DOOR = Joint(name="hinge", kind="revolute", axis=(0, 0, 1), origin=(1, 2, 0), limits=(0, 2), friction=0.1, damping=0.1)
DRAWER = Joint(name="slide", kind="prismatic", axis=(0, 1, 0), limits=(0, 0.4), friction=0.1, damping=0.1)


def test_a_door_turns_about_its_hinge():
    moved = joint_motion(DOOR, np.pi / 2) @ [2, 2, 5, 1]  # one metre along x from the hinge
    np.testing.assert_allclose(moved, [1, 3, 5, 1], atol=1e-12)
    np.testing.assert_allclose(joint_motion(DOOR, 0.7) @ [1, 2, 0, 1], [1, 2, 0, 1], atol=1e-12)


def test_a_drawer_in_a_door_moves_with_it():
    poses = link_poses([link("door", DOOR), link("drawer", DRAWER, "door")], {"hinge": np.pi / 2, "slide": 0.3})
    # slid to y = 0.3 in the door's frame, then turned a quarter about (1, 2): y points to -x
    np.testing.assert_allclose(poses["drawer"] @ [1, 2, 0, 1], [0.7, 2, 0, 1], atol=1e-12)
    np.testing.assert_allclose(link_poses([link("door", DOOR)], {})["door"], np.eye(4))


@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda axis: np.linalg.norm(axis) > 0.1))
def test_a_joints_frame_has_x_along_the_axis(axis):
    axis = np.array(axis) / np.linalg.norm(axis)
    joint = DOOR.model_copy(update={"axis": tuple(axis)})
    frame = joint_frame(joint)
    np.testing.assert_allclose(frame[:3, 0], axis, atol=1e-9)
    np.testing.assert_allclose(frame[:3, :3] @ frame[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(frame[:3, :3]) > 0.99
    np.testing.assert_allclose(frame[:3, 3], [1, 2, 0])
