"""The trainer: any baseline, on a processor, a GPU or several (``accelerate launch``), and on from where it was."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.utils import broadcast_object_list
from torch.optim.swa_utils import AveragedModel
from torch.utils.data import DataLoader

from robocas_ms3.baselines import checkpoints
from robocas_ms3.baselines.baseline import Baseline, BaselineConfig, Batch, Samples
from robocas_ms3.baselines.log import MetricsLog
from robocas_ms3.baselines.metrics import means_of, summed
from robocas_ms3.baselines.runs import CHECKPOINT, RunRecord
from robocas_ms3.baselines.schedule import Batches, epochs_at, learning_rate
from robocas_ms3.core.errors import RobocasError, TrainingError
from robocas_ms3.core.exits import deferred_interrupts, exit_error
from robocas_ms3.core.outputs import OutputFolder


class Trainer:
    """Trains a model, and writes checkpoints, weights and metrics into its run's folder.

    Args:
        baseline: what is trained.
        config: its configuration.
        samples: of training.
        check: of validation; None: there is none.
        output: folder of the run.
        record: of the run.
        accelerator: see `make_accelerator`.
        start: weights to begin with; None: random ones.
        on_note: called with a line when there is something to say.
    """

    def __init__(
        self,
        baseline: Baseline,
        config: BaselineConfig,
        samples: Samples,
        check: Samples | None,
        output: OutputFolder,
        record: RunRecord,
        accelerator: Accelerator,
        *,
        start: Mapping[str, torch.Tensor] | None = None,
        on_note: Callable[[str], None] = lambda text: None,
    ) -> None:
        self.settings, self._samples, self._check = config.train, samples, check
        self._output, self._folder = output, output.path
        self._note, self._accelerator = on_note, accelerator
        self._about = {"baseline": record.baseline, "version": str(record.version), "dataset": record.data.hash}
        torch.manual_seed(self.settings.seed)
        model = baseline.model(config, record.facts)
        if start is not None:
            checkpoints.put_in(model, start, record.start)
        model = model.to(accelerator.device)
        self._average = AveragedModel(model, multi_avg_fn=self._mix) if self.settings.ema else None
        optimizer = torch.optim.AdamW(_groups(model, self.settings.weight_decay), lr=1.0, betas=self.settings.betas)
        self.step = 0
        self._bare = model
        self._sums: dict[str, torch.Tensor] = {}
        self._norms = torch.zeros((), dtype=torch.float64, device=accelerator.device)  # of all gradients, summed up
        kept: dict[str, torch.Tensor] = {}
        if output.recorded is not None and (self._folder / CHECKPOINT).is_file():
            kept = self._go_on(model)
        else:
            torch.manual_seed(self.settings.seed + 1 + accelerator.process_index)
        self._model, self._optimizer = accelerator.prepare(model, optimizer)
        if kept:  # not before: to prepare an optimiser takes its counts of steps to a GPU, which then is waited for
            checkpoints.put_in_optimizer(self._optimizer, kept)

    def train(self, on_step: Callable[[int, int], None] = lambda done, of: None) -> None:
        """Take all steps that are left.

        Args:
            on_step: called with the steps done and all steps.

        Raises:
            TrainingError: the loss or the gradient is no number any more, or somebody removed the folder.
            KeyboardInterrupt: Ctrl-C; what was done is kept, of several processes up to the last checkpoint.
        """
        settings = self.settings
        log = MetricsLog(self._folder, self.step) if self._accelerator.is_main_process else None
        begun = time.monotonic() - (log.seconds if log else 0.0)
        on_step(self.step, settings.steps)
        saved = self.step
        try:
            (validated,) = broadcast_object_list([log is not None and log.has(self.step, "val")])
            if not validated:  # it was broken off
                self._validate(log, begun)
            for batch in self._batches():
                with deferred_interrupts():  # between two steps everything is as a checkpoint has it
                    self._take(batch)
                    last = self.step == settings.steps
                    if last or self.step % settings.log_every == 0:
                        self._tell(log, "train", self._means(), time.monotonic() - begun)
                    if last or self.step % settings.save_every == 0:
                        self._save()
                        saved = self.step
                self._validate(log, begun)
                on_step(self.step, settings.steps)
        except KeyboardInterrupt:
            if self.step > saved and self._accelerator.num_processes == 1:  # several may be at different steps
                self._save()
            raise
        except BaseException:
            if log:
                with suppress(OSError):  # what went wrong is known
                    log.close()
            raise
        if log:
            log.close()

    def parameters(self) -> Iterator[torch.nn.Parameter]:
        """Of the network."""
        return self._bare.parameters()

    def _batches(self) -> Iterator[Batch]:
        accelerator = self._accelerator
        part = (accelerator.process_index, accelerator.num_processes)
        batches = Batches(len(self._samples), self.settings, self.step, part)
        return self._read(self._samples, batches)

    def _read(self, samples: Samples, batches: Iterable[list[int]]) -> Iterator[Batch]:
        """Batches of indices as they are, on the device."""
        for batch in _loader(_Reported(samples), batches, self.settings.workers):
            if isinstance(batch, RobocasError):
                raise batch
            yield {name: tensor.to(self._accelerator.device, non_blocking=True) for name, tensor in batch.items()}

    def _take(self, batch: Batch) -> None:
        rate = learning_rate(self.step, len(self._samples), self.settings)
        for group in self._optimizer.param_groups:
            group["lr"] = rate
        self._model.train()
        with self._accelerator.autocast():
            found = self._model(batch)
        self._accelerator.backward(found["loss"])
        norm: Any = self._accelerator.clip_grad_norm_(self._model.parameters(), self.settings.clip_norm or math.inf)
        if norm.device.type == "cpu":  # a GPU would have to be waited for: its are looked at before they are saved
            self._check_numbers(self.step + 1, loss=found["loss"].detach(), gradient=norm)
        self._norms += norm.detach()
        self._optimizer.step()
        self._optimizer.zero_grad()
        self.step += 1
        if self._average is not None:
            self._average.update_parameters(self._bare)
        self._sums = {name: self._sums.get(name, 0.0) + summed(value, 1) for name, value in found.items()}

    def _mix(self, average: Any, now: Any, _: Any) -> None:
        """Move an average of the weights on: fast at first, as it begins with what is random."""
        decay = min(self.settings.ema, (self.step + 1) / (self.step + 10))
        torch._foreach_lerp_(average, now, 1 - decay)  # pyright: ignore[reportPrivateImportUsage]

    def _means(self) -> dict[str, float]:
        means = means_of(self._of_all(self._sums))
        self._sums = {}
        self._check_numbers(self.step, loss=means["loss"], gradient=self._norms)
        return means

    def _check_numbers(self, step: int, **values: torch.Tensor | float) -> None:
        for name, value in values.items():
            if not math.isfinite(value):
                raise TrainingError(
                    f"the {name} is no number any more",
                    where=f"{self._folder}, step {step}",
                    fix="Start another run from this one (--start), with a lower train.learning_rate.",
                )

    def _of_all(self, sums: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """The sums of all processes."""
        if not sums:
            return {}
        found: Any = self._accelerator.reduce(torch.stack(list(sums.values())), "sum")
        return dict(zip(sums, found, strict=True))

    def _validate(self, log: MetricsLog | None, begun: float) -> None:
        """Where it is time to; an interrupt ends it, and it is made up for."""
        due = self.step == self.settings.steps or (self.step and self.step % self.settings.check_every == 0)
        if self._check is not None and due:
            self._tell(log, "val", self._checked(self._check), time.monotonic() - begun)

    @torch.no_grad()
    def _checked(self, samples: Samples) -> dict[str, float]:
        """Means of the validation split, of the average of the weights; changes nothing of what is to come."""
        accelerator = self._accelerator
        model = self._acting().eval()
        count = min(len(samples), self.settings.check_samples)
        places = torch.linspace(0, len(samples) - 1, count).long().tolist()
        if count >= accelerator.num_processes:  # else each looks at all
            places = places[accelerator.process_index :: accelerator.num_processes]
        size = self.settings.batch_size
        batches = [places[first : first + size] for first in range(0, len(places), size)]
        sums: dict[str, torch.Tensor] = {}
        devices = [accelerator.device] if accelerator.device.type == "cuda" else []
        with torch.random.fork_rng(devices), accelerator.autocast():
            torch.manual_seed(self.settings.seed)
            for chosen, batch in zip(batches, self._read(samples, batches), strict=True):
                for name, value in model(batch).items():
                    sums[name] = summed(value, len(chosen)) + sums.get(name, 0.0)
        return means_of(self._of_all(sums))

    def _tell(self, log: MetricsLog | None, split: str, metrics: dict[str, float], seconds: float) -> None:
        if log is None:
            return
        self._output.check_exists()
        about = {
            "epoch": epochs_at(self.step, len(self._samples), self.settings),
            "seconds": seconds,
            "learning_rate": learning_rate(self.step - 1, len(self._samples), self.settings),
        }
        log.add(self.step, split, about, metrics)
        if split == "val":
            said = ", ".join(f"{name} {value:.4g}" for name, value in metrics.items() if math.isfinite(value))
            self._note(f"step {self.step}, epoch {about['epoch']:.1f}, validation: {said}")

    def _save(self) -> None:
        random, sums = self._random_states(), self._of_all(self._sums)  # for which all processes have to come here
        if any(not torch.isfinite(value).all() for value in (*self._sums.values(), self._norms)):
            return  # the next line of the log ends the run, and the last good checkpoint stays
        tensors = {f"model.{name}": value for name, value in self._bare.state_dict().items()}
        if self._average is not None:
            tensors |= {f"average.{name}": value for name, value in self._average.state_dict().items()}
        optimizer = checkpoints.optimizer_tensors(self._optimizer)
        tensors |= {f"optimizer.{name}": value for name, value in optimizer.items()}
        tensors |= {f"sums.{name}": value for name, value in sums.items()}
        tensors |= {f"random.{name}": state for name, state in random.items()}
        if not self._accelerator.is_main_process:
            return
        self._output.check_exists()
        with deferred_interrupts(second_ends=False):
            about = {**self._about, "step": str(self.step)}
            checkpoints.save_run(self._folder, tensors, self._acting().state_dict(), about)

    def _acting(self) -> torch.nn.Module:
        return self._average.module if self._average is not None else self._bare

    def _random_states(self) -> dict[str, torch.Tensor]:
        """States of the generators by ``cpu`` or ``cuda`` and number of the process, in each of them."""
        own, device = {"cpu": torch.get_rng_state()}, self._accelerator.device
        if device.type == "cuda":
            own["cuda"] = torch.cuda.get_rng_state()
        gathered: dict[str, Any] = {
            kind: self._accelerator.gather(state[None].to(device)) for kind, state in own.items()
        }
        return {f"{kind}.{number}": state for kind, rows in gathered.items() for number, state in enumerate(rows)}

    def _set_random(self, states: dict[str, torch.Tensor], where: Path) -> None:
        begun, now = sum(name.startswith("cpu.") for name in states), self._accelerator.num_processes
        if begun != now:
            fix = f"accelerate launch --num_processes {begun}, or train anew with --overwrite."
            raise TrainingError(
                "a run goes on in as many processes as it began", where=where, expected=begun, found=now, fix=fix
            )
        number = self._accelerator.process_index
        torch.set_rng_state(states[f"cpu.{number}"])
        if f"cuda.{number}" in states and self._accelerator.device.type == "cuda":
            torch.cuda.set_rng_state(states[f"cuda.{number}"])

    def _go_on(self, model: torch.nn.Module) -> dict[str, torch.Tensor]:
        """Go on where the checkpoint was written; gives the optimiser's state."""
        path = self._folder / CHECKPOINT
        tensors, about = checkpoints.load(path, self._about)
        checkpoints.put_in(model, checkpoints.part(tensors, "model."), path)
        if self._average is not None:
            checkpoints.put_in(self._average, checkpoints.part(tensors, "average."), path)
        device = self._accelerator.device
        mine = float(self._accelerator.is_main_process)  # they are those of all
        self._sums = {name: mine * value.to(device) for name, value in checkpoints.part(tensors, "sums.").items()}
        self._set_random(checkpoints.part(tensors, "random."), path)
        self.step = checkpoints.step_of(about, path)
        if self._accelerator.is_main_process:
            checkpoints.mend_weights(self._folder, self._acting().state_dict(), about)
        return checkpoints.part(tensors, "optimizer.")


