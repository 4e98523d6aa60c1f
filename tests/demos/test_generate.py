"""End-to-end tests with the builtin pack: generation, recordings, determinism, resume, replay."""

import hashlib
import json
import os
import signal
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from mani_skill.utils.gym_utils import find_max_episode_steps_value
from mani_skill.utils.structs import Pose

from robocas_ms3.core.errors import PlanningError, UnrecoverableError
from robocas_ms3.demos.forked_processes import ForkedProcess
from robocas_ms3.demos.generation import generate
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.demos.open_loop import OpenLoopChecks
from robocas_ms3.demos.recordings.trajectory_json import read_json
from robocas_ms3.demos.settings import EpisodeSettings, GenerateSettings, ReplaySettings
from robocas_ms3.demos.trajectory_replay import replay
from robocas_ms3.planning.executor import MotionExecutor
from robocas_ms3.planning.protocol import Trajectory
from robocas_ms3.robots.description import MOBILE_PANDA

pytestmark = pytest.mark.slow
PICK, SEARCH = EpisodeSettings("pick"), EpisodeSettings("search", "search_table_small_heap")
SEEDS = 2
SEARCH_SEED = 3
TOO_LONG = "episode", "too_long"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("demos") / "pick"
    return generate(GenerateSettings(PICK, out, episodes=SEEDS, jobs=0)), out


@pytest.fixture(scope="module")
def pick_generator():
    generator = EpisodeGenerator(PICK)
    yield generator
    generator.close()


@pytest.fixture(scope="module")
def search_generator():
    generator = EpisodeGenerator(SEARCH)
    yield generator
    generator.close()


def change(monkeypatch, generator, **settings):
    monkeypatch.setattr(generator, "settings", replace(generator.settings, **settings))


def load(path):
    with h5py.File(path) as file:
        return {
            name: {k: group[k][()] for k in ("actions", "success")} | {"states": state(group)}
            for name, group in file.items()
        }


def state(group) -> dict[str, np.ndarray]:
    found = {}
    group["env_states"].visititems(
        lambda name, item: found.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None
    )
    return found


def test_recording_has_maniskills_format_with_additional_keys(run):
    summary, out = run
    assert summary.episodes == SEEDS
    data = read_json(summary.trajectory)
    assert data["env_info"]["env_id"] == "robocas_ms3:RoboCASPick-v1"
    assert data["env_info"]["env_kwargs"]["config"] == "pick_table_scattered"
    assert "render_backend" not in data["env_info"]["env_kwargs"]
    assert data["robocas"]["control_freq"] == 20
    assert data["robocas"]["versions"]["numpy"] == np.__version__
    episodes = load(summary.trajectory)
    for episode in data["episodes"]:
        recorded = episodes[f"traj_{episode['episode_id']}"]
        extra = episode["robocas"]
        assert episode["success"] is True
        assert recorded["success"][-1]
        assert len(recorded["actions"]) == episode["elapsed_steps"]
        assert extra["target"]["name"] in extra["instruction"]
        ranges = [goal["goal_range"] for goal in extra["subgoals"]]
        assert [goal["goal_type"] for goal in extra["subgoals"]] == ["move and grasp", "transfer object"]
        assert ranges[0][0] == 0
        assert ranges[0][1] + 1 == ranges[1][0]
        assert ranges[1][1] == episode["elapsed_steps"] - 1
    assert not (out / "episodes").exists()


def test_motion_respects_the_limits_of_the_robot(run):
    for episode in load(run[0].trajectory).values():
        arm = episode["actions"][:, :7]
        speed = np.abs(np.diff(arm, axis=0)) * 20
        assert speed.max() <= 0.5 + 1e-3
        qpos = episode["states"]["articulations/robocas_mobile_panda"][:, 13:25][:, MOBILE_PANDA.arm_slice]
        assert np.abs(np.diff(qpos, axis=0)).max() * 20 <= 1.0  # no jump of the arm itself
        still = (np.abs(np.diff(arm, axis=0)) < 1e-5).all(axis=1)
        longest = max((len(run) for run in "".join("s" if s else " " for s in still).split()), default=0)
        assert longest <= 10  # 0.5 s


