"""RoboFlamingo's adapter around stub models: what they are shown, and what becomes of what they say."""

import json
import subprocess
import sys

import numpy as np
import pytest

from robocas_ms3.baselines.roboflamingo.adapter import HORIZON, RoboFlamingoPolicy, Stepwise, scale_of
from robocas_ms3.core.errors import DatasetError, EvaluationError
from robocas_ms3.datasets.actions import ActionScale
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations

SCALE = ActionScale(np.array([-0.1, -0.2, 0.0, -0.5, -1.0, 0.2]), np.array([0.1, 0.0, 0.4, 0.5, 3.0, 0.2]))
WIDTH, HEIGHT = 4, 2


class Windows:
    """Keeps the windows that it is shown."""

    def __init__(self, says=(0, 0, 0, 0, 0, 0, 1)):
        self.says, self.seen = says, []

    def __call__(self, base, gripper, instruction):
        self.seen.append((base, gripper, instruction))
        return self.says


class Steps:
    """As upstream's ModelWrapper: frames are kept in the model; acts by how many it was shown, and the last of them."""

    def __init__(self):
        self.frames, self.resets = [], 0

    def reset(self):
        self.frames, self.resets = [], self.resets + 1

    def step(self, obs, goal):
        static, hand = obs["rgb_obs"]["rgb_static"], obs["rgb_obs"]["rgb_gripper"]
        self.frames.append((int(static[0, 0, 0]), int(hand[0, 0, 0]), goal))
        return np.array([0, 0, 0, 0, 0, 0, 1 if len(self.frames) == HORIZON else -1], np.float16)


def a_start(env):
    return EpisodeSpec(env, 0, "pick", "a.yaml", "a.npy", "builtin", 0, "take it")


def shown(frames, texts=None):
    """Frame numbers by env: base pictures are full of them, the gripper's of the number plus 100."""
    envs = sorted(frames)
    pictures = np.stack([np.full((HEIGHT, WIDTH, 3), frames[env], np.uint8) for env in envs])
    nothing = np.zeros((len(envs), 12), np.float32)
    return Observations(
        envs=np.array(envs),
        instructions=[(texts or {}).get(env, "take it") for env in envs],
        embeddings=None,
        images={"base_camera": pictures, "gripper_camera": pictures + 100},
        depths={},
        qpos=nothing,
        tcp_in_base=nothing[:, :7],
        gripper_width=nothing[:, :1],
        state=None,
    )


def made(model):
    return RoboFlamingoPolicy(model, SCALE, pictures=(WIDTH, HEIGHT))


def numbers(window):
    return window[:, 0, 0, 0].tolist()


def test_what_it_wants():
    spec = RoboFlamingoPolicy(Windows(), SCALE).spec
    assert (spec.convention, spec.reference, spec.rate_hz, spec.language) == ("robocas", "tcp", 5, "text")
    assert spec.cameras == {"base_camera": (640, 480), "gripper_camera": (640, 480)}


def test_pictures_are_squeezed_whole():
    """As samples of a dataset are: what is at the edge stays there, at another aspect."""
    model = Windows()
    policy = RoboFlamingoPolicy(model, SCALE, pictures=(8, 3), stored=(16, 12))
    policy.reset([a_start(0)])
    seen = shown({0: 1})
    seen.images.update(gripper_camera=np.ones((1, 12, 16, 3), np.uint8))
    seen.images["base_camera"] = np.ones((1, 12, 16, 3), np.uint8)
    seen.images["base_camera"][0, :, 8:] = 200
    policy.act(seen)
    base = model.seen[0][0][0]
    assert base.shape == (3, 8, 3)
    assert (base[:, :4] == 1).all() and (base[:, 4:] == 200).all()


def test_the_first_frame_is_repeated_and_eleven_are_kept():
    model = Windows()
    policy = made(model)
    policy.reset([a_start(0)])
    for frame in range(1, 14):
        policy.act(shown({0: frame}))
    assert model.seen[0][0].shape == model.seen[0][1].shape == (11, HEIGHT, WIDTH, 3)
    assert model.seen[0][0].dtype == np.uint8
    assert numbers(model.seen[0][0]) == [1] * 11
    assert numbers(model.seen[2][0]) == [1] * 9 + [2, 3]
    assert numbers(model.seen[12][0]) == [3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13]
    assert numbers(model.seen[12][1]) == [103, 104, 105, 106, 107, 108, 109, 110, 111, 112, 113]


