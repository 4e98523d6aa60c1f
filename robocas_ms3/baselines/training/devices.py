"""The device of a training run and its precision."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.state import AcceleratorState
from accelerate.utils import DataLoaderConfiguration

from robocas_ms3.baselines.baseline import Precision
from robocas_ms3.core.errors import TrainingError

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # of malloc.h


def make_accelerator(device: str, precision: Precision) -> Accelerator:
    """Return accelerate's accelerator for a device.

    Args:
        device: ``auto`` (a GPU if there is one), ``cpu`` or ``cuda``.
        precision: see `TrainSettings`.

    Raises:
        TrainingError: there is no GPU.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise TrainingError("there is no GPU that torch can use", where="--device", found="cuda", fix="--device cpu")
    cpu = device == "cpu" or not torch.cuda.is_available()
    if cpu:
        _keep_freed_memory()
    if AcceleratorState._shared_state and AcceleratorState().num_processes == 1:  # of an earlier run in this process
        AcceleratorState._reset_state(reset_partial_state=True)
    if precision == "auto":
        is_fast = _cpu_has_bf16() if cpu else torch.cuda.is_bf16_supported(including_emulation=False)
        precision = "bf16" if is_fast else "fp32"
    return Accelerator(
        cpu=cpu,
        mixed_precision="bf16" if precision == "bf16" else "no",
        dataloader_config=DataLoaderConfiguration(dispatch_batches=False),
    )


def describe_hardware(accelerator: Accelerator) -> dict[str, Any]:
    """Return the values of a `RunRecord` on which rounding depends: device, precision, and threads of the CPU."""
    device = accelerator.device.type
    threads = torch.get_num_threads() if device == "cpu" else 0
    return {"device": device, "precision": str(accelerator.mixed_precision), "threads": threads}


def _keep_freed_memory() -> None:
    """Let glibc keep freed memory: to get pages from the system at each step takes a tenth of its time."""
    with suppress(OSError, AttributeError):  # another C library
        libc = ctypes.CDLL(None)
        libc.mallopt(_M_MMAP_MAX, 0)
        libc.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)


def _cpu_has_bf16() -> bool:
    """Return whether the processor has bf16 instructions; without them bf16 is slower than fp32."""
    cpu: Any = torch.cpu
    return any(getattr(cpu, name, bool)() for name in ("_is_avx512_bf16_supported", "_is_amx_tile_supported"))
