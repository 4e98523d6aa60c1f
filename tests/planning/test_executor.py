"""What an executor keeps of what it has done. A counter stands for the simulator."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from robocas_ms3.planning.executor import CLOSED, OPEN, Executor
from robocas_ms3.planning.protocol import Trajectory


class Counter:
    """Its state is the list of actions since the reset."""

    def reset(self, seed: int):
        self.done: list[float] = []
        return None, {"seed": seed}

    def step(self, action: np.ndarray):
        self.done.append(float(action[0]))
        return None, 0, False, False, {"success": [len(self.done) == 3]}


class Simulated(Executor):
    base_env = property(lambda self: SimpleNamespace(control_mode="pd_joint_pos", control_timestep=0.05))


def move(made: Simulated, *values: float) -> None:
    made.follow(Trajectory(np.repeat(np.array(values)[:, None], 7, axis=1), 0.05))


def test_it_keeps_what_was_done_since_the_reset():
    made = Simulated(Counter(), seed=7)
    made.reset()
    assert made.info == {"seed": 7}
    made.label("find the object", "find it")
    made.gripper, made.facts["pushes"] = CLOSED, 1
    move(made, 1)
    made.label("move and grasp", "grasp it")
    made.label("find the object", "find it")  # nothing was done in between
    move(made, 2)
    made.label("transfer object", "carry it")
    assert made.env.done == [1, 2] == [float(action[0]) for action in made.actions]
    assert [float(action[7]) for action in made.actions] == [CLOSED, CLOSED]
    assert [(part.goal_type, part.first) for part in made.segments] == [("find the object", 0), ("transfer object", 2)]
    assert made.follow(Trajectory(np.zeros((9, 7)), 0.05), until="success")
    assert len(made.actions) == 3  # the flag ended the motion
    made.reset()
    assert (made.env.done, made.actions, made.segments, made.gripper, made.facts) == ([], [], [], OPEN, {})
