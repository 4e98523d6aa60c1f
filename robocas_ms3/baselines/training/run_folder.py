"""Folder and device of a training run, for the training loops."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.state import AcceleratorState
from accelerate.utils import DataLoaderConfiguration, broadcast_object_list

from robocas_ms3.baselines.baseline import Precision, Progress
from robocas_ms3.baselines.training import checkpoints
from robocas_ms3.baselines.training.checkpoints import Checkpoint, Tensors
from robocas_ms3.baselines.training.metrics import MetricsLog
from robocas_ms3.baselines.training.record import CHECKPOINT, WEIGHTS, RunRecord
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.output_folder import OutputFolder
from robocas_ms3.core.signals import deferred_interrupts

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # of malloc.h


class RunFolder:
    """Writer of a run's record, metrics, checkpoints and weights; only the main process writes.

    Attributes:
        record: record of the run.
        accelerator: accelerate's accelerator, which has the device.
        progress: functions that report the progress.
        checkpoint: checkpoint to continue from; None: the run starts from step 0.
    """

    def __init__(self, output: OutputFolder, record: RunRecord, accelerator: Accelerator, progress: Progress) -> None:
        self.record, self.accelerator, self.progress = record, accelerator, progress
        self._output = output
        self._log: MetricsLog | None = None
        self._started_at = 0.0
        path = output.path / CHECKPOINT
        is_continued = output.recorded is not None and path.is_file()
        self.checkpoint: Checkpoint | None = checkpoints.load(path, record.metadata) if is_continued else None

    def close(self) -> None:
        if self._log is not None:
            self._log.close()

    def start(self, step: int, model: torch.nn.Module, weights: Tensors, size: str) -> None:
        """Write the record and open the log; rewrite the weights if their step is not that of the checkpoint.

        Args:
            step: first step.
            model: the network.
            weights: weights of the policy at that step.
            size: size of the training data, for the log.
        """
        accelerator, record = self.accelerator, self.record
        changes = _hardware_changes(record, accelerator)
        if self._output.recorded is not None and changes:
            record.hardware_changes.append(f"from step {step}: {changes}")
            what = "the result will differ from that of an uninterrupted run"
            self.progress.message(f"hardware changed {record.hardware_changes[-1]}; {what}")
        if accelerator.is_main_process:
            self._output.start(record.model_dump(mode="json"))
            if self.checkpoint is not None:
                self._repair_weights(step, weights)
        accelerator.wait_for_everyone()
        parameters = sum(parameter.numel() for parameter in model.parameters()) / 1e6
        precision = "bf16" if accelerator.mixed_precision == "bf16" else "fp32"
        device = accelerator.device.type
        self.progress.message(f"{record.baseline}: {parameters:.2f} M parameters, {size}, {device}, {precision}")
        if accelerator.is_main_process:
            self._log = MetricsLog(self._output.path, step)
        self._started_at = time.monotonic() - (self._log.seconds if self._log else 0.0)

    def has_logged(self, step: int, split: str) -> bool:
        """Return whether a line was logged before this run continued; call it in all processes."""
        return broadcast_object_list([self._log is not None and self._log.has(step, split)])[0]

    def log(self, step: int, split: str, metrics: Mapping[str, float], *, epoch: float, learning_rate: float) -> None:
        if self._log is None:
            return
        self._output.check_exists()
        seconds = time.monotonic() - self._started_at
        self._log.add(step, split, {"epoch": epoch, "seconds": seconds, "learning_rate": learning_rate}, metrics)

    def save(self, step: int, state: Tensors, weights: Tensors) -> None:
        """Write the weights of the policy, then the checkpoint, so that weights are never missing."""
        if not self.accelerator.is_main_process:
            return
        self._output.check_exists()
        with deferred_interrupts(second_ends=False):
            checkpoints.save(self._output.path / WEIGHTS, weights, self.record.metadata, step)
            checkpoints.save(self._output.path / CHECKPOINT, state, self.record.metadata, step)

    def make_error(self, message: str, step: int) -> TrainingError:
        """Make the error of a failed step."""
        return TrainingError(
            message,
            where=f"{self._output.path}, step {step}",
            fix="Start another run from this run's weights: --init-from RUN, with a lower train.learning_rate.",
        )

    def _repair_weights(self, step: int, weights: Tensors) -> None:
        path = self._output.path / WEIGHTS
        try:
            checkpoints.load(path, {**self.record.metadata, "step": str(step)})
        except TrainingError:
            checkpoints.save(path, weights, self.record.metadata, step)


def _hardware_changes(record: RunRecord, accelerator: Accelerator) -> str:
    """Return how this hardware differs from the recorded one, which changes rounding; empty if equal."""
    now = describe_hardware(accelerator) | ({} if record.threads else {"threads": 0})
    return ", ".join(f"{name} {value}" for name, value in now.items() if getattr(record, name) != value)


def make_accelerator(device: str, precision: Precision) -> Accelerator:
    """Make accelerate's accelerator for a device: ``auto`` (a GPU if there is one), ``cpu`` or ``cuda``."""
    if device == "cuda" and not torch.cuda.is_available():
        raise TrainingError("no GPU available to torch", where="--device", found="cuda", fix="Pass --device cpu.")
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
    """Return the values of a `RunRecord` that determine rounding: device, precision, CPU threads."""
    device = accelerator.device.type
    threads = torch.get_num_threads() if device == "cpu" else 0
    return {"device": device, "precision": str(accelerator.mixed_precision), "threads": threads}


def _keep_freed_memory() -> None:
    """Let glibc keep freed memory: requesting pages from the system takes 10 % of a training step."""
    with suppress(OSError, AttributeError):  # another C library
        libc = ctypes.CDLL(None)
        libc.mallopt(_M_MMAP_MAX, 0)
        libc.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)


def _cpu_has_bf16() -> bool:
    """Return whether the CPU has bf16 instructions; without them bf16 is slower than fp32."""
    cpu: Any = torch.cpu
    return any(getattr(cpu, name, bool)() for name in ("_is_avx512_bf16_supported", "_is_amx_tile_supported"))
