"""The robot state in observations equals the columns of a dataset for the same states."""

import numpy as np

from robocas_ms3.core.poses import from_wxyz
from robocas_ms3.datasets.lerobot.arrays import to_frame_columns
from robocas_ms3.datasets.lerobot.schema import FEATURES
from robocas_ms3.datasets.sources.arrays import make_episode_arrays
from robocas_ms3.demos.recordings.motion import Motion, sample_gripper_commands
from robocas_ms3.evaluation.harness.proprioception import KEYS, WIDTHS, Proprioception
from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.robots.registry import DEFAULT_ROBOT, PANDA

STEPS = 60
COMMANDS = np.where(np.arange(STEPS) // 7 % 2, -1.0, 1.0)


def moving(seed: int) -> Motion:
    """A robot whose base turns more than once and whose arm passes a sign flip of the quaternion."""
    rng = np.random.default_rng(seed)
    root = np.array([[0.4, -1.2, 0.0, np.cos(1.1), 0, 0, np.sin(1.1)]])
    qpos = np.cumsum(rng.normal(scale=0.2, size=(STEPS, 12)), axis=0)
    qpos[:, 2] = np.linspace(0, 9, STEPS)
    qpos[:, 10:] = 0.04
    qpos = qpos.astype(np.float32).astype(np.float64)
    qvel = rng.normal(size=(STEPS, 12)).astype(np.float32).astype(np.float64)
    opened = sample_gripper_commands(MOBILE_PANDA, COMMANDS, np.arange(STEPS), initial_width=0.08)
    return Motion.from_joints(PANDA, np.tile(from_wxyz(root), (STEPS, 1, 1)), qpos, qvel, opened)


def observed(robots: list[Motion], step: int) -> dict:
    """The observation of a vector environment at a step: float32, poses wxyz."""

    def seven(poses):
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
        return np.concatenate([poses[:, :3, 3], turn], axis=1)[step].astype(np.float32)

    return {
        "agent": {
            "qpos": np.stack([robot.qpos[step] for robot in robots]).astype(np.float32),
            "qvel": np.stack([robot.qvel[step] for robot in robots]).astype(np.float32),
            "tcp_in_arm_base": np.stack([seven(robot.tcp_in_base) for robot in robots]),
        },
        "extra": {"tcp_pose": np.stack([seven(robot.tcp_in_world) for robot in robots])},
    }


def test_proprioception_equals_dataset_columns_at_each_step():
    robots, state = [moving(1), moving(2)], Proprioception(DEFAULT_ROBOT)
    state.reset(observed(robots, 0))
    read: list[list[dict]] = [[], []]
    for step in range(STEPS):
        for env in range(2):
            command = None if step == 0 else float(COMMANDS[step - 1])
            read[env].append(state.compute_columns(env, observed(robots, step), command))
    for env, robot in enumerate(robots):
        columns = to_frame_columns(make_episode_arrays(robot, "", []))
        for name, column in KEYS.items():
            found = np.stack([one[name] for one in read[env]])
            assert found.dtype == np.float32
            np.testing.assert_allclose(found, columns[column], atol=3e-6, err_msg=name)
    turns = np.stack([one["agent_pos"] for one in read[0]])
    assert np.ptp(turns[:, 17]) > 2 * np.pi  # more than one turn
    assert (np.sum(turns[1:, 3:7] * turns[:-1, 3:7], axis=1) >= 0).all()
    widths = {one.key: one.width for one in FEATURES if one.key.startswith("observation.")}
    assert {KEYS[name]: width for name, width in WIDTHS.items()} == widths  # all state columns of a dataset
