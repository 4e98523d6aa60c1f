"""Backing out of what failed: which way, and only where it is free. A planner that leads anywhere, or nowhere."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from planning_scenes import REST, top_down

from robocas_ms3.core.errors import PlanningFailed
from robocas_ms3.planning.protocol import Trajectory
from robocas_ms3.planning.skills.arm import Arm, back_out

TARGET = 3
LEVEL = np.eye(4)  # points ahead, closes level
LEVEL[:3, :3] = np.column_stack([(0, 0, -1), (0, 1, 0), (1, 0, 0)])
LEVEL[:3, 3] = 0.6, 0.1, 0.4


class Way(Arm):
    """An arm at a pose; lines that are checked fail while the scene holds one of ``blocking``."""

    def __init__(self, tcp, approach, blocking=()):
        self._env = SimpleNamespace(
            task_config=SimpleNamespace(target=SimpleNamespace(approach=approach)), target_slot=torch.tensor([TARGET])
        )
        self.at, self.planner, self.blocking = REST, self, blocking
        self.scene = SimpleNamespace(tcp_in_base=tcp, obstacles=lambda without=None: without)
        self.lines, self.followed, self.opened = [], [], False

    env = property(lambda self: self._env)

    def tcp(self, at):
        return self.scene.tcp_in_base

    def set_scene(self, left_out):
        self.left_out = left_out

    def plan_straight(self, start, goal, *, stage, check_collisions=True, speed=1.0):
        if check_collisions and self.left_out in self.blocking:
            raise PlanningFailed(stage, "straight_line_blocked")
        self.lines.append((goal, check_collisions, self.left_out))
        return Trajectory(start[None], 0.05)

    def planning(self):
        return nullcontext()

    def hold_nothing(self):
        pass

    def open_gripper(self):
        self.opened = True

    def follow(self, *motions):
        self.followed += motions


def test_above_a_table_it_rises_through_what_it_touches():
    arm = Way(top_down(0.6, 0.1, 0.05), "top", blocking=(None, TARGET))
    back_out(arm)
    ((goal, checked, _),) = arm.lines
    assert goal[:3, 3] == pytest.approx([0.6, 0.1, 0.15])
    assert not checked
    assert arm.opened and len(arm.followed) == 1


@pytest.mark.parametrize("approach", ["front", "top"])  # top: with a handle between the fingers
def test_where_it_reached_in_level_it_steps_straight_back_on_a_free_way(approach):
    arm = Way(LEVEL, approach)
    back_out(arm)
    ((goal, checked, left_out),) = arm.lines
    assert goal[:3, 3] == pytest.approx([0.6 - 0.25, 0.1, 0.4])
    assert checked and left_out is None


def test_from_the_target_that_it_stands_against_it_steps_back_too():
    arm = Way(LEVEL, "front", blocking=(None,))
    back_out(arm)
    assert [(checked, left_out) for _, checked, left_out in arm.lines] == [(True, TARGET)]


@pytest.mark.parametrize("tcp", [LEVEL, top_down(0.6, 0.1, 0.05)])
def test_before_a_shelf_it_stays_where_no_way_is_free(tcp):
    arm = Way(tcp, "front", blocking=(None, TARGET))
    with pytest.raises(PlanningFailed, match="straight_line_blocked"):
        back_out(arm)
    assert not arm.followed and not arm.lines
