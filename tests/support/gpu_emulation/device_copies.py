"""Copies between the CPU systems of the emulation and the buffers on a CUDA device."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any

import torch

from gpu_emulation.buffers import Buffer
from gpu_emulation.physics import EmulatedGpuSystem


class CudaTensorSystem(EmulatedGpuSystem):
    """Emulated GPU system whose buffers are on a CUDA device.

    Each ``gpu_apply_*``, ``gpu_fetch_*`` and ``gpu_query_*`` copies the buffers to the host and, unless it applies,
    back. The host waits for these copies, which PhysX on a GPU does not make: they are hidden from torch's debug mode
    for synchronisations.
    """


@contextmanager
def _undetected_synchronisation() -> Iterator[None]:
    mode = torch.cuda.get_sync_debug_mode()
    torch.cuda.set_sync_debug_mode("default")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode(mode)


def _with_copies(method: Callable[..., Any], writes: bool) -> Callable[..., Any]:
    @wraps(method)
    def call(system: EmulatedGpuSystem, *queries: Any) -> None:
        buffers = [value for value in vars(system).values() if isinstance(value, Buffer)]
        buffers += [query.cuda_impulses for query in queries]
        with _undetected_synchronisation():
            for buffer in buffers:
                buffer.copy_from_device()
            method(system, *queries)
            for buffer in buffers if writes else ():
                buffer.copy_to_device()

    return call


for _name in dir(EmulatedGpuSystem):
    if _name.startswith(("gpu_apply_", "gpu_fetch_", "gpu_query_")):
        _writes = not _name.startswith("gpu_apply_")
        setattr(CudaTensorSystem, _name, _with_copies(getattr(EmulatedGpuSystem, _name), _writes))
