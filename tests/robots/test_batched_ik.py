"""Inverse kinematics of many targets at once: what runs on a GPU, run here on the CPU on a batch."""

from __future__ import annotations

import numpy as np
import sapien
import torch
from mani_skill.utils.geometry.rotation_conversions import matrix_to_quaternion
from mani_skill.utils.structs import Pose

from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.robots.ee_controller import batched_ik
from robocas_ms3.robots.ee_deltas import ee_delta_target


def test_batched_inverse_kinematics_reaches_every_target(make_env):
    """What runs on a GPU, run here on the CPU on a batch."""
    _, agent = make_env("pd_ee_delta_pose")
    controller = agent.controller.controllers["arm"]
    kinematics = controller.kinematics
    kinematics._setup_gpu()

    def forward(arm: torch.Tensor) -> Pose:
        matrices = kinematics.pk_chain.forward_kinematics(arm).get_matrix()
        return Pose.create_from_pq(matrices[:, :3, 3], matrix_to_quaternion(matrices[:, :3, :3]))

    rng = np.random.default_rng(0)
    qpos = agent.robot.qpos.repeat(32, 1)
    bent = np.array([0, -0.3, 0, -2.2, 0, 2.0, 0.78])  # far from the edge of what the arm reaches
    qpos[:, 3:10] = torch.tensor(bent + rng.uniform(-0.2, 0.2, (32, 7))).float()
    now = forward(qpos[:, 3:10])
    delta = torch.tensor(np.hstack([rng.uniform(-0.1, 0.1, (32, 3)), rng.uniform(-0.28, 0.28, (32, 3))])).float()
    target = Pose.create_from_pq(*ee_delta_target(now.p, now.q, delta))
    found, solved = batched_ik(kinematics, target, qpos[:, 3:10], controller._limits)
    reached = forward(found)
    assert solved.all()
    assert (reached.p - target.p).norm(dim=1).max() < 1e-4
    assert (reached.q * target.q).sum(dim=1).abs().min() > 1 - 1e-6


def test_batched_inverse_kinematics_goes_far_too(make_env):
    """Up to half a metre and 1.5 rad along every axis: whatever a CPU reaches, within limits, nearly always."""
    _, agent = make_env("pd_ee_pose")
    controller = agent.controller.controllers["arm"]
    kinematics, limits = controller.kinematics, controller._limits
    kinematics._setup_gpu()
    rng = np.random.default_rng(2)
    start = agent.robot.qpos[:, 3:10].repeat(64, 1)
    middle = torch.tensor(np.array(MOBILE_PANDA.arm_evaluation_start), dtype=torch.float32)
    goal = (middle + torch.tensor(rng.uniform(-0.6, 0.6, (64, 7))).float()).clamp(limits[:, 0], limits[:, 1])
    matrices = kinematics.pk_chain.forward_kinematics(goal).get_matrix()
    target = Pose.create_from_pq(matrices[:, :3, 3], matrix_to_quaternion(matrices[:, :3, :3]))
    _, solved = batched_ik(kinematics, target, start, limits)
    assert (target.p - agent.tcp_in_arm_base.p).norm(dim=1).max() > 0.4
    assert solved.float().mean() > 0.95


def test_batched_inverse_kinematics_keeps_to_the_limits_and_says_what_it_did_not_reach(make_env):
    _, agent = make_env("pd_ee_delta_pose")
    controller = agent.controller.controllers["arm"]
    kinematics, limits = controller.kinematics, controller._limits
    solver, chain, free = kinematics.pmodel, controller._chain, controller._free
    kinematics._setup_gpu()
    rng = np.random.default_rng(1)
    arm = rng.uniform(limits[:, 0], limits[:, 1], (64, 7)).astype(np.float32)  # many near a limit
    qpos = agent.robot.qpos.repeat(64, 1)
    qpos[:, 3:10] = torch.from_numpy(arm)
    matrices = kinematics.pk_chain.forward_kinematics(qpos[:, 3:10]).get_matrix()
    now = Pose.create_from_pq(matrices[:, :3, 3], matrix_to_quaternion(matrices[:, :3, :3]))
    delta = torch.tensor(np.hstack([rng.uniform(-0.1, 0.1, (64, 3)), rng.uniform(-0.28, 0.28, (64, 3))])).float()
    target = Pose.create_from_pq(*ee_delta_target(now.p, now.q, delta))
    target.raw_pose[:4, :3] = torch.tensor([2.0, 0, 0.5])  # out of reach
    found, solved = batched_ik(kinematics, target, qpos[:, 3:10], limits)
    assert ((found >= limits[:, 0]) & (found <= limits[:, 1])).all()
    assert not solved[:4].any()
    on_a_cpu = []
    low, high = limits.numpy().T
    for pose, start in zip(target.raw_pose.numpy(), qpos.numpy(), strict=True):
        qpos_on_a_cpu, success, _ = solver.compute_inverse_kinematics(
            kinematics.end_link_idx,
            sapien.Pose(pose[:3], pose[3:]),
            initial_qpos=start[chain],
            active_qmask=free,
            max_iterations=100,
        )
        reached = qpos_on_a_cpu[controller._arm]
        on_a_cpu.append(bool(success and (reached >= low).all() and (reached <= high).all()))
    both = solved.numpy() & on_a_cpu
    assert both.sum() > 30
    assert both.sum() >= 0.95 * sum(on_a_cpu)
    matrices = kinematics.pk_chain.forward_kinematics(found).get_matrix()
    missed = (matrices[:, :3, 3] - target.p).norm(dim=1)
    assert missed[solved].max() < 1.1e-4
    assert missed[~solved].median() > 1e-3
