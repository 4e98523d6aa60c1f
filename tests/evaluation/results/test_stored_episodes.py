"""Actions of a result are stored per episode, and read with checks."""

from __future__ import annotations

import hashlib
import struct
import zipfile

import numpy as np
import pytest
from counting_env import CountingEnv, run_policy
from synthetic_results import actions_of, outcome, write

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.policy import EpisodeSpec, PolicySpec
from robocas_ms3.evaluation.results.outcomes import NO_CHECKPOINTS, Checkpoints
from robocas_ms3.evaluation.results.result_files import read_result
from robocas_ms3.evaluation.results.stored_episodes import (
    delete_other_episodes,
    find_actions_file,
    find_checkpoints_file,
    hash_actions,
    read_actions,
    read_checkpoints,
    write_actions,
    write_checkpoints,
)

TWO = np.array([[1, 2, 3], [4, 5, 6.5]], np.float32)


def test_hash_is_that_of_the_little_endian_rows():
    expected = hashlib.sha256(struct.pack("<6f", 1, 2, 3, 4, 5, 6.5)).hexdigest()
    assert hash_actions(TWO) == hash_actions(TWO.astype(">f4")) == hash_actions(np.asfortranarray(TWO)) == expected
    assert hash_actions(np.zeros((0, 7), np.float32)) == hashlib.sha256(b"").hexdigest()


def test_equal_actions_give_equal_bytes_whatever_their_memory_layout(tmp_path):
    for name, actions in (("a", TWO), ("b", np.asfortranarray(TWO))):
        write_actions(tmp_path / name, 12, actions)
    first, second = (tmp_path / name / "actions" / "000012.npz" for name in "ab")
    assert first.read_bytes() == second.read_bytes()
    with np.load(first) as file:
        assert file["actions"].dtype == np.float32 and (file["actions"] == TWO).all()


@pytest.mark.parametrize("steps", [0, 70])
def test_actions_that_were_written_are_read(tmp_path, steps):
    one = outcome(3, steps=steps)
    write_actions(tmp_path, 3, actions_of(one))
    read = read_actions(tmp_path, one, 7)
    assert read.dtype == np.float32 and read.shape == (steps, 7) and (read == actions_of(one)).all()


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.unlink(),
        lambda path: path.write_bytes(path.read_bytes()[:100]),
        lambda path: path.write_bytes(b""),
        lambda path: np.savez(path, other=np.zeros((70, 7), np.float32)),
        lambda path: np.savez(path, actions=np.zeros((70, 7))),  # float64
        lambda path: np.savez(path, actions=np.zeros((69, 7), np.float32)),
        lambda path: np.savez(path, actions=np.zeros((70, 8), np.float32)),
        lambda path: np.savez(path, actions=np.ones((70, 7), np.float32)),  # another hash
        lambda path: np.savez(path, actions=np.full((70, 7), np.nan, np.float32)),
        lambda path: np.savez(path, actions=np.array([[None]])),  # pickled objects
        lambda path: np.savez_compressed(path, actions=np.zeros(10**7, np.float32)),  # 40 MB in 40 kB
    ],
)
def test_missing_damaged_or_other_actions_are_an_error_with_the_path(tmp_path, damage):
    write_actions(tmp_path, 0, actions_of(outcome(0)))
    path = find_actions_file(tmp_path, 0)
    damage(path)
    with pytest.raises(EvaluationError) as error:
        read_actions(tmp_path, outcome(0), 7)
    assert error.value.where == path and error.value.fix


TWO_STATES = Checkpoints(np.array([5, 7], np.int32), np.array([[1, 2], [3, 4.5]], np.float32))


def test_checkpoints_that_were_written_are_read(tmp_path):
    assert len(read_checkpoints(tmp_path, outcome(0, steps=7)).steps) == 0  # no file
    write_checkpoints(tmp_path, 0, NO_CHECKPOINTS)
    assert not find_checkpoints_file(tmp_path, 0).exists()
    write_checkpoints(tmp_path, 0, TWO_STATES)
    read = read_checkpoints(tmp_path, outcome(0, steps=7))
    assert read.steps.tolist() == [5, 7] and read.states.tolist() == [[1, 2], [3, 4.5]]
    assert (read.steps.dtype, read.states.dtype) == (np.int32, np.float32)


