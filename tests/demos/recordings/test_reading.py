import json
import re

import h5py
import numpy as np
import pytest
from synthetic import STEPS, make_states, write_trajectory

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.demos.recordings.reading import TrajectoryFile


@pytest.fixture
def own(tmp_path):
    return write_trajectory(tmp_path / "F.h5", seeds=(3,))


@pytest.fixture
def trajectory(tmp_path):
    return write_trajectory(tmp_path / "F.h5", seeds=(3, 4, 5))


def edit_json(path, change):
    file = path.with_suffix(".json")
    data = json.loads(file.read_text())
    change(data)
    file.write_text(json.dumps(data))


def test_what_was_written_is_read(trajectory):
    with TrajectoryFile(trajectory) as file:
        assert file.control_freq == 20
        recording = file.recording(1)
    assert (recording.seed, recording.control_steps, recording.control_mode) == (4, STEPS, "pd_joint_pos")
    assert recording.instruction == "grasp the cube 4 on the table and move it to the basket"
    assert [(g.first, g.last) for g in recording.subgoals] == [(0, 11), (12, 21)]
    states = make_states(4)
    np.testing.assert_array_equal(recording.state(7)["actors"]["object_1"], states["actors"]["object_1"][7:8])
    motion = recording.motion(np.array([0, STEPS]))
    robot = states["articulations"]["robocas_mobile_panda"]
    np.testing.assert_array_equal(motion.qpos, robot[[0, STEPS], 13:25])
    np.testing.assert_array_equal(motion.qvel, robot[[0, STEPS], 25:])
    # The root is turned by 90 deg: its x axis is the world's y.
    np.testing.assert_allclose(motion.root_in_world[0, :3, 0], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(motion.root_in_world[0, :3, 3], [0.7, 0.15, 0], atol=1e-6)


def fails(path, match):
    with pytest.raises(DatasetError, match=match) as caught, TrajectoryFile(path) as file:
        file.recording(0)
    assert "\n" not in str(caught.value)


def test_missing_files(tmp_path, own):
    fails(tmp_path / "G.h5", "G.h5: no such trajectory file")
    own.with_suffix(".json").unlink()
    fails(own, "F.json: the JSON that belongs to this trajectory is missing")


@pytest.mark.parametrize("share", [0.5, 0])
def test_a_file_cut_off(own, share):
    data = own.read_bytes()
    own.write_bytes(data[: int(len(data) * share)])
    fails(own, "cut off, damaged, or no HDF5")


def test_not_json(own):
    own.with_suffix(".json").write_text('{"env_info": ')
    fails(own, "not a trajectory's JSON")
    own.with_suffix(".json").write_text("[]")
    fails(own, "not a trajectory's JSON")


def test_a_replay_lacks_the_instructions(own):
    edit_json(own, lambda data: data.pop("robocas"))
    fails(own, "replays of it drop them")


def test_json_of_another_file(own):
    edit_json(own, lambda data: data["episodes"].append(dict(data["episodes"][0], episode_id=1)))
    fails(own, "HDF5 and JSON do not list the same episodes")


def test_lengths_that_differ(own):
    edit_json(own, lambda data: data["episodes"][0].update(elapsed_steps=21))
    fails(own, "expected 21 actions, as the JSON says, found 22")


def test_incomplete_entries(own):
    edit_json(own, lambda data: data["episodes"][0]["robocas"].pop("subgoals"))
    fails(own, "robocas.subgoals")


def test_another_robot(own):
    with h5py.File(own, "a") as file:
        file.move(
            "traj_0/env_states/articulations/robocas_mobile_panda", "traj_0/env_states/articulations/panda_wristcam"
        )
    fails(own, "expected robocas_mobile_panda of 37 numbers, found .'panda_wristcam'.")


def test_an_episode_without_states(own):
    with h5py.File(own, "a") as file:
        del file["traj_0/env_states"]
    fails(own, "this episode is damaged")


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"episode_seed": "3"}, "episode_seed"),
        ({"episode_seed": 2**32}, "episode_seed"),
        ({"episode_seed": [3, 4]}, "episode_seed"),
        ({"reset_kwargs": {"options": {"reset_to_env_states": {}}}}, "reset_kwargs.options"),
        ({"reset_kwargs": {"options": {"reconfigure": "yes"}}}, "reset_kwargs.options.reconfigure"),
        ({"elapsed_steps": 2.0}, "elapsed_steps"),
        *(
            ({"robocas": {"instruction": "pick", "subgoals": goals}}, "robocas.subgoals")
            for goals in (3, [{"goal_type": "a", "goal_description": "b", "goal_range": [0.0, 21]}])
        ),
    ],
)
def test_entries_that_are_wrong(own, change, key):
    edit_json(own, lambda data: data["episodes"][0].update(change))
    fails(own, rf"traj_0: the JSON's entry: .*{re.escape(key)}")


@pytest.mark.parametrize("freq", [0, "20"])
def test_a_frequency_that_is_none(own, freq):
    edit_json(own, lambda data: data["robocas"].update(control_freq=freq))
    fails(own, "control_freq")


def test_reconfiguring_is_an_option(own):
    edit_json(own, lambda data: data["episodes"][0].update(reset_kwargs={"options": {"reconfigure": True}}))
    with TrajectoryFile(own) as file:
        assert file.entry(0).reset_options == {"reconfigure": True}


def test_the_robot_alone(own):
    with TrajectoryFile(own) as file:
        whole, alone = file.recording(0), file.recording(0, bodies=False)
    assert alone.states["actors"] == {}
    samples = np.array([0, 4, 22])
    np.testing.assert_array_equal(whole.motion(samples).actions, alone.motion(samples).actions)


@pytest.mark.parametrize("values", [np.zeros(23, np.float32), np.array([b"x"] * 23), np.float32(1)])
@pytest.mark.parametrize("name", ["actors/object_1", "articulations/robocas_mobile_panda"])
def test_states_that_are_no_rows_of_numbers(own, name, values):
    with h5py.File(own, "a") as file:
        del file[f"traj_0/env_states/{name}"]
        file[f"traj_0/env_states/{name}"] = values
    fails(own, "this episode is damaged")
