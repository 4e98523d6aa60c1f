"""Noise of the executed actions: size, determinism, and the lag of the drives."""

from __future__ import annotations

import numpy as np
import pytest
from planning_scenes import REST
from scipy.spatial.transform import Rotation

from robocas_ms3.planning.action_noise import ActionNoise, draw_noise
from robocas_ms3.planning.kinematics import ArmChain
from robocas_ms3.robots.description import MOBILE_PANDA

LAG = 0.07  # s
STD = (3.0, 1.0)  # mm, deg


@pytest.fixture(scope="module")
def chain(panda_files) -> ArmChain:
    return ArmChain(panda_files.arm_urdf, MOBILE_PANDA)


def run(noise: ActionNoise, steps: int, seed: int = 5, qpos=REST):
    """Return the offsets of the joint targets and the deviations, (steps, 7) each, of an arm that holds a position."""
    targets, deviations = zip(*(noise.disturb(seed, index, qpos) for index in range(steps)), strict=True)
    return np.array(targets) - qpos, np.array(deviations)


def test_drawn_noise_has_the_requested_standard_deviations():
    drawn = draw_noise(np.random.default_rng(0), 20_000, 2.0, 0.5)
    np.testing.assert_allclose(drawn[:, :3].std(axis=0), 0.002, rtol=0.02)
    np.testing.assert_allclose(drawn[:, 3:6].std(axis=0), np.deg2rad(0.5), rtol=0.02)
    assert not drawn[:, 6].any()


def test_tcp_deviates_by_the_requested_noise_at_the_end_of_each_dataset_step(chain):
    _, deviations = run(ActionNoise(chain, STD, 20, LAG), 4 * 500)
    at_rest, reached = chain.tcp(REST[None]), chain.tcp(REST + deviations[3::4])
    shift = np.einsum("ij,ni->nj", at_rest[0, :3, :3], reached[:, :3, 3] - at_rest[:, :3, 3])
    turn = Rotation.from_matrix(np.swapaxes(at_rest[:, :3, :3], 1, 2) @ reached[:, :3, :3]).as_rotvec(degrees=True)
    np.testing.assert_allclose(1000 * shift.std(axis=0), 3.0, rtol=0.1)
    np.testing.assert_allclose(turn.std(axis=0), 1.0, rtol=0.1)
    following = [np.corrcoef(shift[:-1, axis], shift[1:, axis])[0, 1] for axis in range(3)]
    assert np.abs(following).max() < 0.15  # independent from step to step


def test_noise_depends_on_seed_and_step_only(chain):
    noise = ActionNoise(chain, STD, 20, LAG)
    first, _ = run(noise, 9)
    noise.reset()
    again, _ = run(noise, 9)  # an attempt that is undone
    np.testing.assert_array_equal(first, again)
    other, _ = run(ActionNoise(chain, STD, 20, LAG), 9, seed=6)
    assert np.abs(first - other).min() > 0


def test_deviation_follows_the_targets_as_a_first_order_system(chain):
    """Compare with a numerical integration: the rate is the distance to the target, divided by the lag."""
    offsets, deviations = run(ActionNoise(chain, STD, 20, LAG), 8)
    fine, value, expected = 1000, np.zeros(7), []
    for start, end in zip(np.vstack([np.zeros(7), offsets]), offsets, strict=False):
        for part in np.linspace(start, end, fine + 1)[1:]:
            value = value + (part - value) * 0.05 / fine / LAG
        expected.append(value)
    np.testing.assert_allclose(deviations, expected, atol=1e-4)


def test_control_rates_below_or_between_multiples_of_the_rate_have_one_error_per_control_step(chain):
    for control_freq in (2, 5):
        _, deviations = run(ActionNoise(chain, STD, control_freq, LAG), 200)
        assert np.corrcoef(deviations[:-1, 0], deviations[1:, 0])[0, 1] < 0.2


def test_noise_is_finite_at_a_singularity(chain):
    """A stretched arm can't follow errors along its axis."""
    offsets, _ = run(ActionNoise(chain, STD, 20, LAG), 200, qpos=np.zeros(7))
    assert np.abs(offsets).max() < 0.3
