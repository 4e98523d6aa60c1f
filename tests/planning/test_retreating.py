"""Retreat after a failed attempt: direction, and only on free lines. The planner is a stand-in."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from planning_scenes import REST, top_down

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.planning.protocol import Trajectory
from robocas_ms3.planning.skills.arm import Arm, recover

TARGET = 3
LEVEL = np.eye(4)  # points ahead, closes level
LEVEL[:3, :3] = np.column_stack([(0, 0, -1), (0, 1, 0), (1, 0, 0)])
LEVEL[:3, 3] = 0.6, 0.1, 0.4


class Way(Arm):
    """Arm at a pose; checked lines fail if the exclusion of the scene is in ``blocking``."""

    def __init__(self, tcp, approach, blocking=()):
        self._env = SimpleNamespace(
            task_config=SimpleNamespace(target=SimpleNamespace(approach=approach)), target_slot=torch.tensor([TARGET])
        )
        self.qpos, self.planner, self.blocking = REST, self, blocking
        self.scene = SimpleNamespace(tcp_in_base=tcp, obstacles=lambda exclude=None: exclude)
        self.lines, self.followed, self.opened = [], [], False

    env = property(lambda self: self._env)

    def tcp(self, qpos):
        return self.scene.tcp_in_base

    def set_scene(self, excluded):
        self.excluded = excluded

    def plan_straight(self, start, goal, *, stage, check_collisions=True, speed=1.0):
        if check_collisions and self.excluded in self.blocking:
            raise PlanningError(stage, "straight_line_blocked")
        self.lines.append((goal, check_collisions, self.excluded))
        return Trajectory(start[None], 0.05)

    def planning_time(self):
        return nullcontext()

    def clear_attached(self):
        pass

    def open_gripper(self):
        self.opened = True

    def follow(self, *motions):
        self.followed += motions


@pytest.mark.parametrize(
    ("tcp", "approach", "blocking", "moved", "checked", "excluded"),
    [
        # above a table the arm rises, ignoring contacts
        (top_down(0.6, 0.1, 0.05), "top", (None, TARGET), (0, 0, 0.1), False, None),
        # after a horizontal approach it moves straight back on a free line; also with a handle in the fingers
        (LEVEL, "front", (), (-0.25, 0, 0), True, None),
        (LEVEL, "top", (), (-0.25, 0, 0), True, None),
        (LEVEL, "front", (None,), (-0.25, 0, 0), True, TARGET),  # in contact with the target too
    ],
)
def test_retreat_after_a_failure(tcp, approach, blocking, moved, checked, excluded):
    arm = Way(tcp, approach, blocking)
    recover(arm)
    ((goal, *how),) = arm.lines
    assert goal[:3, 3] == pytest.approx(tcp[:3, 3] + moved)
    assert how[0] == checked
    assert not checked or how[1] == excluded
    assert arm.opened and len(arm.followed) == 1


@pytest.mark.parametrize("tcp", [LEVEL, top_down(0.6, 0.1, 0.05)])
def test_arm_stays_in_a_shelf_without_a_free_retreat(tcp):
    arm = Way(tcp, "front", blocking=(None, TARGET))
    with pytest.raises(PlanningError, match="straight_line_blocked"):
        recover(arm)
    assert not arm.followed and not arm.lines
