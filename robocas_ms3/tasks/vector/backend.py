"""Where several environments can run: in one process on a GPU, or on a CPU, in processes of their own."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from mani_skill.envs.utils.system.backend import CPU_SIM_BACKENDS

from robocas_ms3.core.errors import VectorEnvError

Backend = Literal["auto", "processes", "gpu"]


def choose_backend(backend: str, sim_backend: str = "auto") -> Literal["processes", "gpu"]:
    """What to make several environments with.

    Args:
        backend: what was asked for; ``auto``: a GPU if there is one and ``sim_backend`` does not say otherwise.
        sim_backend: ManiSkill's argument, ``auto`` or where physics runs.

    Raises:
        VectorEnvError: there is no such backend, it contradicts ``sim_backend``, or it needs a GPU and there is none.
    """
    if backend not in get_args(Backend):
        expected = f"one of {list(get_args(Backend))}"
        raise VectorEnvError("no such backend", where="make_vec", expected=expected, found=repr(backend))
    on_cpu = sim_backend in CPU_SIM_BACKENDS
    if (backend == "gpu" and on_cpu) or (backend == "processes" and sim_backend != "auto" and not on_cpu):
        found = f"backend={backend!r} and sim_backend={sim_backend!r}"
        fix = "Leave one of them out: with processes physics runs on the CPU, otherwise on the GPU."
        raise VectorEnvError("backend and sim_backend contradict each other", where="make_vec", found=found, fix=fix)
    if backend == "processes" or on_cpu:
        return "processes"
    if torch.cuda.is_available():
        return "gpu"
    if backend == "auto" and sim_backend == "auto":
        return "processes"
    fix = 'Pass backend="processes", which runs on the CPU.'
    raise VectorEnvError("needs a GPU", where="make_vec", found="no CUDA device", fix=fix)
