import numpy as np
import pytest

from robocas_ms3.planning.skills.place import ContainerInterior, compute_overhang, sample_poses_above_container

CONTAINER = np.array([[0, -1, 0, 0.6], [1, 0, 0, 0.2], [0, 0, 1, 0.1], [0, 0, 0, 1.0]])  # turned by 90 degrees
INSIDE = ContainerInterior(CONTAINER, np.array([-0.2, -0.1, -0.1]), np.array([0.2, 0.1, 0.1]))
BOX = np.array([[x, y, z] for x in (-0.03, 0.03) for y in (-0.02, 0.02) for z in (-0.1, 0.1)]) + [0, 0, 0.05]


def drops():
    return sample_poses_above_container(np.random.default_rng(0), 200, INSIDE, BOX, np.array([0, 0, 0.05]))


def test_held_objects_are_above_the_container_clear_of_its_rim():
    poses = drops()
    rim = 0.1 + 0.1
    for pose in poses:
        world = BOX @ pose[:3, :3].T + pose[:3, 3]
        assert rim + 0.03 - 1e-9 <= world[:, 2].min() <= rim + 0.07 + 1e-9
        center = pose[:3, :3] @ [0, 0, 0.05] + pose[:3, 3]
        # the container's x is the base's y
        assert abs(center[0] - 0.6) <= 0.25 * 0.1 + 1e-9
        assert abs(center[1] - 0.2) <= 0.25 * 0.2 + 1e-9


def test_approach_points_down_and_tilts_away_from_the_arm():
    poses = drops()
    approach = poses[:, :3, 2]
    tilt = np.degrees(np.arccos(-approach[:, 2]))
    assert tilt.max() <= 70 + 1e-6
    assert tilt.min() < 5
    tilted = approach[tilt > 20]
    outward = np.array([0.6, 0.2]) / np.hypot(0.6, 0.2)
    assert (tilted[:, :2] @ outward > 0).all()
    assert np.linalg.det(poses[:, :3, :3]) == pytest.approx(np.ones(200))


def test_overhang_is_the_sideways_extent_beyond_the_opening():
    # straight down above the middle; the container's opening is 0.4 along the base's y, 0.2 along its x
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = [0.6, 0.2, 0.5]
    bar = np.array([[x, 0, 0] for x in (-0.15, 0.15)])
    turned = pose @ np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    assert compute_overhang(np.stack([pose, turned]), INSIDE, bar) == pytest.approx([0.05, 0.0])
    assert compute_overhang(np.stack([pose, turned]), INSIDE, bar, 0.06) == pytest.approx([0.11, 0.01])