def test_same_seed_gives_the_same_episode_bit_for_bit_and_a_run_is_resumed(run, pick_generator, tmp_path):
    summary, _ = run
    whole, last = load(summary.trajectory), read_json(summary.trajectory)["episodes"][-1]
    assert pick_generator.generate(last["episode_seed"], tmp_path, "again").success  # first here, last there
    again, recorded = load(tmp_path / "again.h5")["traj_0"], whole[f"traj_{last['episode_id']}"]
    assert np.array_equal(again["actions"], recorded["actions"])
    assert again["states"].keys() == recorded["states"].keys()
    for name, values in again["states"].items():
        assert np.array_equal(values, recorded["states"][name]), name
    for episodes in (1, 2):
        resumed = generate(GenerateSettings(PICK, tmp_path / "resumed", episodes=episodes, jobs=0))
    assert resumed.episodes == 2
    parts = load(resumed.trajectory)
    assert all(np.array_equal(whole[name]["actions"], parts[name]["actions"]) for name in ("traj_0", "traj_1"))


def test_action_replay_is_exact_and_ee_deltas_succeed(run):
    summary, _ = run
    assert [(r.success, r.state_error) for r in replay(ReplaySettings(summary.trajectory))] == [(True, 0.0)] * SEEDS
    assert all(r.success for r in replay(ReplaySettings(summary.trajectory, use_env_states=True, count=1)))
    assert all(r.success for r in replay(ReplaySettings(summary.trajectory, control_mode="pd_ee_delta_pose")))


def accept_all_attempts(monkeypatch):
    """Accept all attempts as successful, to test how attempts are kept or undone."""
    flag = MotionExecutor.is_flag_set
    monkeypatch.setattr(MotionExecutor, "is_flag_set", lambda self, name: name == "success" or flag(self, name))
    monkeypatch.setattr(OpenLoopChecks, "check", lambda *args, **how: None)


def waiting_policy(steps):
    """Return a policy that waits for a number of control steps per attempt and fails after negative numbers."""
    starts, numbers = [], iter(steps)

    def policy(arm):
        starts.append(len(arm.executor.actions))
        number = next(numbers)
        arm.executor.move_gripper(1.0, arm.qpos, seconds=abs(number) * arm.executor.dt)
        if number < 0:
            raise PlanningError("grasp", "missed")

    return policy, starts


@pytest.mark.parametrize(
    ("keep", "steps", "expected_starts"),
    [
        (False, [12, 10], [0, 0]),  # one step too many would be 11
        (True, [12, 10], [0, 0]),
        (True, [-2, 8, 4], None),  # kept, with the way out of it: then too long, and undone
        (True, [-12, 4], [0, 0]),  # failed, and too long for anything to follow
    ],
)
def test_attempt_beyond_the_horizon_is_undone(tmp_path, monkeypatch, pick_generator, keep, steps, expected_starts):
    change(monkeypatch, pick_generator, max_attempts=len(steps), keep_recoveries=keep)
    accept_all_attempts(monkeypatch)
    policy, starts = waiting_policy(steps)
    monkeypatch.setattr(pick_generator, "policy", policy)
    monkeypatch.setattr(pick_generator, "horizon", 10)
    result = pick_generator.generate(1, tmp_path, "timed")
    assert result.success
    assert starts[-1] == 0
    assert expected_starts is None or starts == expected_starts
    too_long = [failure.attempt for failure in result.failures if (failure.stage, failure.reason) == TOO_LONG]
    assert too_long == [i for i, number in enumerate(steps[:-1]) if number > 0]
    data = read_json(tmp_path / "timed.h5")["episodes"][0]
    assert data["elapsed_steps"] == result.steps == steps[-1]
    assert data["robocas"]["recoveries"] == []


def test_horizon_at_another_rate_equals_that_of_the_environment():
    generator = EpisodeGenerator(replace(PICK, control_freq=5))
    assert find_max_episode_steps_value(generator.env) == generator.horizon == 200
    generator.close()


