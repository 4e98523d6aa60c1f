"""What an executor keeps of what it has done. A counter stands for the simulator."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from robocas_ms3.planning.executor import CLOSED, OPEN, Executor


class Counter:
    """Its state is the list of actions since the reset."""

    def __init__(self) -> None:
        self.done: list[float] = []

    def reset(self, seed: int):
        self.done = []
        return None, {"seed": seed}

    def step(self, action: np.ndarray):
        self.done.append(float(action[0]))
        return None, 0, False, False, {"success": [len(self.done) == 3]}


class Simulated(Executor):
    base_env = property(lambda self: SimpleNamespace(control_mode="pd_joint_pos", control_timestep=0.05))


def executor() -> Simulated:
    made = Simulated(Counter(), seed=7)
    made.reset()
    return made


def act(made: Simulated, *values: float) -> None:
    for value in values:
        made._step(made._action(np.full(7, value)))


def test_reset_clears_the_record():
    made = executor()
    made.label("find the object", "find it")
    made.gripper, made.facts["pushes"] = CLOSED, 1
    act(made, 1, 2)
    assert made.env.done == [1, 2] == [float(action[0]) for action in made.actions]
    assert [float(action[7]) for action in made.actions] == [CLOSED, CLOSED]
    made.reset()
    assert (made.env.done, made.actions, made.segments, made.gripper, made.facts) == ([], [], [], OPEN, {})
    assert made.info == {"seed": 7}


def test_a_label_begins_with_the_next_action_and_replaces_one_without_any():
    made = executor()
    made.label("find the object", "find it")
    act(made, 1)
    made.label("move and grasp", "grasp it")
    made.label("find the object", "find it")  # nothing was done in between
    act(made, 2)
    made.label("transfer object", "carry it")
    assert [(segment.goal_type, segment.first) for segment in made.segments] == [
        ("find the object", 0),
        ("transfer object", 2),
    ]


def test_a_flag_ends_a_motion():
    made = executor()
    motion = SimpleNamespace(qpos=np.zeros((9, 7)))
    assert not made.info.get("success")
    made.info = {"success": [False]}
    assert made.follow(motion, until="success")
    assert len(made.actions) == 3
