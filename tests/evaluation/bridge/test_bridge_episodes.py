"""LeRobot's side plays real episodes through another process: what `robocas eval` makes of the same actions."""

import shutil
import sys

import numpy as np
import pytest

pytest.importorskip("websockets")
pytest.importorskip("msgpack")

from bridge_ends import theirs

from robocas_ms3.evaluation import results
from robocas_ms3.evaluation.policy import Wants
from robocas_ms3.evaluation.protocol import load_protocol
from robocas_ms3.evaluation.run import Settings, evaluate

pytestmark = pytest.mark.slow
CAMERA = (48, 36)
DOWN = np.array([0, 0, 0.02, 0, 0, 0.1, 0.0], np.float32)  # gripper closed


class Down:
    """Goes down; keeps what the gripper's camera saw."""

    wants = Wants(reference="tcp", rate_hz=5, cameras={"gripper_camera": CAMERA})

    def __init__(self) -> None:
        self.seen = []

    def reset(self, starts) -> None:
        pass

    def act(self, observations) -> np.ndarray:
        self.seen.append(observations.images["gripper_camera"][:, 0, 0].tolist())
        return np.tile(DOWN, (len(observations.envs), 1))


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """The protocol smoke with two seconds an episode."""
    folder = tmp_path_factory.mktemp("protocols") / "short"
    shutil.copytree(load_protocol("smoke").folder, folder)
    rules = folder / "protocol.yaml"
    rules.write_text(rules.read_text().replace("max_steps: null", "max_steps: 10"))
    return folder


def test_outcomes_pictures_and_instructions_are_those_of_robocas_eval(needs_renderer, short, tmp_path):
    protocol, policy = load_protocol(short), Down()
    settings = Settings(2, "processes", workers=1, tasks=("search",))
    list(evaluate(protocol, policy, "down", tmp_path / "ours", settings))
    made = theirs("vector_env").RoboCASVectorEnv(
        "search",
        2,
        protocol=str(short),
        cameras={"gripper_camera": CAMERA},
        python=sys.executable,
        backend="processes",
        results=str(tmp_path / "theirs"),
    )
    obs, info = made.reset(seed=2000)  # episodes 0 and 1 of the task's two
    assert made.episodes.tolist() == [4, 5]
    said = [protocol.episodes[number].instruction for number in (4, 5)]
    assert list(made.call("task_description")) == list(made.get_attr("task_description")) == said
    assert said[0] != said[1]
    assert made.call("_max_episode_steps") == (10, 10)
    assert made.observation_space.contains(obs)
    seen, done = [], np.zeros(2, bool)
    while not done.all():
        seen.append(obs["pixels"]["gripper_camera"][:, 0, 0].tolist())
        obs, reward, terminated, truncated, info = made.step(np.tile(DOWN, (2, 1)))
        done = terminated | truncated
    assert seen == policy.seen
    assert truncated.all() and not terminated.any() and not reward.any() and not info["is_success"].any()
    frozen = made.step(np.tile(DOWN, (2, 1)))  # costs nothing, changes nothing
    np.testing.assert_array_equal(frozen[0]["agent_pos"], obs["agent_pos"])
    assert made.render()[0].shape == (36, 48, 3)
    made.reset(seed=[1, 1])
    assert made.call("task_description") == (said[1], said[1])
    with pytest.raises(ValueError, match="expected 2, found"):
        made.reset(seed=[1])
    with pytest.raises(ValueError, match="actions: expected"):
        made.step(np.zeros((2, 6)))
    made.close()
    ours, other = (results.read(tmp_path / name).outcomes for name in ("ours", "theirs"))
    assert {n: one.without_clock() for n, one in ours.items()} == {n: one.without_clock() for n, one in other.items()}
    assert all(one.measures["path_length"] > 0.1 for one in other.values())
