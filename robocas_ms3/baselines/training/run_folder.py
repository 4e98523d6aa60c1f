"""Run folder and device that the training loops use."""

from __future__ import annotations

import ctypes
import platform
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.state import AcceleratorState
from accelerate.utils import DataLoaderConfiguration, broadcast_object_list

from robocas_ms3.baselines.baseline import Precision, ProgressCallbacks
from robocas_ms3.baselines.training import checkpoints
from robocas_ms3.baselines.training.checkpoints import Checkpoint, Tensors
from robocas_ms3.baselines.training.metrics import MetricsLog
from robocas_ms3.baselines.training.record import CHECKPOINT, WEIGHTS, RunRecord
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.output_folder import OutputFolder
from robocas_ms3.core.signals import defer_interrupts
from robocas_ms3.core.text import format_count

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # of malloc.h


class RunFolder:
    """Folder of a training run: writes record, metrics, checkpoint and weights, in the main process only.

    Attributes:
        record: record of the run.
        accelerator: ``accelerate.Accelerator``, which has device, precision and processes of the training.
        progress: functions that report the progress.
        checkpoint: checkpoint from which the run continues; None: the run starts at step 0.
    """

    def __init__(
        self, output: OutputFolder, record: RunRecord, accelerator: Accelerator, progress: ProgressCallbacks
    ) -> None:
        self.record, self.accelerator, self.progress = record, accelerator, progress
        self._output = output
        self._log: MetricsLog | None = None
        self._started_at = 0.0
        path = output.path / CHECKPOINT
        is_continued = output.recorded is not None and path.is_file()
        self.checkpoint: Checkpoint | None = (
            checkpoints.load_checkpoint(path, record.metadata) if is_continued else None
        )

    def close(self) -> None:
        if self._log is not None:
            self._log.close()

    def start(self, step: int, model: torch.nn.Module, weights: Tensors, data_size: str) -> None:
        """Write the record, report the size of the training, and open the log.

        If the weights file and the checkpoint have different steps, the weights file is written again.

        Args:
            step: number of training steps that are done.
            model: the network.
            weights: weights of the policy at this step.
            data_size: text with the number of samples, for the progress message.
        """
        accelerator, record = self.accelerator, self.record
        changes = _list_hardware_changes(record, accelerator)
        if self._output.recorded is not None and changes:
            record.hardware_changes.append(f"from step {step}: {changes}")
            what = "the result will differ from that of an uninterrupted run"
            self.progress.message(f"other hardware {record.hardware_changes[-1]}; {what}")
        if accelerator.is_main_process:
            self._output.start(record.model_dump(mode="json"))
            if self.checkpoint is not None:
                self._repair_weights(step, weights)
        accelerator.wait_for_everyone()
        parameters = sum(parameter.numel() for parameter in model.parameters()) / 1e6
        precision = "bf16" if accelerator.mixed_precision == "bf16" else "fp32"
        device = accelerator.device.type
        self.progress.message(f"{record.baseline}: {parameters:.2f} M parameters, {data_size}, {device}, {precision}")
        if accelerator.is_main_process:
            self._log = MetricsLog(self._output.path, step)
        self._started_at = time.monotonic() - (self._log.seconds if self._log else 0.0)

    def has_logged(self, step: int, split: str) -> bool:
        """Return whether the log had a line of this step and split at the start; all processes must call it."""
        return broadcast_object_list([self._log is not None and self._log.has_line(step, split)])[0]

    def log(self, step: int, split: str, metrics: Mapping[str, float], *, epoch: float, learning_rate: float) -> None:
        """Write the metrics of a step to the log; ``split`` is ``train`` or ``val``."""
        if self._log is None:
            return
        self._output.check_exists()
        seconds = time.monotonic() - self._started_at
        self._log.add(step, split, {"epoch": epoch, "seconds": seconds, "learning_rate": learning_rate}, metrics)

    def save(self, step: int, state: Tensors, weights: Tensors) -> None:
        """Write the weights of the policy, then the checkpoint, so that each checkpoint has its weights.

        state: tensors of the checkpoint. weights: tensors of the policy's network.
        """
        if not self.accelerator.is_main_process:
            return
        self._output.check_exists()
        with defer_interrupts(second_ends=False):
            checkpoints.save_tensors(self._output.path / WEIGHTS, weights, self.record.metadata, step)
            checkpoints.save_tensors(self._output.path / CHECKPOINT, state, self.record.metadata, step)

    def make_step_error(self, message: str, step: int) -> TrainingError:
        """Make the error of a training step that failed, with the folder, the step and a fix."""
        return TrainingError(
            message,
            where=f"{self._output.path}, step {step}",
            fix="Start a new run from this one with --init-from, with a lower train.learning_rate.",
        )

    def _repair_weights(self, step: int, weights: Tensors) -> None:
        path = self._output.path / WEIGHTS
        try:
            checkpoints.load_checkpoint(path, {**self.record.metadata, "step": str(step)})
        except TrainingError:
            checkpoints.save_tensors(path, weights, self.record.metadata, step)


def _list_hardware_changes(record: RunRecord, accelerator: Accelerator) -> str:
    """Return the hardware values that differ from the recorded ones, such as ``threads 4``; or empty."""
    now = describe_hardware(accelerator) | ({} if record.threads else {"threads": 0})
    return ", ".join(f"{name} {value}" for name, value in now.items() if getattr(record, name) != value)


def make_accelerator(device: str, precision: Precision) -> Accelerator:
    """Make the ``Accelerator`` of accelerate.

    device: ``auto`` (a GPU if there is one), ``cpu`` or ``cuda``. precision: ``auto`` is bf16 if the hardware
    has it.

    Raises:
        TrainingError: ``cuda`` without a GPU.
    """
    if device == "cuda" and not torch.cuda.is_available():
        fix = "Pass --device cpu, or install a build of torch for your GPU."
        raise TrainingError("torch finds no GPU", where="--device", found="cuda", fix=fix)
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
    """Return ``device``, ``precision`` and ``threads`` of a `RunRecord`: these values determine rounding."""
    device = accelerator.device.type
    threads = torch.get_num_threads() if device == "cpu" else 0
    return {"device": device, "precision": str(accelerator.mixed_precision), "threads": threads}


def name_hardware(accelerator: Accelerator) -> str:
    """Return the number of processes and the name of their processor, such as "1 x x86_64 CPU, 2 threads"."""
    if accelerator.device.type == "cuda":
        name = torch.cuda.get_device_name(accelerator.device)
    else:
        name = f"{platform.machine()} CPU, {format_count(torch.get_num_threads(), 'thread')}"
    return f"{accelerator.num_processes} x {name}"


def _keep_freed_memory() -> None:
    """Let glibc keep freed memory; otherwise requests of memory pages take 10 % of a training step."""
    with suppress(OSError, AttributeError):  # another C library
        libc = ctypes.CDLL(None)
        libc.mallopt(_M_MMAP_MAX, 0)
        libc.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)


def _cpu_has_bf16() -> bool:
    """Return whether the CPU has bf16 instructions; without them bf16 is slower than fp32."""
    cpu: Any = torch.cpu
    return any(getattr(cpu, name, bool)() for name in ("_is_avx512_bf16_supported", "_is_amx_tile_supported"))