class _Reported:
    """Samples whose errors are values: a worker's would come as a traceback's text."""

    def __init__(self, samples: Samples) -> None:
        self._samples = samples

    def __len__(self) -> int:
        return len(self._samples)

    def __getitems__(self, indices: list[int]) -> Batch | RobocasError:
        try:
            return self._samples.__getitems__(indices)
        except RobocasError as error:
            return error
        except SystemExit as error:  # a worker would end without a word
            return exit_error(error, "samples of the dataset")


def _loader(samples: Any, batches: Any, workers: int) -> DataLoader:
    return DataLoader(
        samples,
        batch_sampler=batches,
        collate_fn=_as_it_is,
        num_workers=workers,
        persistent_workers=workers > 0,
        generator=torch.Generator(),  # it draws a seed when it begins, as a run that goes on does once more
        multiprocessing_context="forkserver" if workers else None,
    )


def _as_it_is(batch: Any) -> Any:
    return batch


def _groups(model: torch.nn.Module, decay: float) -> list[dict[str, Any]]:
    """Parameters with weight decay, matrices and kernels, and those without."""
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    return [
        {"params": [one for one in parameters if one.ndim > 1], "weight_decay": decay},
        {"params": [one for one in parameters if one.ndim <= 1], "weight_decay": 0.0},
    ]