def test_finished_policy_without_success_is_a_failed_attempt(tmp_path, monkeypatch, pick_generator):
    change(monkeypatch, pick_generator, max_attempts=2)
    policy, starts = waiting_policy([3, 3])
    monkeypatch.setattr(pick_generator, "policy", policy)
    result = pick_generator.generate(1, tmp_path, "nothing")
    assert not result.success
    assert starts == [0, 0]
    assert [(failure.stage, failure.reason) for failure in result.failures] == [("episode", "no_success")] * 2
    assert not list(tmp_path.iterdir())


def stirring_policy(log):
    """Return a policy that stirs the heap before and after a backtracking point and fails at first; log states."""

    def stir(arm, steps):
        for _ in range(steps):
            arm.qpos = arm.qpos + np.eye(7)[1] * 0.06  # the shoulder: down into the heap
            arm.executor.follow(Trajectory(arm.qpos[None], arm.executor.dt))
            arm.executor.facts["stirred"] = len(arm.executor.actions)

    def policy(arm):
        stir(arm, 12)
        arm.add_backtracking_point()
        state = hashlib.sha256(arm.env.get_state().numpy().tobytes()).hexdigest()
        found = [state, arm.executor.facts["stirred"], len(arm.executor.actions), float(arm.rng.random())]
        with log.open("a") as file:
            file.write(json.dumps(found) + "\n")
        stir(arm, 6)
        if arm.decision_path == (0, 0):
            raise PlanningError("stir", "enough")

    return policy


@pytest.mark.parametrize("fork", [True, False])
def test_backtracking_to_a_decision_restores_the_state(tmp_path, monkeypatch, search_generator, fork):
    accept_all_attempts(monkeypatch)
    change(monkeypatch, search_generator, max_attempts=2)
    monkeypatch.setattr(search_generator, "_fork", fork)
    monkeypatch.setattr(search_generator, "policy", stirring_policy(tmp_path / "log"))
    result = search_generator.generate(1, tmp_path, "stirred")
    assert [(failure.stage, failure.reason) for failure in result.failures] == [("stir", "enough")]
    first, again = map(json.loads, (tmp_path / "log").read_text().splitlines())
    assert first[:3] == again[:3]  # the same state, bit for bit
    assert first[1:3] == [12, 12]
    assert first[3] != again[3]  # with other random numbers
    data = read_json(tmp_path / "stirred.h5")["episodes"][0]
    assert data["elapsed_steps"] == result.steps == 18
    assert data["robocas"]["attempts"] == result.attempts == 2
    assert len(load(tmp_path / "stirred.h5")["traj_0"]["actions"]) == 18


def test_search_with_and_without_fork_is_identical_and_replays_bit_for_bit(tmp_path, monkeypatch, search_generator):
    """This includes a forked process that is killed from outside while it continues."""
    send = ForkedProcess.send

    def send_and_kill_the_first(child, result):
        send(child, result)
        if not (tmp_path / "killed").exists():
            (tmp_path / "killed").touch()
            os.kill(child.pid, signal.SIGKILL)

    monkeypatch.setattr(ForkedProcess, "send", send_and_kill_the_first)
    episodes = []
    for fork in (True, False):
        monkeypatch.setattr(search_generator, "_fork", fork)
        result = search_generator.generate(SEARCH_SEED, tmp_path, f"fork_{fork}")
        assert result.success
        assert result.steps > 0
        episodes.append((load(tmp_path / f"fork_{fork}.h5")["traj_0"], result))
    assert (tmp_path / "killed").exists()
    (forked, one), (again, other) = episodes
    assert [(f.stage, f.reason) for f in one.failures] == [(f.stage, f.reason) for f in other.failures]
    np.testing.assert_array_equal(forked["actions"], again["actions"])
    for name, values in forked["states"].items():
        np.testing.assert_array_equal(values, again["states"][name], err_msg=name)
    (replayed,) = replay(ReplaySettings(tmp_path / "fork_True.h5"))
    assert replayed.success
    assert replayed.state_error == 0.0


