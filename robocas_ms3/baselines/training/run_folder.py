"""The folder of a training run, as a training loop uses it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from types import TracebackType

import torch
from accelerate import Accelerator

from robocas_ms3.baselines.baseline import Progress
from robocas_ms3.baselines.training import checkpoints
from robocas_ms3.baselines.training.checkpoints import Checkpoint
from robocas_ms3.baselines.training.devices import count_threads
from robocas_ms3.baselines.training.metrics import MetricsLog
from robocas_ms3.baselines.training.record import CHECKPOINT, WEIGHTS, RunRecord
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.exits import deferred_interrupts
from robocas_ms3.core.outputs import OutputFolder


class RunFolder:
    """Writes record, metrics, checkpoints and weights of a run; only its main process writes.

    As a context manager it closes the log.

    Args:
        output: the locked folder.
        record: of the run; of a run that continues, the recorded one.
        accelerator: that it is trained on.
        progress: functions to report to.

    Attributes:
        record: of the run.
        accelerator: that it is trained on.
        progress: functions to report to.
    """

    def __init__(self, output: OutputFolder, record: RunRecord, accelerator: Accelerator, progress: Progress) -> None:
        self.record, self.accelerator, self.progress = record, accelerator, progress
        self._output = output
        self._about = {"baseline": record.baseline, "version": str(record.version), "dataset": record.data.hash}
        self._log: MetricsLog | None = None
        self._started_at = 0.0

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._log is None:
            return
        if error is None:
            self._log.close()
        else:
            with suppress(OSError):
                self._log.close()

    def load_checkpoint(self) -> Checkpoint | None:
        """Return the checkpoint of a run that continues; None: there is none, and the run starts from step 0.

        Raises:
            TrainingError: it is damaged or of something else.
        """
        path = self._output.path / CHECKPOINT
        if self._output.recorded is None or not path.is_file():
            return None
        return checkpoints.load_checkpoint(path, self._about)

    def start(self, step: int, model: torch.nn.Module, size: str) -> None:
        """Write the record, open the log and report what is trained.

        Args:
            step: of the checkpoint, or 0.
            model: to train.
            size: of the data, for the report.
        """
        accelerator, record = self.accelerator, self.record
        changes = _hardware_changes(record, accelerator)
        if self._output.recorded is not None and changes:
            record.resumed.append(f"from step {step} by {changes}")
            self.progress.note(f"continues {record.resumed[-1]}: results differ from those of an uninterrupted run")
        if accelerator.is_main_process:
            self._output.start(record.model_dump(mode="json"))
        accelerator.wait_for_everyone()
        parameters = sum(parameter.numel() for parameter in model.parameters()) / 1e6
        precision = "bf16" if accelerator.mixed_precision == "bf16" else "fp32"
        device = accelerator.device.type
        self.progress.note(f"{record.baseline}: {parameters:.2f} M parameters, {size}, {device}, {precision}")
        if accelerator.is_main_process:
            self._log = MetricsLog(self._output.path, step)
        self._started_at = time.monotonic() - (self._log.seconds if self._log else 0.0)

    def has_logged(self, step: int, split: str) -> bool:
        """Return whether a run that continues has logged a line before; always False in other processes."""
        return self._log is not None and self._log.has(step, split)

    def log(self, step: int, split: str, metrics: Mapping[str, float], *, epoch: float, learning_rate: float) -> None:
        """Log metrics.

        Raises:
            RobocasError: somebody removed the folder.
        """
        if self._log is None:
            return
        self._output.check_exists()
        seconds = time.monotonic() - self._started_at
        self._log.add(step, split, {"epoch": epoch, "seconds": seconds, "learning_rate": learning_rate}, metrics)

    def save(self, step: int, state: Mapping[str, torch.Tensor], weights: Mapping[str, torch.Tensor]) -> None:
        """Write the weights of the policy, then the checkpoint: the weights of the last step are never missing.

        Raises:
            RobocasError: somebody removed the folder.
        """
        if not self.accelerator.is_main_process:
            return
        self._output.check_exists()
        about = {**self._about, "step": str(step)}
        with deferred_interrupts(second_ends=False):
            checkpoints.save(self._output.path / WEIGHTS, weights, about)
            checkpoints.save(self._output.path / CHECKPOINT, state, about)

    def repair_weights(self, step: int, weights: Mapping[str, torch.Tensor]) -> None:
        """Write the weights of the policy if they are missing, damaged, or of another step than the checkpoint."""
        if not self.accelerator.is_main_process:
            return
        path, about = self._output.path / WEIGHTS, {**self._about, "step": str(step)}
        try:
            checkpoints.load(path, about)
        except TrainingError:
            checkpoints.save(path, weights, about)

    def error(self, message: str, step: int) -> TrainingError:
        """Return an error about NaN or infinite values at a step."""
        return TrainingError(
            message,
            where=f"{self._output.path}, step {step}",
            fix="Start another run from this one (--start), with a lower train.learning_rate.",
        )


def _hardware_changes(record: RunRecord, accelerator: Accelerator) -> str:
    """Return how this hardware differs from that of the record, which changes results; empty: it does not."""
    now = {
        "device": str(accelerator.device.type),
        "precision": str(accelerator.mixed_precision),
        "threads": count_threads(accelerator) if record.threads else 0,
    }
    return ", ".join(f"{name} {value}" for name, value in now.items() if getattr(record, name) != value)
