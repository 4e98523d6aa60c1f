import json

import h5py
import numpy as np
import pytest
from synthetic import STEPS, make_states, write_trajectory

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.demos.recordings.trajectory_file import TrajectoryFile

UID = "robocas_mobile_panda"


@pytest.fixture
def own(tmp_path):
    return write_trajectory(tmp_path / "F.h5", seeds=(3,))


def edit_json(path, change):
    file = path.with_suffix(".json")
    data = json.loads(file.read_text())
    change(data)
    file.write_text(json.dumps(data))


def test_written_episode_is_read(tmp_path):
    with TrajectoryFile(write_trajectory(tmp_path / "F.h5", seeds=(3, 4, 5))) as file:
        assert file.control_freq == 20
        recording, alone = file.read_recording(1), file.read_recording(1, bodies=False)
    assert (recording.seed, recording.control_steps, recording.control_mode) == (4, STEPS, "pd_joint_pos")
    assert recording.instruction == "grasp the cube 4 on the table and move it to the basket"
    assert [(g.first, g.last) for g in recording.subgoals] == [(0, 11), (12, 21)]
    states = make_states(4)
    np.testing.assert_array_equal(recording.state(7)["actors"]["object_1"], states["actors"]["object_1"][7:8])
    motion = recording.compute_motion(np.array([0, STEPS]))
    robot = states["articulations"][UID]
    np.testing.assert_array_equal(motion.qpos, robot[[0, STEPS], 13:25])
    np.testing.assert_array_equal(motion.qvel, robot[[0, STEPS], 25:])
    # The root is turned by 90 deg: its x axis is the world's y.
    np.testing.assert_allclose(motion.root_in_world[0, :3, 0], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(motion.root_in_world[0, :3, 3], [0.7, 0.15, 0], atol=1e-6)
    assert alone.states["actors"] == {}
    np.testing.assert_array_equal(motion.actions, alone.compute_motion(np.array([0, STEPS])).actions)


def test_reconfigure_is_a_reset_option(own):
    edit_json(own, lambda data: data["episodes"][0].update(reset_kwargs={"options": {"reconfigure": True}}))
    with TrajectoryFile(own) as file:
        assert file.read_entry(0).reset_options == {"reconfigure": True}


def fails(path, *words):
    with pytest.raises(DatasetError) as caught, TrajectoryFile(path) as file:
        file.read_recording(0)
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words)


def test_missing_or_truncated_files_are_errors(tmp_path, own):
    fails(tmp_path / "G.h5", "G.h5: no such trajectory file")
    data, json_file = own.read_bytes(), own.with_suffix(".json")
    for share, found in ((0.5, f"{len(data) // 2} of {len(data)} bytes"), (0, "F.h5")):
        own.write_bytes(data[: int(len(data) * share)])
        fails(own, "F.h5", found, "again")
    (tmp_path / "alone.h5").write_bytes(data[: len(data) // 2])
    fails(tmp_path / "alone.h5", "alone.h5", "not a readable HDF5 file")
    own.write_bytes(data)
    for text, word in (('{"env_info": ', "again"), ("[]", "")):
        json_file.write_text(text)
        fails(own, "F.json", word)
    json_file.unlink()
    fails(own, "F.json: missing JSON file of the trajectory")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data.pop("robocas"), "replayed files do not have them"),
        (lambda data: data["robocas"].update(control_freq=0), "control_freq"),
        (lambda data: data["episodes"].append({**data["episodes"][0], "episode_id": 1}), "different episodes"),
        (lambda data: data["episodes"][0].update(elapsed_steps=21), "expected 21 actions as in the JSON, found 22"),
        (lambda data: data["episodes"][0]["robocas"].pop("subgoals"), "robocas.subgoals"),
    ],
)
def test_inconsistent_json_is_an_error(own, change, words):
    edit_json(own, change)
    fails(own, words)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"episode_seed": "3"}, "episode_seed"),
        ({"episode_seed": 2**32}, "episode_seed"),
        ({"episode_seed": [3, 4]}, "episode_seed"),
        ({"reset_kwargs": {"options": {"reset_to_env_states": {}}}}, "reset_kwargs.options"),
        ({"reset_kwargs": {"options": {"reconfigure": "yes"}}}, "reset_kwargs.options.reconfigure"),
        ({"control_mode": 3}, "control_mode"),
        ({"elapsed_steps": -1}, "elapsed_steps"),
    ],
)
def test_entries_may_set_seed_and_reconfigure_only(own, change, key):
    edit_json(own, lambda data: data["episodes"][0].update(change))
    fails(own, "traj_0: invalid episode entry: ", key)


@pytest.mark.parametrize("values", [np.zeros(23, np.float32), np.array([b"x"] * 23), np.float32(1)])
@pytest.mark.parametrize("name", ["actors/object_1", f"articulations/{UID}"])
def test_states_of_wrong_shape_or_type_are_errors(own, name, values):
    with h5py.File(own, "a") as file:
        del file[f"traj_0/env_states/{name}"]
        file[f"traj_0/env_states/{name}"] = values
    fails(own, "damaged episode")


def test_missing_states_or_states_of_another_robot_are_errors(own):
    with h5py.File(own, "a") as file:
        file.move(f"traj_0/env_states/articulations/{UID}", "traj_0/env_states/articulations/panda_wristcam")
    fails(own, f"expected {UID} with 37 numbers per state, found ['panda_wristcam']")
    with h5py.File(own, "a") as file:
        del file["traj_0/env_states"]
    fails(own, "damaged episode")
