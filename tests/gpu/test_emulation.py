"""The emulated GPU interface keeps the properties of a GPU that batched code can get wrong."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from batches import make_batch
from gpu_emulation import emulated_envs

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(emulated_envs() == 0, reason="tests of the emulated GPU interface"),
]


@pytest.fixture(scope="module")
def env():
    made = make_batch("pick", 2)
    made.reset(seed=0)
    yield made.unwrapped
    made.close()


@pytest.mark.parametrize(
    "operation",
    [
        lambda x: x + torch.ones(3),
        lambda x: torch.ones(3).add_(x),
        lambda x: torch.cat([x, torch.ones(3)]),
        lambda x: torch.where(x > 0, torch.ones(3), x),
        lambda x: torch.ones(3)[x.long()],
        lambda x: x.index_put_((torch.tensor([0]),), torch.ones(1)),
    ],
)
def test_cpu_tensors_do_not_mix(operation):
    with pytest.raises(RuntimeError, match="same device"):
        operation(torch.zeros(3, device="cuda"))


def test_numbers_and_indices_of_the_cpu_mix():
    x = torch.zeros(3, device="cuda")
    assert (x + torch.tensor(2.0))[torch.tensor([0])].tolist() == [2.0]


def test_there_are_no_numpy_arrays_of_device_tensors():
    with pytest.raises(RuntimeError, match="numpy"):
        torch.zeros(3, device="cuda").numpy()
    assert torch.zeros(3, device="cuda").cpu().numpy().tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("operation", "synchronisations"),
    [
        (lambda x: x[0] + x.sum(), 0),
        (lambda x: x.to("cuda"), 0),
        (lambda x: float(x[0]), 1),
        (lambda x: x.cpu(), 1),
        (lambda x: x.tolist(), 1),
        (lambda x: x[x > 0], 1),
        (lambda x: x.nonzero(), 1),
        (lambda x: torch.ones(3).to("cuda"), 1),
        (lambda x: torch.tensor([1.0], device="cuda"), 1),
        (lambda x: bool((x > 0).any()), 1),
        (lambda x: x.repeat_interleave(x.long()), 1),
        (lambda x: x.repeat_interleave(x.long(), output_size=3), 0),
        (lambda x: x.histc(4), 1),
        (lambda x: x.histc(4, 0, 1), 0),
    ],
)
def test_synchronisations_are_counted(operation, synchronisations):
    from gpu_emulation.tensors import count_synchronisations

    x = torch.ones(3, device="cuda")
    with count_synchronisations() as counted:
        operation(x)
    assert sum(counted.values()) == synchronisations, counted


def test_values_reach_the_physics_only_when_applied(env: Any):
    px, qpos = env.scene.px, env.agent.robot.qpos.clone()
    env.agent.robot.set_qpos(qpos + 0.1)
    px.gpu_fetch_articulation_qpos()
    torch.testing.assert_close(env.agent.robot.qpos, qpos)
    env.agent.robot.set_qpos(qpos + 0.1)
    px.gpu_apply_articulation_qpos()
    px.gpu_fetch_articulation_qpos()
    torch.testing.assert_close(env.agent.robot.qpos, qpos + 0.1)


def test_link_poses_follow_joints_after_an_update(env: Any):
    px, tcp = env.scene.px, env.agent.tcp.pose.raw_pose.clone()
    env.agent.robot.set_qpos(env.agent.robot.qpos + 0.1)
    px.gpu_apply_articulation_qpos()
    px.gpu_fetch_articulation_link_pose()
    assert torch.equal(env.agent.tcp.pose.raw_pose, tcp)
    px.gpu_update_articulation_kinematics()
    px.gpu_fetch_articulation_link_pose()
    assert not torch.equal(env.agent.tcp.pose.raw_pose, tcp)


def test_values_that_nobody_wrote_cannot_be_applied(env: Any):
    env.scene.px.cuda_articulation_qpos.torch()[0, 0] = torch.nan
    with pytest.raises(RuntimeError, match="NaN"):
        env.scene.px.gpu_apply_articulation_qpos()
    env.scene.px.gpu_fetch_articulation_qpos()


def test_rows_are_not_in_the_order_of_the_envs(env: Any):
    rows = torch.stack([actor._body_data_index for actor in env.objects], dim=1)
    assert (rows.flatten().diff() < 0).any()
    assert len(rows.unique()) == rows.numel()
