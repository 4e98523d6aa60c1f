import numpy as np

from asset_tools.quality import grasp_hold
from asset_tools.quality.grasp_hold import run_hold_test


def grasps(*places):
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    return poses


CENTRE = (0, 0, 0)


def test_a_grasp_next_to_the_object_does_not_hold(block):
    # 5 cm beyond its edge, and 5 cm above it, in front of the tips
    found = run_hold_test(block(0.05, 0.05, 0.05), grasps((0.075, 0, 0), (0, 0, -0.075), CENTRE))
    assert found.tolist() == [False, False, True]


def test_a_heavy_block_slips_through(block):
    # Fingers press with 1000 N/m * (25 + 10) mm = 35 N each, so they carry 2 * 0.99 * 35 N = 69 N: 7 kg at rest, less
    # than 5 kg while shaken with 6 m/s2.
    assert run_hold_test(block(0.05, 0.05, 0.05, mass=1.0), grasps(CENTRE)).all()
    assert not run_hold_test(block(0.05, 0.05, 0.05, mass=5.0), grasps(CENTRE)).any()


def test_a_long_bar_held_by_its_end_turns(block):
    # 0.5 kg at 12 cm: 0.6 N m about pads that are 18 mm wide
    bar = block(0.3, 0.03, 0.03, mass=0.5)
    assert run_hold_test(bar, grasps(CENTRE, (0.12, 0, 0))).tolist() == [True, False]


def test_grasps_are_tested_independently(block):
    solid, both = block(0.06, 0.05, 0.05), grasps(CENTRE, (0.02, 0, 0.01), (0.09, 0, 0), (-0.02, 0, 0))
    together = run_hold_test(solid, both)
    assert together.tolist() == [run_hold_test(solid, grasp[None])[0] for grasp in both]
    assert together.tolist() == run_hold_test(solid, both).tolist()
    assert run_hold_test(solid, both[:0]).shape == (0,)


def test_a_slippery_block_slips_through(block, monkeypatch):
    # With slippery fingers as well (the engine takes the mean of both), 2 * 0.05 * 35 N = 3.5 N carry 0.36 kg at rest.
    assert run_hold_test(block(0.05, 0.05, 0.05, mass=0.5), grasps(CENTRE)).all()
    monkeypatch.setattr(grasp_hold, "FINGER_FRICTION", 0.05)
    assert not run_hold_test(block(0.05, 0.05, 0.05, mass=0.5, friction=0.05), grasps(CENTRE)).any()
