"""A batch on the emulated GPU interface equals single envs on the CPU, in all tasks and control modes."""

from __future__ import annotations

import gymnasium as gym
import pytest
import torch
from batches import check_equals_singles, make_batch, make_singles, set_control_mode
from gpu_emulation import emulated_envs

from robocas_ms3.tasks import TASKS

JOINT_MODES = ("pd_joint_pos", "pd_joint_delta_pos", "pd_joint_pos_base", "pd_joint_delta_pos_base")
END_EFFECTOR_MODES = ("pd_ee_delta_pose", "pd_ee_pose", "pd_ee_delta_pose_base", "pd_ee_pose_base")
MODES = {task: ("pd_joint_pos", "pd_ee_delta_pose_base") for task in TASKS}
MODES["pick"] = (*JOINT_MODES, *END_EFFECTOR_MODES)  # controllers do not depend on the task

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(emulated_envs() == 0, reason="a GPU's physics differs from that of a CPU"),
]


@pytest.mark.parametrize("task", sorted(TASKS))
def test_states_stages_rewards_and_observations(task):
    batch, singles = make_batch(task, emulated_envs()), make_singles(task, emulated_envs())
    for mode in MODES[task]:
        set_control_mode([batch, *singles], mode)
        check_equals_singles(batch, singles, mode, steps=20)
    for env in (batch, *singles):
        env.close()


@pytest.mark.parametrize("name", ["rigid_dynamic_data", "articulation_qpos", "articulation_target_position"])
def test_missing_apply_is_detected(monkeypatch, name):
    mode = "pd_joint_pos"
    batch = make_batch("pick", emulated_envs(), control_mode=mode)
    singles = make_singles("pick", emulated_envs(), control_mode=mode)
    monkeypatch.setattr(type(batch.unwrapped.scene.px), f"gpu_apply_{name}", lambda self: None)
    with pytest.raises(AssertionError):
        check_equals_singles(batch, singles, mode, steps=5)
    for env in (batch, *singles):
        env.close()


@pytest.mark.emulated_gpu_full
@pytest.mark.parametrize("task", sorted(TASKS))
def test_images(needs_renderer, task):
    settings = dict(obs_mode="rgb+depth", reward_mode="none", sensor_configs=dict(width=64, height=48))
    spec, count = TASKS[task].env_id, emulated_envs()
    batch = gym.make(spec, num_envs=count, seeds=(0, count - 1), **settings)
    single = gym.make(spec, sim_backend="physx_cpu", **settings)
    observed, _ = batch.reset(seed=list(range(count)))
    for env in range(count):
        expected, _ = single.reset(seed=env)
        for camera, images in expected["sensor_data"].items():
            for kind, image in images.items():
                found = observed["sensor_data"][camera][kind][env]
                assert torch.equal(found.cpu(), image[0].cpu()), (env, camera, kind)
    batch.close()
    single.close()
