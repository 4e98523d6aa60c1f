"""Synthetic observations and episodes for policies."""

import numpy as np

from robocas_ms3.evaluation.policy import EpisodeSpec, Observations


def start(env=0, seed=0):
    return EpisodeSpec(env, 0, "pick", "", "", "builtin", seed, "take it")


def observe(envs=(0,), **values):
    """Return observations of some envs: zeros without a given value, and the identity as TCP rotation."""
    count = len(envs)
    robot = {
        "qpos": np.zeros((count, 12), np.float32),
        "tcp_in_base": np.tile(np.float32([0.5, 0, 0.3, 1, 0, 0, 0]), (count, 1)),
        "gripper_width": np.zeros((count, 1), np.float32),
    }
    others = {
        "instructions": ["take it"] * count,
        "embeddings": None,
        "images": {},
        "depths": {},
        "state": None,
    }
    robot |= {name: values.pop(name) for name in robot if name in values}
    return Observations(envs=np.array(envs), robot=robot, **others | values)
