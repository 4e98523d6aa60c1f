"""`robocas validate --replay`, with a stub environment that needs no simulator."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from managing import change, edit
from scipy.spatial.transform import Rotation

from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import AssetError
from robocas_ms3.datasets.checks import replay as replay_check
from robocas_ms3.datasets.checks.replay import replay_dataset
from robocas_ms3.demos.open_loop import OpenLoopResult


class Player:
    """Integrates the actions without physics. Seed 5 never succeeds."""

    made: list = []  # noqa: RUF012
    start = np.zeros(3)
    layout = SimpleNamespace(
        object_ids=("cube",) * 3,
        object_poses=np.tile(np.eye(4), (3, 1, 1)),
        robot_pose=np.eye(4),
        basket_pose=np.eye(4),
    )

    def __init__(self, env, rate_hz):
        if env.kwargs.get("pack") == "gone":
            raise AssetError("no such pack", where="gone")
        self.rate_hz, self.closed, self.plays = rate_hz, False, []
        Player.made.append(self)

    def reset(self, seed, options):
        self.seed, self.options = seed, options

    def replay(self, actions):
        self.plays.append((self.seed, actions))
        pose, places = np.eye(4), [np.zeros(3)]
        for action in actions.astype(float):
            pose[:3, 3] += pose[:3, :3] @ action[:3]
            pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("xyz", action[3:6]).as_matrix()
            places.append(pose[:3, 3].copy())
        return OpenLoopResult(self.seed != 5, np.array(places), 0)

    def close(self):
        self.closed = True


@pytest.fixture(autouse=True)
def player(monkeypatch):
    Player.made = []
    monkeypatch.setattr(replay_check, "OpenLoopEnv", Player)
    return Player


def edit_scene(dataset, number, **changes):
    edit(dataset / f"episode_{number:07d}" / "scene.json", lambda scene: scene.update(changes))


def edit_arrays(dataset, number, **changes):
    change(dataset / f"episode_{number:07d}", **changes)


def still(dataset, number):
    """An episode whose TCP starts at the origin of the base, so that the replay follows it exactly."""
    steps = 7
    turn = np.tile([0, 0, 0, 1], (steps, 1)).astype(np.float32)
    nothing = np.zeros((steps, 3), np.float32)
    edit_arrays(dataset, number, ee_pos=nothing, rel_pos=nothing, ee_orn=turn, rel_orn=turn)


def test_replay_uses_the_actions_of_the_dataset(dataset, player):
    report = replay_dataset(dataset)
    (made,) = player.made  # one environment for all episodes of one kind
    assert (made.rate_hz, made.closed) == (5.0, True)
    assert [seed for seed, *_ in made.plays] == [3, 5]
    with np.load(dataset / "episode_0000000" / "episode_info.npz") as arrays:
        _, actions = made.plays[0]
        np.testing.assert_array_equal(actions[:, :3], arrays["rel_pos"][:-1])
        quaternions = Rotation.from_euler("xyz", actions[:, 3:6]).as_quat(canonical=True)
        np.testing.assert_allclose(quaternions, arrays["rel_orn"][:-1], atol=1e-6)
        assert actions[:, 6].tolist() == arrays["gripper_status"][1:].tolist()
    assert [episode.success for episode in report.episodes] == [True, False]
    of_task = report.summarize_by_task()["pick"]
    assert (of_task["replayed"], of_task["succeeded"], of_task["success_rate"], of_task["skipped"]) == (2, 1, 0.5, 0)


def test_tracking_error_by_hand(dataset):
    still(dataset, 0)
    shifted = np.zeros((7, 3), np.float32)
    shifted[6] = 0.0, 0.07, 0.0  # the player stays at the origin: 7 cm off at the last of seven steps
    edit_arrays(dataset, 0, ee_pos=shifted)
    episode = replay_dataset(dataset).episodes[0]
    assert episode.mean_error == pytest.approx(0.01)
    assert episode.max_error == pytest.approx(0.07)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"env_info": None}, "so the scene can't be built"),
        ({"success": False}, "did not succeed"),
        ({"layout": {"object_ids": ["cube", "cup", "cube"]}}, "the seed builds another scene: other objects"),
        (
            {"layout": {"object_ids": ["cube"] * 3, "poses": [[0, y, 0, 1, 0, 0, 0] for y in (0, 0.5, 0)]}},
            "the seed builds another scene: objects displaced by up to 500 mm",
        ),
        ({"env_info": {"env_id": "X-v1", "env_kwargs": {"pack": "gone"}}}, "no such pack"),
        (
            {"env_info": {"env_id": "X-v1", "env_kwargs": {"pack": "/there"}}},
            "expected a name without a path, found '/there'",
        ),
        ({"env_info": {"env_id": "evil:X-v1", "env_kwargs": {}}}, "invalid environment id"),
        ({"reset_options": {"reset_to_env_states": {}}}, "reset_options: "),
    ],
)
def test_scene_that_can_not_be_rebuilt_is_skipped_with_a_reason(dataset, changes, reason):
    edit_scene(dataset, 0, **changes)
    first, second = replay_dataset(dataset).episodes
    assert first.success is None
    assert reason in first.skipped
    assert second.success is False


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"rel_pos": np.full((7, 3), np.nan, np.float32)}, "NaN or infinite values in the arrays"),
        ({"ee_pos": np.zeros((5, 3), np.float32)}, "operands could not be broadcast"),
        ({"rel_orn": np.zeros((7, 4), np.float32)}, "zero norm"),
    ],
)
def test_invalid_arrays_are_skipped_with_a_reason(dataset, changes, reason):
    edit_arrays(dataset, 0, **changes)
    first, second = replay_dataset(dataset).episodes
    assert first.success is None
    assert reason in first.skipped
    assert second.success is False


def test_seed_in_a_list_is_replayed(dataset, player):
    edit_scene(dataset, 0, seed=[5])
    edit_scene(dataset, 1, seed=[3, 4])
    first, second = replay_dataset(dataset).episodes
    assert (first.success, first.skipped) == (False, "")
    assert [seed for seed, *_ in player.made[0].plays] == [5]
    assert "an integer, or a list of one" in second.skipped


def test_moving_base_and_damaged_scene_are_skipped(dataset):
    moving = np.zeros((7, 3), np.float32)
    moving[3:, 0] = 0.1
    edit_arrays(dataset, 0, base_pos=moving)
    (dataset / "episode_0000001" / "scene.json").write_text("{")
    first, second = replay_dataset(dataset).episodes
    assert "the base moves" in first.skipped
    assert second.success is None
    assert second.skipped


def test_command_reports_replays_and_checks_min_success(dataset, capsys):
    assert run(["validate", str(dataset), "--replay"]) == 0
    out = capsys.readouterr().out
    assert "episode 1: the replay failed" in out
    assert "pick: 1 of 2 replayed episodes succeed (50%)" in out
    assert run(["validate", str(dataset), "--replay", "--min-success", "0.9"]) == 1
    assert run(["validate", str(dataset), "--replay", "--min-success", "0.5"]) == 0
    capsys.readouterr()
    assert run(["validate", str(dataset), "--replay", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["replay"]["by_task"]["pick"]["success_rate"] == 0.5


@pytest.mark.parametrize("words", ["--min-success 0.5", "--replay --min-success 50", "--replay --min-success nan"])
def test_invalid_min_success_is_refused(dataset, player, capsys, words):
    assert run(["validate", str(dataset), *words.split()]) == 2
    assert capsys.readouterr().err.startswith("error: --min-success: ")


@pytest.mark.parametrize("json_too", [(), ("--json",)])
def test_min_success_fails_if_no_episode_could_be_replayed(dataset, capsys, json_too):
    """For example if the pack is not installed, or for one of two tasks."""
    for number in (0, 1):
        edit_scene(dataset, number, env_info={"env_id": "X-v1", "env_kwargs": {"pack": "gone"}})
    command = ["validate", str(dataset), "--replay", *json_too]
    assert run(command) == 0
    said = "pick: none of 2 episodes could be replayed; success rate unknown"
    assert json_too or said in capsys.readouterr().out
    assert run([*command, "--min-success", "0.9"]) == 1
    edit_scene(dataset, 0, env_info={"env_id": "Y-v1", "env_kwargs": {}}, task="select")
    assert run([*command, "--min-success", "0.9"]) == 1
