"""Step a batch of envs, and compare its states with those of single envs and with its own earlier states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import gymnasium as gym
import torch
from scipy.spatial.transform import Rotation

import robocas_ms3  # noqa: F401
from robocas_ms3.tasks import TASKS

TOLERANCE = 1e-5  # rad, m, quaternions and rewards
_SETTINGS = dict(obs_mode="state_dict", reward_mode="normalized_dense", render_backend="none")


def make_batch(task: str, count: int, **kwargs: Any) -> gym.Env:
    """Make a batch whose env i has the objects of seed i."""
    return gym.make(TASKS[task].env_id, num_envs=count, seeds=(0, count - 1), **{**_SETTINGS, **kwargs})


def make_singles(task: str, count: int, **kwargs: Any) -> list[gym.Env]:
    """Make single envs on the CPU, env i with the objects of seed i, which resets keep."""
    envs = []
    for seed in range(count):
        env = gym.make(TASKS[task].env_id, sim_backend="physx_cpu", reconfiguration_freq=0, **{**_SETTINGS, **kwargs})
        _step_when_built(env.unwrapped)
        env.reset(seed=seed, options={"reconfigure": True})
        envs.append(env)
    return envs


def _step_when_built(base: Any) -> None:
    """Let a single env step its physics once when its scene is built, as `PhysxGpuSystem.gpu_init` does.

    PhysX solves contacts in the order in which pairs of bodies met. Without the step, this order and the motion of
    some heaps would differ.
    """
    after_reconfigure = base._after_reconfigure

    def step_first(options: dict) -> None:
        base.scene.px.step()
        after_reconfigure(options)

    base._after_reconfigure = step_first


def set_control_mode(envs: Sequence[gym.Env], mode: str) -> None:
    """Change the control mode of envs, which have to be reset then."""
    for env in envs:
        base: Any = env.unwrapped
        base.agent.set_control_mode(mode)


@dataclass(frozen=True)
class Trace:
    """States after each of T steps, the state before them first, on the CPU.

    Attributes:
        qpos: (T + 1, N, 12).
        tcp: (T + 1, N, 7) in the world.
        objects: (T + 1, N, K, 7).
        rewards: (T, N).
        flags: (T, N, F) bool, of the info.
        privileged: (T, N, D) privileged observations.
    """

    qpos: torch.Tensor
    tcp: torch.Tensor
    objects: torch.Tensor
    rewards: torch.Tensor
    flags: torch.Tensor
    privileged: torch.Tensor


def play(env: gym.Env, actions: torch.Tensor) -> Trace:
    """Step with actions (T, N, A)."""
    base: Any = env.unwrapped
    states, rewards, flags, privileged = [_state(base)], [], [], []
    for action in actions.to(base.device):
        _, reward, _, _, info = env.step(action)
        privileged.append(torch.cat([*base.privileged_observations().values()], dim=1))
        states.append(_state(base))
        rewards.append(reward)
        flags.append(torch.stack([info[name] for name in (*base.STAGES, "success", "fail", "disturbed")], dim=-1))
    qpos, tcp, objects = (torch.stack(values).cpu() for values in zip(*states, strict=True))
    return Trace(
        qpos, tcp, objects, torch.stack(rewards).cpu(), torch.stack(flags).cpu(), torch.stack(privileged).cpu()
    )


def play_singles(envs: Sequence[gym.Env], actions: torch.Tensor) -> Trace:
    """Reset single envs, env i with seed i, and step them one after the other with actions (T, N, A)."""
    traces = []
    for seed, env in enumerate(envs):
        env.reset(seed=seed)
        traces.append(play(env, actions[:, seed : seed + 1]))
    return Trace(*(torch.cat([getattr(trace, f.name) for trace in traces], dim=1) for f in fields(Trace)))


def _state(base: Any) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return base.agent.robot.get_qpos().clone(), base.agent.tcp.pose.raw_pose.clone(), base.object_poses


def smooth_actions(env: gym.Env, mode: str, steps: int) -> torch.Tensor:
    """Return actions (T, N, A) of smooth motions from the current state, different in each env, on the CPU.

    The fingers close after half of the steps. The base moves in the modes that take it.
    """
    base: Any = env.unwrapped
    qpos, tcp = base.agent.robot.get_qpos().cpu(), base.agent.tcp_in_arm_base.raw_pose.cpu()
    generator = torch.Generator().manual_seed(len(mode))
    direction = 2 * torch.rand(len(qpos), 10, generator=generator) - 1
    share = torch.linspace(0, 1, steps)[:, None, None]
    arm_mode = mode.removesuffix("_base")
    if arm_mode == "pd_joint_pos":
        arm = qpos[:, 3:10] + 0.2 * share * direction[:, :7]
    elif arm_mode == "pd_joint_delta_pos":
        arm = (0.1 * direction[:, :7]).expand(steps, -1, -1)
    elif arm_mode == "pd_ee_delta_pose":
        arm = (0.02 * direction[:, :6]).expand(steps, -1, -1)
    else:
        euler = Rotation.from_quat(tcp[:, [4, 5, 6, 3]].numpy()).as_euler("XYZ")
        start = torch.cat([tcp[:, :3], torch.from_numpy(euler).float()], dim=1)
        arm = start + 0.1 * share * direction[:, :6]
    fingers = torch.where(share < 0.5, 1.0, -1.0).expand(-1, len(qpos), -1)
    parts = [arm, fingers]
    if mode.endswith("_base"):
        moved = direction[:, 7:]
        parts.append((0.1 * moved).expand(steps, -1, -1) if "delta" in mode else qpos[:, :3] + 0.05 * share * moved)
    return torch.cat(parts, dim=2)


def check_equals_singles(batch: gym.Env, singles: Sequence[gym.Env], mode: str, steps: int) -> None:
    """Compare a batch with single envs over a smooth motion from a reset.

    Args:
        batch: N envs (`make_batch`).
        singles: N single envs (`make_singles`) that have made the same steps as the batch.
        mode: control mode of all envs.
        steps: number of steps T.

    Raises:
        AssertionError: they differ by more than the tolerances of this module.
    """
    for length in (2, steps):  # PhysX keeps contacts over a reset: the first one with a seed differs from later ones
        batch.reset(seed=list(range(len(singles))))
        actions = smooth_actions(batch, mode, length)
        found, expected = play(batch, actions), play_singles(singles, actions)
    _close(found.qpos[0], expected.qpos[0], TOLERANCE, "qpos after the reset")
    _close(found.objects[0], expected.objects[0], TOLERANCE, "objects after the reset")
    _close(found.objects, expected.objects, TOLERANCE, "objects")
    assert torch.equal(found.flags, expected.flags), "flags differ"
    _close(found.qpos, expected.qpos, TOLERANCE, "qpos")
    _close(found.tcp, expected.tcp, TOLERANCE, "TCP")
    _close(found.rewards, expected.rewards, TOLERANCE, "rewards")
    _close(found.privileged, expected.privileged, 10 * TOLERANCE, "privileged observations")  # positions over extents


def check_partial_reset(batch: gym.Env, some: Sequence[int], mode: str, *, exact: bool) -> None:
    """Check that a reset of some envs of a batch leaves the others unchanged; if exact, bit by bit and in later steps.

    Raises:
        AssertionError: another env has changed.
    """
    base: Any = batch.unwrapped
    count = base.num_envs
    others = [env for env in range(count) if env not in some]
    for _ in range(2):  # PhysX keeps contacts over a reset: the first one with a seed differs from later ones
        batch.reset(seed=list(range(count)))
        actions = smooth_actions(batch, mode, 10)
        undisturbed = play(batch, actions)
    batch.reset(seed=list(range(count)))
    play(batch, actions[:5])
    before, targets = base.bodies.read().clone(), base.agent.controller.targets()
    batch.reset(options={"env_idx": torch.tensor(some, device=base.device)})
    after = base.bodies.read()
    _close(after[others], before[others], 0 if exact else TOLERANCE, "the state of another env")
    assert not torch.equal(after[some], before[some]), "the envs are where they were"
    for name, values in base.agent.controller.targets().items():
        for key, value in values.items():
            assert torch.equal(value[others], targets[name][key][others]), f"{key} of another env has changed"
    assert base.elapsed_steps.tolist() == [0 if env in some else 5 for env in range(count)]
    later = play(batch, actions[5:])
    for f in fields(Trace) if exact else ():
        found, expected = getattr(later, f.name), getattr(undisturbed, f.name)[5:]
        assert torch.equal(found[:, others], expected[:, others]), f"{f.name} of another env differs in later steps"


def check_state_round_trip(batch: gym.Env, some: Sequence[int], mode: str) -> None:
    """Check that a restored state equals the state that was read, in all envs or in some, and so do later states.

    Raises:
        AssertionError: a state differs.
    """
    base: Any = batch.unwrapped
    batch.reset(seed=list(range(base.num_envs)))
    actions = smooth_actions(batch, mode, 10)
    play(batch, actions[:5])
    stored, flat = base.get_state_dict(), base.get_state().clone()
    expected = play(batch, actions[5:])
    moved = base.get_state().clone()
    assert not torch.equal(moved, flat)
    index = torch.tensor(some, device=base.device)
    base.set_state_dict(_rows(stored, index), index)
    others = [env for env in range(base.num_envs) if env not in some]
    _close(base.get_state()[some], flat[some], 1e-6, "state of the envs that were set")
    assert torch.equal(base.get_state()[others], moved[others]), "the state of another env has changed"
    base.set_state_dict(stored)
    _close(base.get_state(), flat, 1e-6, "state")
    for name, values in base.agent.controller.targets().items():
        for key, value in values.items():
            _close(value, stored["controller"][name][key], 1e-6, f"{name}.{key}")
    _close(play(batch, actions[5:]).qpos, expected.qpos, 1e-4, "qpos after the same actions")


def _rows(nested: Any, envs: torch.Tensor) -> Any:
    if isinstance(nested, dict):
        return {name: _rows(value, envs) for name, value in nested.items()}
    return nested[envs]


def _close(found: torch.Tensor, expected: torch.Tensor, tolerance: float, name: str) -> None:
    torch.testing.assert_close(found, expected, atol=tolerance, rtol=0, msg=lambda text: f"{name}: {text}")
