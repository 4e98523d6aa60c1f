"""Random appearance: seeded, within bounds, with independent parts."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.scenes.config import TaskConfig, load_task_config
from robocas_ms3.scenes.config.randomisation import CameraRandomisation
from robocas_ms3.scenes.randomise import draw_camera_shift, draw_finishes, draw_lights


def config(**blocks) -> TaskConfig:
    data = load_task_config("pick_table_scattered").model_dump(mode="json")
    return load_task_config({**data, "randomisation": blocks})


def test_nothing_is_random_without_randomisation():
    plain = config()
    room = load_pack("builtin").furniture["room"]
    for seed in range(5):
        assert draw_finishes(plain, room, seed) == {}
        lights = draw_lights(plain, seed)
        assert (lights.ambient, lights.directional) == (plain.lights.ambient, plain.lights.directional)
        np.testing.assert_allclose(lights.direction * np.linalg.norm(plain.lights.direction), plain.lights.direction)


def test_finishes_may_be_restricted_to_some():
    room = load_pack("builtin").furniture["room"]
    asked = config(room=["floor", "wall"], finishes={"floor": ["carpet", "checker"]})
    drawn = [draw_finishes(asked, room, seed) for seed in range(40)]
    assert {d["floor"] for d in drawn} == {"carpet", "checker"}
    assert {d["wall"] for d in drawn} == set(room.asset.finishes["wall"])


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**31 - 1))
def test_lights_stay_within_bounds(seed):
    asked = config(lights={"ambient": [0.2, 0.3], "directional": [1.0, 1.5], "direction_deg": 10.0})
    lights = draw_lights(asked, seed)
    assert 0.2 <= lights.ambient <= 0.3
    assert 1.0 <= lights.directional <= 1.5
    straight = np.array(asked.lights.direction) / np.linalg.norm(asked.lights.direction)
    assert np.rad2deg(np.arccos(np.clip(lights.direction @ straight, -1, 1))) <= 10 + 1e-6


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**31 - 1), camera=st.integers(0, 2))
def test_camera_shifts_are_rigid_and_small(seed, camera):
    shift = draw_camera_shift(CameraRandomisation(position=0.02, rotation_deg=3), camera, seed)
    np.testing.assert_allclose(shift[:3, :3] @ shift[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.abs(shift[:3, 3]).max() <= 0.02
    angle = np.arccos(np.clip((np.trace(shift[:3, :3]) - 1) / 2, -1, 1))
    assert np.rad2deg(angle) <= 3 * np.sqrt(3) + 1e-6
    assert not np.allclose(shift, draw_camera_shift(CameraRandomisation(), camera + 1, seed))


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**31 - 1))
def test_camera_shifts_exceed_the_minimum_in_both_directions(seed):
    far = CameraRandomisation(position=0.1, rotation_deg=8, min_position=0.05, min_rotation_deg=4)
    shift, near = draw_camera_shift(far, 1, seed), draw_camera_shift(CameraRandomisation(position=0.1), 1, seed)
    assert (np.abs(shift[:3, 3]) >= 0.05).all()
    assert (np.abs(shift[:3, 3]) <= 0.1).all()
    np.testing.assert_array_equal(np.sign(shift[:3, 3]), np.sign(near[:3, 3]))
    angles = Rotation.from_matrix(shift[:3, :3]).as_euler("xyz", degrees=True)
    assert (np.abs(angles) >= 4 - 1e-9).all()
    assert (np.abs(angles) <= 8 + 1e-9).all()
