"""Controllers of several envs, of which some are reset or restored: what a GPU does, without a simulator."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from mani_skill.agents.controllers import PDJointPosController
from mani_skill.utils.structs import Pose

from robocas_ms3.robots.ee_controller import RoboCASEEPoseController
from robocas_ms3.robots.joint_controllers import HeldJointsController, RobotController

ENVS = 4


def joints_at(value: float) -> torch.Tensor:
    """(4, 7), each row its own."""
    return value + torch.arange(4.0)[:, None].repeat(1, 7)


class _Arm(RoboCASEEPoseController):
    qpos = joints_at(0)  # type: ignore[assignment]
    ee_pose_at_base = Pose.create(joints_at(10))


class _Base(HeldJointsController):
    qpos = joints_at(20)  # type: ignore[assignment]
    joints, active_joint_indices = (), None  # type: ignore[assignment]

    @property
    def articulation(self) -> SimpleNamespace:
        """What takes the drive targets of the envs that are being reset."""
        return SimpleNamespace(set_joint_drive_targets=lambda targets, *_: setattr(self, "told", targets))


@pytest.fixture
def robot() -> RobotController:
    scene = SimpleNamespace(_reset_mask=torch.ones(ENVS, dtype=torch.bool), gpu_sim_enabled=True, num_envs=ENVS)
    parts = {}
    for name, kind in (("arm", _Arm), ("base", _Base)):
        parts[name] = kind.__new__(kind)
        parts[name].scene = scene
        parts[name].config = SimpleNamespace(use_target=True)
    made = RobotController.__new__(RobotController)
    made.scene, made.controllers = scene, parts
    made.reset()
    return made


def move(robot: RobotController) -> None:
    """As after some steps: targets are elsewhere, and so are the joints."""
    arm, base = robot.controllers["arm"], robot.controllers["base"]
    arm._target_qpos, arm._target_pose = joints_at(100), Pose.create(joints_at(110))
    base._target_qpos = joints_at(120)
    arm.qpos, arm.ee_pose_at_base, base.qpos = joints_at(1), Pose.create(joints_at(11)), joints_at(21)


def test_a_partial_reset_leaves_the_targets_of_the_other_envs_alone(robot):
    move(robot)
    robot.reset_only = torch.tensor([1, 3])
    robot.reset()
    arm, base = robot.controllers["arm"], robot.controllers["base"]
    for was, now, targets in (
        (joints_at(100), joints_at(1), arm._target_qpos),
        (joints_at(110), joints_at(11), arm._target_pose.raw_pose),
        (joints_at(120), joints_at(21), base._target_qpos),
    ):
        assert torch.equal(targets[[0, 2]], was[[0, 2]])
        assert torch.equal(targets[[1, 3]], now[[1, 3]])
    assert torch.equal(base.told, joints_at(21)[[1, 3]])  # the drives of the envs that are being reset
    assert robot.scene._reset_mask.all()


def test_the_next_reset_is_of_all_again(robot):
    move(robot)
    robot.reset_only = torch.tensor([0])
    robot.reset()
    robot.reset()
    assert torch.equal(robot.controllers["arm"]._target_qpos, joints_at(1))
    assert torch.equal(robot.controllers["base"].told, joints_at(21))


def test_targets_of_some_envs_come_back(robot):
    move(robot)
    kept = robot.targets()
    assert {name: sorted(found) for name, found in kept.items()} == {
        "arm": ["target_pose", "target_qpos"],
        "base": ["target_qpos"],
    }
    robot.reset()
    robot.set_targets({name: {k: v[[2]] for k, v in found.items()} for name, found in kept.items()}, torch.tensor([2]))
    arm = robot.controllers["arm"]
    assert torch.equal(arm._target_qpos[2], joints_at(100)[2])
    assert torch.equal(arm._target_pose.raw_pose[2], joints_at(110)[2])
    assert torch.equal(arm._target_qpos[[0, 1, 3]], joints_at(1)[[0, 1, 3]])
    robot.set_targets(None, torch.tensor([2, 3]))
    assert torch.equal(arm._target_qpos, joints_at(1))
    assert torch.equal(kept["arm"]["target_qpos"], joints_at(100))  # a copy


def test_maniskills_own_controllers_do_so_too(robot):
    part = PDJointPosController.__new__(PDJointPosController)
    part.scene, part.__class__ = robot.scene, type("Part", (PDJointPosController,), {"qpos": joints_at(5)})
    robot.controllers = {"arm": part}
    robot.reset()
    part._target_qpos = joints_at(50)
    robot.reset_only = torch.tensor([3])
    robot.reset()
    assert torch.equal(part._target_qpos[:3], joints_at(50)[:3])
    assert torch.equal(part._target_qpos[3], joints_at(5)[3])
