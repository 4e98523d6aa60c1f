"""Check that a block does not make the host wait for the GPU."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from gpu_emulation import emulated_envs


@contextmanager
def no_host_synchronisation() -> Iterator[None]:
    """Fail if the host waits for the GPU within the block.

    Raises:
        AssertionError: it waits, on the emulation; the message has the operations.
        RuntimeError: it waits, on a GPU.
    """
    if emulated_envs() == 0:
        torch.cuda.set_sync_debug_mode("error")
        try:
            yield
        finally:
            torch.cuda.set_sync_debug_mode("default")
        return
    from gpu_emulation.tensors import count_synchronisations

    with count_synchronisations() as counted:
        yield
    assert not counted, f"the host waits for the GPU: {dict(counted)}"