def test_pictures_that_are_overwritten_stay_as_they_were():
    model = Windows()
    policy = made(model)
    policy.reset([a_start(0)])
    seen = shown({0: 1})
    policy.act(seen)
    seen.images["base_camera"][:] = 2
    policy.act(seen)
    assert numbers(model.seen[1][0]) == [1] * 10 + [2]


def test_envs_have_frames_and_instructions_of_their_own():
    model = Windows()
    policy = made(model)
    policy.reset([a_start(0), a_start(3)])
    policy.act(shown({0: 1, 3: 51}, {0: "take the pear", 3: "take the lemon"}))
    policy.reset([a_start(3)])  # begins anew while env 0 goes on
    policy.act(shown({0: 2, 3: 61}))
    assert [text for _, _, text in model.seen[:2]] == ["take the pear", "take the lemon"]
    assert [numbers(base) for base, _, _ in model.seen] == [[1] * 11, [51] * 11, [1] * 10 + [2], [61] * 11]


def test_actions_are_scaled_by_the_dataset_s_ranges():
    policy = made(Windows([-1, 0, 0.5, 1, 3, 0.7, 0.25]))
    policy.reset([a_start(0), a_start(1)])
    actions = policy.act(shown({0: 1, 1: 2}))
    # low; middle; three quarters of 0 to 0.4; high; 3 is cut to 1: high; an axis without a range; gripper as it is
    expected = [-0.1, -0.1, 0.3, 0.5, 3.0, 0.2, 0.25]
    np.testing.assert_allclose(actions, [expected, expected], atol=1e-6)


def test_of_an_action_for_each_frame_the_last_is_played():
    each = np.zeros((11, 7))
    each[:, 6] = np.arange(11) / 10
    policy = made(Windows(each))
    policy.reset([a_start(0)])
    assert policy.act(shown({0: 1}))[0, 6] == pytest.approx(1.0)


@pytest.mark.parametrize("says", [np.zeros(6), np.zeros((10, 7)), [0, 0, 0, 0, 0, 0, np.nan]])
def test_what_is_no_action_is_refused(says):
    policy = made(Windows(says))
    policy.reset([a_start(0)])
    with pytest.raises(EvaluationError, match="no action of RoboFlamingo"):
        policy.act(shown({0: 1}))


def test_a_model_that_keeps_frames_itself_is_shown_each_env_s_window():
    model = Steps()
    policy = made(Stepwise(model))
    policy.reset([a_start(0), a_start(1)])
    policy.act(shown({0: 1, 1: 51}))
    actions = policy.act(shown({0: 2, 1: 52}, {0: "take it", 1: "take the lemon"}))
    assert model.resets == 4
    assert model.frames == [(51, 151, "take the lemon")] * 10 + [(52, 152, "take the lemon")]
    assert actions[:, 6].tolist() == [1, 1]  # upstream's 1 is ours: open


def test_upstream_s_closed_gripper_is_zero():
    model = Steps()
    model.step = lambda obs, goal: np.full(7, -1.0)
    policy = made(Stepwise(model))
    policy.reset([a_start(0)])
    assert policy.act(shown({0: 1}))[0].tolist() == pytest.approx([-0.1, -0.2, 0, -0.5, -1, 0.2, 0])


def test_ranges_come_from_data_info(tmp_path):
    path = tmp_path / "data_info.json"
    space = {"relative_position": [[-1, -2, -3], [1, 2, 3]], "relative_rotation": [[-4, -5, -6], [4, 5, 6]]}
    path.write_text(json.dumps({"action_space": space}))
    scale = scale_of(path)
    assert scale.low.tolist() == [-1, -2, -3, -4, -5, -6]
    assert scale.high.tolist() == [1, 2, 3, 4, 5, 6]
    path.write_text("{}")
    with pytest.raises(DatasetError, match="no range of actions"):
        scale_of(path)
    with pytest.raises(EvaluationError, match=r"data_info\.json"):
        scale_of(tmp_path / "nothing.json")


def test_it_loads_without_torch_or_a_simulator():
    code = (
        "import sys; import robocas_ms3.baselines.roboflamingo.adapter, robocas_ms3.evaluation.remote.server; "
        "print([name for name in ('torch', 'sapien', 'mani_skill') if name in sys.modules])"
    )
    pytest.importorskip("websockets")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "[]", done.stderr
