"""Check that a block does not make the host wait for the GPU, or count how often it does."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from gpu_emulation import has_emulated_tensors


@contextmanager
def no_host_synchronisation() -> Iterator[None]:
    """Fail if the host waits for the GPU within the block.

    Raises:
        AssertionError: it waits, on the emulated device; the message has the operations.
        RuntimeError: it waits, on a GPU.
    """
    if has_emulated_tensors():
        with count_host_synchronisations() as counted:
            yield
        assert not counted, f"the host waits for the GPU: {dict(counted)}"
        return
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


@contextmanager
def count_host_synchronisations() -> Iterator[Counter[str]]:
    """Count the operations, by name or line of the program, for which the host waits for the GPU within the block."""
    if has_emulated_tensors():
        from gpu_emulation.tensors import count_synchronisations

        with count_synchronisations() as counted:
            yield counted
        return
    counted = Counter[str]()
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield counted
    finally:
        torch.cuda.set_sync_debug_mode("default")
    counted.update(f"{w.filename}:{w.lineno}" for w in caught if "synchronizing CUDA operation" in str(w.message))