@pytest.mark.parametrize(
    "changes",
    [
        {"steps": np.array([5, 8], np.int32)},  # not the last step
        {"steps": np.array([7, 7], np.int32)},
        {"steps": np.array([0, 7], np.int32)},
        {"steps": np.array([5.0, 7.0])},
        {"steps": np.array(7, np.int32)},
        {"states": np.zeros((3, 2), np.float32)},
        {"states": np.zeros((2, 2))},
        {"states": np.full((2, 2), np.nan, np.float32)},
        {"states": np.zeros(2, np.float32)},
    ],
)
def test_invalid_checkpoints_are_an_error_with_the_path(tmp_path, changes):
    path = find_checkpoints_file(tmp_path, 0)
    path.parent.mkdir()
    np.savez(path, **(TWO_STATES._asdict() | changes))
    with pytest.raises(EvaluationError) as error:
        read_checkpoints(tmp_path, outcome(0, steps=7))
    assert error.value.where == path and error.value.fix
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(EvaluationError):
        read_checkpoints(tmp_path, outcome(0, steps=7))


def test_array_that_declares_a_huge_shape_is_an_error(tmp_path):
    write_actions(tmp_path, 0, actions_of(outcome(0)))
    path = find_actions_file(tmp_path, 0)
    header = b"\x93NUMPY\x01\x00\x76\x00" + str({"descr": "<f4", "fortran_order": False, "shape": (10**11, 7)}).encode()
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("actions.npy", header.ljust(127) + b"\n")
    with pytest.raises(EvaluationError):
        read_actions(tmp_path, outcome(0), 7)


def test_actions_of_other_episodes_are_deleted_and_other_files_stay(tmp_path):
    for number in (0, 1, 1234567):
        write_actions(tmp_path, number, TWO)
    (tmp_path / "actions" / "notes.npz").touch()
    delete_other_episodes(tmp_path, {1: outcome(1)})
    assert sorted(path.name for path in tmp_path.glob("actions/*")) == ["000001.npz", "notes.npz"]
    delete_other_episodes(tmp_path / "missing", {})


def test_result_reads_the_actions_in_the_convention_of_its_policy(tmp_path):
    write(tmp_path / "a", [outcome(0)])
    write(tmp_path / "b", [outcome(1)])
    both = read_result(tmp_path / "a", tmp_path / "b")
    assert [both.read_actions(number)[0, 0] for number in (0, 1)] == [0, 1]
    for convention in ("joint_positions", "unknown", ["robocas"]):
        policy = {"name": "mine", "spec": {"convention": convention}}
        with pytest.raises(EvaluationError):  # 8 numbers per action; no such convention
            write(tmp_path / str(convention), [outcome(0)], policy=policy).read_actions(0)


class ChunkPolicy:
    """Policy with chunks of four actions, whose first numbers count up from 1; NaN in a chunk that starts at `nan`."""

    spec = PolicySpec()

    def __init__(self, nan: int = -1) -> None:
        self.count, self.nan = 0, nan

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        pass

    def act(self, observations) -> np.ndarray:
        actions = np.zeros((len(observations.envs), 4, 7))
        actions[..., 0] = self.count + np.arange(1, 5)
        actions[:, 3, 1] = np.nan if self.count == self.nan else 0
        self.count += 4
        return actions


@pytest.mark.parametrize(("max_steps", "nan", "first_numbers"), [(6, -1, [1, 2, 3, 4, 5, 6]), (9, 4, [1, 2, 3, 4])])
def test_only_executed_actions_are_recorded(max_steps, nan, first_numbers):
    """The rest of a chunk is not executed at the end of an episode, and no action of a chunk with NaN is."""
    start = EpisodeSpec(-1, 0, "pick", "", "", "", 0, "")
    (ended,) = run_policy(CountingEnv(1, goal=100.0), ChunkPolicy(nan), [start], max_steps)
    assert [action[0] for action in ended.actions] == first_numbers
    assert ended.steps == len(first_numbers)
