"""A step does not synchronise with the GPU, in all tasks and control modes."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from batches import make_batch, set_control_mode, smooth_actions
from gpu_emulation import emulated_envs
from synchronisation import no_host_synchronisation

from robocas_ms3.tasks import TASKS

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: unproven on a GPU"),
]


@pytest.fixture(scope="module", params=sorted(TASKS))
def batch(request):
    env = make_batch(request.param, emulated_envs() or 16)
    yield env
    env.close()


@pytest.mark.parametrize("base", ["", "_base"])
@pytest.mark.parametrize("arm", ["pd_joint_pos", "pd_joint_delta_pos", "pd_ee_delta_pose", "pd_ee_pose"])
def test_step_does_not_synchronise(batch, arm, base):
    mode = arm + base
    set_control_mode([batch], mode)
    env: Any = batch.unwrapped  # gymnasium's time limit reads flags of all envs
    env.reset(seed=0)
    actions = smooth_actions(batch, mode, 4).to(env.device)
    env.step(actions[0])  # fills caches
    with no_host_synchronisation():
        for action in actions[1:]:
            env.step(action)


def test_synchronising_step_is_detected(batch, monkeypatch):
    env: Any = batch.unwrapped
    set_control_mode([batch], "pd_joint_pos")
    env.reset(seed=0)
    actions = smooth_actions(batch, "pd_joint_pos", 2).to(env.device)
    env.step(actions[0])
    evaluate = env.evaluate
    monkeypatch.setattr(env, "evaluate", lambda: {**evaluate(), "any": bool(env.present.any())})
    with pytest.raises((AssertionError, RuntimeError), match="wait|synchroni"), no_host_synchronisation():
        env.step(actions[1])