def test_recoveries_are_kept_unless_the_episode_cannot_succeed(tmp_path, monkeypatch, search_generator):
    accept_all_attempts(monkeypatch)
    change(monkeypatch, search_generator, max_attempts=4, keep_recoveries=True)
    failures = iter([PlanningError("grasp", "missed"), UnrecoverableError("clear", "fell_off_table")])
    starts = []

    def policy(arm):
        starts.append(len(arm.executor.actions))
        arm.executor.move_gripper(-1.0, arm.qpos, seconds=0.2)
        failure = next(failures, None)
        if failure:
            raise failure

    monkeypatch.setattr(search_generator, "policy", policy)
    result = search_generator.generate(1, tmp_path, "kept")
    assert result.attempts == 3
    assert starts[0] == 0
    assert starts[1] > 4  # what failed stays, and the arm's way out of it
    assert starts[2] == 0  # all of it undone
    assert read_json(tmp_path / "kept.h5")["episodes"][0]["robocas"]["recoveries"] == []


@pytest.mark.parametrize("reason", ["no_success", "clipped", "target_displaced"])
def test_attempt_that_fails_the_open_loop_check_is_undone(tmp_path, monkeypatch, pick_generator, reason):
    change(monkeypatch, pick_generator, check_failures=2)
    world, modified = pick_generator.open_loop_envs[-1], []
    step, settle = world.step, world.settle

    def spoil(action):
        step(action)
        if not modified:
            world.clipped += reason == "clipped"
            if reason == "target_displaced":
                target = world.env.objects[int(world.env.target_slot[0])]
                target.set_pose(Pose.create_from_pq(target.pose.p + torch.tensor([[0.3, 0.0, 0.0]]), target.pose.q))
            if reason != "no_success":
                modified.append(reason)

    def fail():
        modified.append(reason)
        return False if len(modified) == 1 and reason == "no_success" else settle()

    monkeypatch.setattr(world, "step", spoil)
    monkeypatch.setattr(world, "settle", fail)
    result = pick_generator.generate(1, tmp_path, "again")
    assert result.success
    assert result.failures[0].stage == "open_loop_check"
    assert result.failures[0].reason == f"{reason}_with_noise"
    data = read_json(tmp_path / "again.h5")["episodes"][0]["robocas"]
    assert (data["check_rate"], data["check_trials"]) == (5, 1)


def test_after_failures_with_noise_an_episode_is_checked_without_noise(tmp_path, monkeypatch, pick_generator):
    change(monkeypatch, pick_generator, check_failures=2)
    monkeypatch.setattr(pick_generator.open_loop_envs[1], "settle", lambda: False)
    result = pick_generator.generate(1, tmp_path, "modified")
    assert result.success
    assert [failure.reason for failure in result.failures].count("no_success_with_noise") == 2
    assert read_json(tmp_path / "modified.h5")["episodes"][0]["robocas"]["check_trials"] == 0


def test_attempt_that_fails_only_with_noise_is_kept_if_no_failure_is_allowed(tmp_path, monkeypatch, pick_generator):
    change(monkeypatch, pick_generator, check_failures=0)
    monkeypatch.setattr(pick_generator.open_loop_envs[1], "settle", lambda: False)
    result = pick_generator.generate(1, tmp_path, "kept")
    assert (result.success, result.attempts) == (True, 1)
    assert read_json(tmp_path / "kept.h5")["episodes"][0]["robocas"]["check_trials"] == 0


@pytest.mark.parametrize("seed", [960206, 960276])  # a push, a lift
def test_blocked_fruit_is_picked_after_another_object_was_moved(tmp_path, seed):
    """In these scenes of RoboCAS-v0's evaluation, the gripper touches another fruit in every grasp."""
    generator = EpisodeGenerator(EpisodeSettings("pick", "pick_upstream_eval", check_rate=0))
    try:
        result = generator.generate(seed, tmp_path, "blocked")
    finally:
        generator.close()
    assert (result.success, result.attempts) == (True, 1)
    with h5py.File(tmp_path / "blocked.h5") as file:
        positions = {name: body[:, :3] for name, body in file["traj_0/env_states/actors"].items()}
    shifts = {name: np.linalg.norm(rows[-1, :2] - rows[0, :2]) for name, rows in positions.items()}
    assert sum(shift > 0.02 for shift in shifts.values()) == 2  # the target, and the object that was in the way
