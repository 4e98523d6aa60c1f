"""The adapter for RoboFlamingo with stub models: images of a window, and conversion of actions."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from robocas_ms3.core.errors import DatasetError, EvaluationError
from robocas_ms3.datasets.actions import ActionScale
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SPEC = importlib.util.spec_from_file_location("roboflamingo", EXAMPLES / "roboflamingo.py")
roboflamingo = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(roboflamingo)
SCALE = ActionScale(np.array([-0.1, -0.2, 0.0, -0.5, -1.0, 0.2]), np.array([0.1, 0.0, 0.4, 0.5, 3.0, 0.2]))
WIDTH, HEIGHT = 4, 2


class StubWindowModel:
    """Window model that keeps its inputs."""

    def __init__(self, action=(0, 0, 0, 0, 0, 0, 1)):
        self.action, self.inputs = action, []

    def __call__(self, base, gripper, instruction):
        self.inputs.append((base, gripper, instruction))
        return self.action


class StubStepModel:
    """Step model like ModelWrapper of RoboFlamingo: keeps frames; opens the gripper after a whole window."""

    def __init__(self):
        self.frames = []

    def reset(self):
        self.frames = []

    def step(self, obs, goal):
        static, hand = obs["rgb_obs"]["rgb_static"], obs["rgb_obs"]["rgb_gripper"]
        self.frames.append((int(static[0, 0, 0]), int(hand[0, 0, 0]), goal))
        return np.array([0, 0, 0, 0, 0, 0, 1 if len(self.frames) == roboflamingo.HORIZON else -1], np.float16)


def started(model, *envs, **sizes):
    """Return a policy that has started episodes in some envs."""
    sizes = sizes or {"model_size": (WIDTH, HEIGHT)}
    policy = roboflamingo.RoboFlamingoPolicy(model, SCALE, **sizes)
    policy.reset([start(env) for env in envs])
    return policy


def start(env):
    return EpisodeSpec(env, 0, "pick", "a.yaml", "a.npy", "builtin", 0, "take it")


def observe(frames, texts=None):
    """Return observations with constant images: the frame number of the env, plus 100 in gripper images."""
    envs = sorted(frames)
    images = np.stack([np.full((HEIGHT, WIDTH, 3), frames[env], np.uint8) for env in envs])
    zeros = np.zeros((len(envs), 12), np.float32)
    return Observations(
        envs=np.array(envs),
        instructions=[(texts or {}).get(env, "take it") for env in envs],
        embeddings=None,
        images={"base_camera": images, "gripper_camera": images + 100},
        depths={},
        robot={"qpos": zeros, "tcp_in_base": zeros[:, :7], "gripper_width": zeros[:, :1]},
        state=None,
    )


def numbers(window):
    return window[:, 0, 0, 0].tolist()


def test_images_are_resized_to_the_size_of_the_model():
    """The whole image is kept, at another aspect ratio, as in samples of a dataset."""
    model = StubWindowModel()
    policy = started(model, 0, model_size=(8, 3), dataset_size=(16, 12))
    seen = observe({0: 1})
    seen.images.update(gripper_camera=np.ones((1, 12, 16, 3), np.uint8))
    seen.images["base_camera"] = np.ones((1, 12, 16, 3), np.uint8)
    seen.images["base_camera"][0, :, 8:] = 200
    policy.act(seen)
    base = model.inputs[0][0][0]
    assert base.shape == (3, 8, 3)
    assert (base[:, :4] == 1).all() and (base[:, 4:] == 200).all()


def test_window_has_copies_of_eleven_frames_and_repeats_the_first():
    model = StubWindowModel()
    policy = started(model, 0)
    for frame in range(1, 14):
        seen = observe({0: frame})
        policy.act(seen)
        seen.images["base_camera"][:] = 99
    assert model.inputs[0][0].shape == model.inputs[0][1].shape == (11, HEIGHT, WIDTH, 3)
    assert model.inputs[0][0].dtype == np.uint8
    assert numbers(model.inputs[2][0]) == [1] * 9 + [2, 3]
    assert numbers(model.inputs[12][0]) == list(range(3, 14))
    assert numbers(model.inputs[12][1]) == list(range(103, 114))


def test_each_env_has_its_frames_and_instruction():
    model = StubWindowModel()
    policy = started(model, 0, 3)
    policy.act(observe({0: 1, 3: 51}, {0: "take the pear", 3: "take the lemon"}))
    policy.reset([start(3)])  # while the episode of env 0 continues
    policy.act(observe({0: 2, 3: 61}))
    assert [text for _, _, text in model.inputs[:2]] == ["take the pear", "take the lemon"]
    assert [numbers(base) for base, _, _ in model.inputs] == [[1] * 11, [51] * 11, [1] * 10 + [2], [61] * 11]


def test_actions_are_scaled_by_the_ranges_of_the_dataset():
    actions = started(StubWindowModel([-1, 0, 0.5, 1, 3, 0.7, 0.25]), 0, 1).act(observe({0: 1, 1: 2}))
    # low; middle; three quarters of 0 to 0.4; high; 3 is clipped to 1: high; an axis without a range; gripper as it is
    expected = [-0.1, -0.1, 0.3, 0.5, 3.0, 0.2, 0.25]
    np.testing.assert_allclose(actions, [expected, expected], atol=1e-6)
    per_frame = np.zeros((11, 7))
    per_frame[:, 6] = np.arange(11) / 10
    assert started(StubWindowModel(per_frame), 0).act(observe({0: 1}))[0, 6] == pytest.approx(1.0)  # the last


@pytest.mark.parametrize("action", [np.zeros(6), np.zeros((10, 7)), [0, 0, 0, 0, 0, 0, np.nan]])
def test_invalid_actions_are_refused(action):
    with pytest.raises(EvaluationError):
        started(StubWindowModel(action), 0).act(observe({0: 1}))


def test_step_model_gets_the_window_of_each_env():
    model = StubStepModel()
    policy = started(roboflamingo.Stepwise(model), 0, 1)
    policy.act(observe({0: 1, 1: 51}))
    actions = policy.act(observe({0: 2, 1: 52}, {0: "take it", 1: "take the lemon"}))
    assert model.frames == [(51, 151, "take the lemon")] * 10 + [(52, 152, "take the lemon")]
    assert actions[:, 6].tolist() == [1, 1]  # RoboCAS-v0's 1 is open here too, its -1 is 0 here
    model.step = lambda obs, goal: np.full(7, -1.0)
    assert policy.act(observe({0: 1, 1: 2}))[0].tolist() == pytest.approx([-0.1, -0.2, 0, -0.5, -1, 0.2, 0])


def test_ranges_come_from_data_info(tmp_path):
    path = tmp_path / "data_info.json"
    space = {"relative_position": [[-1, -2, -3], [1, 2, 3]], "relative_rotation": [[-4, -5, -6], [4, 5, 6]]}
    path.write_text(json.dumps({"action_space": space}))
    scale = roboflamingo.load_scale(path)
    assert scale.low.tolist() == [-1, -2, -3, -4, -5, -6]
    assert scale.high.tolist() == [1, 2, 3, 4, 5, 6]
    path.write_text("{}")
    with pytest.raises(DatasetError):
        roboflamingo.load_scale(path)
    with pytest.raises(EvaluationError) as caught:
        roboflamingo.load_scale(tmp_path / "nothing.json")
    assert caught.value.where == tmp_path / "nothing.json"


def test_adapter_loads_without_torch_and_simulator():
    code = (
        "import sys; import roboflamingo, robocas_ms3.evaluation.remote.server; "
        "print([name for name in ('torch', 'sapien', 'mani_skill') if name in sys.modules])"
    )
    pytest.importorskip("websockets")
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.append({str(EXAMPLES)!r}); {code}"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.strip() == "[]", done.stderr
