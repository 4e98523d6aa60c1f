"""Actions played without any correction: those of a demonstration succeed again, spoiled ones do not."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robocas_ms3.demos.episode import EpisodeGenerator, EpisodeSettings
from robocas_ms3.demos.open_loop import OpenLoop
from robocas_ms3.errors import DatasetError

pytestmark = pytest.mark.slow
SEED = 2


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """What the generator's own trial is given, and what it found."""
    generator = EpisodeGenerator(EpisodeSettings("pick", "pick_table_scattered", "builtin"))
    assert generator.open_loop is not None
    play, calls = generator.open_loop.play_recording, []

    def listening(*args):
        calls.append((args, play(*args)))
        return calls[-1][1]

    generator.open_loop.play_recording = listening
    result = generator.generate(SEED, tmp_path_factory.mktemp("recorded"), "one")
    assert result.success
    assert [args[4] is None for args, _ in calls] == [True, False]
    (args, played), *_ = calls
    yield generator.open_loop, args[:4], played
    generator.close()


def test_a_demonstrations_own_actions_succeed_again(recorded):
    _, (seed, tcp_in_base, gripper, control_freq), played = recorded
    assert (seed, control_freq, len(tcp_in_base)) == (SEED, 20, len(gripper) + 1)
    assert played.success
    assert played.clipped == 0
    samples = [*range(0, len(gripper), 4), len(gripper)]
    error = np.linalg.norm(played.tcp_in_base - tcp_in_base[samples, :3, 3], axis=1)
    assert error.mean() < 0.002
    assert error.max() < 0.02


def test_noise_moves_the_tcp_a_little(recorded):
    open_loop, args, played = recorded
    noisy = open_loop.play_recording(*args, np.random.default_rng(0))
    difference = np.abs(noisy.tcp_in_base - played.tcp_in_base)[:20]  # before anything is touched
    assert 1e-6 < difference.max() < 3e-4
    again = open_loop.play_recording(*args, np.random.default_rng(0))
    np.testing.assert_array_equal(noisy.tcp_in_base, again.tcp_in_base)


def test_with_an_open_gripper_they_do_not(recorded):
    open_loop, (seed, tcp_in_base, gripper, control_freq), _ = recorded
    assert not open_loop.play_recording(seed, tcp_in_base, np.ones_like(gripper), control_freq).success


def test_beside_the_object_they_do_not(recorded):
    open_loop, (seed, tcp_in_base, gripper, control_freq), _ = recorded
    shifted = tcp_in_base.copy()
    shifted[8:, 0, 3] += 0.1
    assert not open_loop.play_recording(seed, shifted, gripper, control_freq).success


def test_motion_beyond_a_step_is_counted(recorded):
    open_loop, (seed, *_), _ = recorded
    open_loop.reset(seed)
    assert len(open_loop.layout.object_ids) == 10
    turns = Rotation.from_euler("xyz", [[0, 0, 0], [0, 0, 0], [0.4, 0, 0.4]])  # the last: 0.57 rad in one step
    played = open_loop.play(np.array([[0, 0, -0.15], [0, 0, 0.01], [0, 0, 0]]), turns, np.ones(3, bool))
    assert played.clipped == 2
    assert not played.success


@pytest.mark.parametrize("rate", [0, 2.5, 7])
def test_rates_that_physics_does_not_know(rate):
    with pytest.raises(DatasetError, match="can't be played at this rate"):
        OpenLoop({"env_id": "robocas_ms3:RoboCASPick-v1", "env_kwargs": {}}, rate)
