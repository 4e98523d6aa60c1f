"""Device buffers of the emulated GPU system, and where its values are in the packed state of a CPU system."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gpu_emulation import has_emulated_tensors
from gpu_emulation.tensors import EmulatedTensor

BODY = 13  # position, quaternion wxyz, linear and angular velocity
FROM_PACKED = [4, 5, 6, 0, 1, 2, 3, *range(7, BODY)]
"""Columns of a packed body, which has its quaternion first, in the order of `BODY`."""


class Buffer:
    """Stand-in for SAPIEN's ``CudaArray``.

    Attributes:
        array: its memory on the host, which the emulated device shares and a CUDA device has a copy of.
    """

    def __init__(self, array: NDArray[Any]) -> None:
        self.array = array
        self._host = torch.from_numpy(array)
        self._tensor = EmulatedTensor(self._host) if has_emulated_tensors() else self._host.to("cuda")

    def torch(self) -> torch.Tensor:
        """Return the tensor on the device."""
        return self._tensor

    def copy_from_device(self) -> None:
        """Copy the values from a CUDA device to `array`."""
        if not has_emulated_tensors():
            self._host.copy_(self._tensor)

    def copy_to_device(self) -> None:
        """Copy the values of `array` to a CUDA device."""
        if not has_emulated_tensors():
            self._tensor.copy_(self._host)


@dataclass(frozen=True)
class ArticulationColumns:
    """Where an articulation is: its row in the buffers, its columns in the packed state."""

    articulation: Any
    row: int
    root: slice
    qpos: slice
    qvel: slice
    target_qpos: slice
    target_qvel: slice


class PackedSystem:
    """Reads the state of one CPU system by its packed form.

    Args:
        system: all of its bodies have been made.
        body_rows: rows of dynamic bodies in the buffers.
        articulation_rows: rows of articulations.

    Raises:
        AssertionError: this version of SAPIEN packs states differently.
    """

    def __init__(self, system: Any, body_rows: dict[Any, int], articulation_rows: dict[Any, int]) -> None:
        self._system = system
        self._packed: NDArray[np.float32] | None = None
        self.bodies: list[Any] = system.rigid_dynamic_components
        self.rows = np.array([body_rows[body] for body in self.bodies], int)
        self.articulations: list[ArticulationColumns] = []
        column = len(self.bodies) * BODY
        for link in system.articulation_link_components:
            if link.is_root:
                articulation, dof = link.articulation, link.articulation.dof
                joints = column + BODY
                targets = slice(joints + 2 * dof, joints + 4 * dof, 2)
                columns = ArticulationColumns(
                    articulation,
                    articulation_rows[articulation],
                    root=slice(column, joints),
                    qpos=slice(joints, joints + dof),
                    qvel=slice(joints + dof, joints + 2 * dof),
                    target_qpos=targets,
                    target_qvel=slice(targets.start + 1, targets.stop, 2),
                )
                self.articulations.append(columns)
                column += BODY + 4 * dof
        assert len(system.pack()) == 4 * column, "this version of SAPIEN packs states differently"

    def changed(self) -> None:
        """Note that the system has changed since the last `read`."""
        self._packed = None

    def read(self) -> NDArray[np.float32]:
        """(D,) the packed state."""
        if self._packed is None:
            self._packed = np.frombuffer(self._system.pack(), np.float32)
        return self._packed

    def read_bodies(self) -> NDArray[np.float32]:
        """(B, `BODY`) the states of the dynamic bodies."""
        return self.read()[: len(self.bodies) * BODY].reshape(-1, BODY)[:, FROM_PACKED]
