import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import from_xyzw
from robocas_ms3.datasets.lerobot.arrays import frame_columns, robocas_arrays
from robocas_ms3.datasets.lerobot.schema import FEATURES, features_json, whole_rate
from robocas_ms3.datasets.lerobot.variants import VARIANTS
from robocas_ms3.datasets.sources.arrays import episode_arrays
from robocas_ms3.demos.recordings.motion import Motion
from robocas_ms3.demos.recordings.subgoals import SubGoal


def made_up(steps, seed):
    rng = np.random.default_rng(seed)
    poses = [from_xyzw(rng.uniform(-1, 1, (steps, 3)), Rotation.random(steps, rng).as_quat()) for _ in range(2)]
    root = np.tile(np.eye(4), (steps, 1, 1))
    qpos, qvel = rng.uniform(-2, 2, (steps, 12)), rng.uniform(-1, 1, (steps, 12))
    goals = [SubGoal.of("move and grasp", "grasp it", 0, 0), SubGoal.of("transfer object", "drop it", 1, steps - 1)]
    return episode_arrays(Motion(qpos, qvel, root, *poses, rng.random(steps) < 0.5), "grasp it and drop it", goals)


@settings(max_examples=25, deadline=None)
@given(st.integers(2, 9), st.integers(0, 1000))
def test_arrays_come_back(steps, seed):
    arrays = made_up(steps, seed)
    columns = frame_columns(arrays)
    texts, types = arrays["step_lang_goals"].tolist(), arrays["step_goal_type"].tolist()
    back = robocas_arrays(columns, "grasp it and drop it", texts, types)
    assert set(back) == set(arrays)
    for key, values in arrays.items():
        if key in ("rel_orn", "base_rel_orn"):
            turns = Rotation.from_quat(values).inv() * Rotation.from_quat(back[key])
            assert turns.magnitude().max() < 1e-5
        elif key == "base_rel_pos":
            np.testing.assert_allclose(back[key], values, atol=1e-5)
        else:
            np.testing.assert_array_equal(back[key], values, err_msg=key)
        assert back[key].dtype.kind == values.dtype.kind


def test_actions_worked_out_by_hand():
    arrays = made_up(3, seed=1)
    arrays["gripper_status"] = np.array([True, False, True])
    arrays["rel_pos"] = np.array([[0.1, 0, 0], [0, 0.2, 0], [0, 0, 0]], np.float32)
    # A quarter turn about z, then an eighth about x.
    arrays["rel_orn"] = np.array(
        [[0, 0, np.sqrt(0.5), np.sqrt(0.5)], [np.sin(np.pi / 8), 0, 0, np.cos(np.pi / 8)], [0, 0, 0, 1]]
    )
    columns = frame_columns(arrays)
    expected = [[0.1, 0, 0, 0, 0, np.pi / 2, 0], [0, 0.2, 0, np.pi / 4, 0, 0, 1], [0, 0, 0, 0, 0, 0, 1]]
    np.testing.assert_allclose(columns["action"], expected, atol=1e-6)
    joints = arrays["robot_joints"]
    np.testing.assert_array_equal(columns["action.joint"], np.column_stack([joints[[1, 2, 2]], [0, 1, 1]]).astype("f4"))
    np.testing.assert_array_equal(columns["action.base"], arrays["rel_agv_pose"])
    for feature in FEATURES:
        assert columns[feature.key].shape == (3, feature.width)
        assert columns[feature.key].dtype == np.float32


def test_the_documentation_names_every_feature():
    text = (Path(__file__).parents[3] / "docs/lerobot.md").read_text()
    for feature in FEATURES:
        assert f"| `{feature.key}` | {feature.width} |" in text
    for variant in VARIANTS.values():
        assert set(features_json(variant, {})) <= set(re.findall(r"`([\w.]+)`", text))
        assert f"| `{variant.version}` |" in text


@pytest.mark.parametrize("variant", VARIANTS.values(), ids=VARIANTS)
def test_no_text_is_an_observation(variant):
    """LeRobot stacks whatever begins with `observation.` into tensors."""
    features = features_json(variant, {})
    assert not [key for key, ft in features.items() if ft["dtype"] == "string" and key.startswith("observation")]


@pytest.mark.parametrize("rate", [0.5, 2.5, 20 / 3])
def test_a_rate_that_lerobot_can_not_have(rate):
    with pytest.raises(DatasetError, match="LeRobot takes a whole number of frames a second"):
        whole_rate(rate)
    assert whole_rate(5.0) == 5
