"""Test-only emulation of ManiSkill's GPU interface on CPU physics.

`install` replaces ``sapien.physx.PhysxGpuSystem`` by one CPU system per env (`physics`, `contacts`, `scene`). After it,
``gym.make(..., num_envs=4, sim_backend="physx_cuda")`` executes the batched code path without PhysX's library for GPUs.
On a machine with a CUDA device the tensors are CUDA tensors, whose values are copied to and from the CPU systems
(`device_copies`). On other machines torch gets a device ``cuda:0`` whose tensors are in CPU memory (`tensors`).
"""

from __future__ import annotations

import torch

SUPPORTED_TORCH = "2.13.0+cpu"
"""The emulated device uses private functions of this build."""

_installed = {"envs": 0, "tensors": 0}


class UnsupportedTorch(RuntimeError):
    """There is no CUDA device, and the installed torch is not `SUPPORTED_TORCH`."""


def unsupported_torch() -> str | None:
    """Return why the emulation does not run with the installed torch; None if it does."""
    if torch.__version__ == SUPPORTED_TORCH or torch.cuda.is_available():
        return None
    return f"the GPU emulation uses private functions of torch {SUPPORTED_TORCH}; found torch {torch.__version__}"


def install(num_envs: int = 4) -> None:
    """Replace the GPU interfaces of torch, SAPIEN and ManiSkill in this process; this cannot be undone.

    Args:
        num_envs: how many envs the tests of this process make.

    Raises:
        UnsupportedTorch: there is no CUDA device, and the installed torch is not `SUPPORTED_TORCH`.
    """
    problem = unsupported_torch()
    if problem is not None:
        raise UnsupportedTorch(problem)
    from gpu_emulation import scene, tensors

    if not torch.cuda.is_available():
        tensors.install()
        _installed["tensors"] = 1
    scene.install()
    _installed["envs"] = num_envs


def emulated_envs() -> int:
    """Return how many envs the tests of this process make on the emulation; 0 where it is not installed."""
    return _installed["envs"]


def has_emulated_tensors() -> bool:
    """Return whether this process has the emulated device; False where its CUDA tensors are real."""
    return _installed["tensors"] > 0
