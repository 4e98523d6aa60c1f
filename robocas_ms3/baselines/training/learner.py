"""Learner of supervised training: takes optimiser steps, averages weights, and sums metrics."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch.optim.swa_utils import AveragedModel

from robocas_ms3.baselines.baseline import Batch, TrainSettings
from robocas_ms3.baselines.training.checkpoints import Checkpoint, flatten_optimizer_state, join_state_dicts
from robocas_ms3.baselines.training.metrics import compute_means, convert_to_sum_and_count
from robocas_ms3.baselines.training.run_folder import RunFolder
from robocas_ms3.core.errors import TrainingError


class Learner:
    """Network with its optimiser, the average of its weights and the sums of its metrics.

    The learner continues from the checkpoint of the run, if there is one. The policy has the average of the weights if
    ``settings.ema`` is above 0, otherwise the weights of the network.

    Attributes:
        step: number of optimiser steps done.
    """

    def __init__(self, run: RunFolder, model: torch.nn.Module, settings: TrainSettings) -> None:
        self.step = 0
        self._run, self._accelerator, self._settings = run, run.accelerator, settings
        self._network = model
        self._average = (
            AveragedModel(model, multi_avg_fn=self._update_average, use_buffers=True) if settings.ema else None
        )
        self._sums: dict[str, torch.Tensor] = {}  # of metrics since the last line of the log
        self._norms = torch.zeros((), dtype=torch.float64, device=self._accelerator.device)  # sum of gradients' norms
        if run.checkpoint is None:
            torch.manual_seed(settings.seed + 1 + self._accelerator.process_index)
        else:
            self._restore(run.checkpoint)
        optimizer = torch.optim.AdamW(
            _make_parameter_groups(model, settings.weight_decay), lr=1.0, betas=settings.betas
        )
        self._model, self._optimizer = self._accelerator.prepare(model, optimizer)
        if run.checkpoint is not None:  # after `prepare`: it moves step counts to the GPU, and steps would wait
            run.checkpoint.load_optimizer(self._optimizer)

    def update(self, batch: Batch, learning_rate: float) -> None:
        """Take an optimiser step with a batch.

        Raises:
            TrainingError: loss or gradient is NaN or infinite. On a GPU, the next `pop_means` raises the error.
        """
        for group in self._optimizer.param_groups:
            group["lr"] = learning_rate
        self._model.train()
        with self._accelerator.autocast():
            metrics = self._model(batch)
        self._accelerator.backward(metrics["loss"])
        clip_norm = self._settings.clip_norm or math.inf
        norm: Any = self._accelerator.clip_grad_norm_(self._model.parameters(), clip_norm)
        if norm.device.type == "cpu":
            self.check_finite(self.step + 1, loss=metrics["loss"].detach(), gradient=norm)
        self._norms += norm.detach()
        self._optimizer.step()
        self._optimizer.zero_grad()
        self.step += 1
        if self._average is not None:
            self._average.update_parameters(self._network)
        self._sums = {
            name: self._sums.get(name, 0.0) + convert_to_sum_and_count(value, 1) for name, value in metrics.items()
        }

    def pop_means(self) -> dict[str, float]:
        """Return the means of the metrics over the steps since the last call and over all processes.

        Raises:
            TrainingError: loss or gradient of a step is NaN or infinite.
        """
        means = compute_means(self._sum_over_processes(self._sums))
        self._sums = {}
        self.check_finite(self.step, loss=means["loss"], gradient=self._norms)
        return means

    @torch.no_grad()
    def evaluate(self, batches: Iterable[tuple[int, Batch]]) -> dict[str, float]:
        """Return the mean metrics of the policy's network over validation batches, and over all processes.

        batches: this process's batches, each with its number of samples.
        """
        model = self._policy_model().eval()
        device = self._accelerator.device
        sums: dict[str, torch.Tensor] = {}
        with torch.random.fork_rng([device] if device.type == "cuda" else []), self._accelerator.autocast():
            torch.manual_seed(self._settings.seed)
            for size, batch in batches:
                for name, value in model(batch).items():
                    sums[name] = convert_to_sum_and_count(value, size) + sums.get(name, 0.0)
        return compute_means(self._sum_over_processes(sums))

    def check_finite(self, step: int, **values: torch.Tensor | float) -> None:
        """Raise TrainingError if one of the values is NaN or infinite; the error names the value and the step."""
        for name, value in values.items():
            if not math.isfinite(value):
                raise self._run.make_step_error(f"the {name} is NaN or infinite", step)

    def policy_weights(self) -> dict[str, torch.Tensor]:
        """Return the state dict of the policy's network in the precision of the weights file."""
        weights = self._policy_model().state_dict()
        if self._settings.weights_precision == "fp16":
            weights = {name: value.half() if value.is_floating_point() else value for name, value in weights.items()}
            if not all(torch.isfinite(value).all() for value in weights.values()):
                raise self._run.make_step_error("a weight is too large for fp16 (train.weights_precision)", self.step)
        return weights

    def save(self) -> None:
        """Write the checkpoint and the policy's weights; all processes must call this function.

        It writes nothing if a metric is NaN or infinite. Then the next `pop_means` raises an error.
        """
        random, sums = self._random_states(), self._sum_over_processes(self._sums)
        if all(torch.isfinite(value).all() for value in (*self._sums.values(), self._norms)):
            state = join_state_dicts(
                model=self._network.state_dict(),
                average={} if self._average is None else self._average.state_dict(),
                optimizer=flatten_optimizer_state(self._optimizer),
                sums=sums,
                random=random,
            )
            self._run.save(self.step, state, self.policy_weights())

    def _restore(self, checkpoint: Checkpoint) -> None:
        checkpoint.load_model(self._network, "model")
        if self._average is not None:
            checkpoint.load_model(self._average, "average")
        is_main = float(self._accelerator.is_main_process)  # the sums are those of all processes
        device = self._accelerator.device
        self._sums = {name: is_main * value.to(device) for name, value in checkpoint.state_dict("sums").items()}
        self._restore_random(checkpoint)
        self.step = checkpoint.step

    def _policy_model(self) -> torch.nn.Module:
        return self._average.module if self._average is not None else self._network

    def _update_average(self, average: Any, weights: Any, _: Any) -> None:
        """Update the average of the weights and of the statistics of norms; counters are copied.

        The decay is lower at the start, because the first weights are random.
        """
        if not average[0].is_floating_point():
            torch._foreach_copy_(average, weights)  # pyright: ignore[reportPrivateImportUsage]
            return
        decay = min(self._settings.ema, (self.step + 1) / (self.step + 10))
        torch._foreach_lerp_(average, weights, 1 - decay)  # pyright: ignore[reportPrivateImportUsage]

    def _sum_over_processes(self, sums: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        if not sums:
            return {}
        reduced: Any = self._accelerator.reduce(torch.stack(list(sums.values())), "sum")
        return dict(zip(sums, reduced, strict=True))

    def _random_states(self) -> dict[str, torch.Tensor]:
        """Return the random states of all processes, by ``cpu.PROCESS`` and ``cuda.PROCESS``."""
        states, device = {"cpu": torch.get_rng_state()}, self._accelerator.device
        if device.type == "cuda":
            states["cuda"] = torch.cuda.get_rng_state()
        gathered: dict[str, Any] = {
            kind: self._accelerator.gather(state[None].to(device)) for kind, state in states.items()
        }
        return {f"{kind}.{number}": state for kind, rows in gathered.items() for number, state in enumerate(rows)}

    def _restore_random(self, checkpoint: Checkpoint) -> None:
        states = checkpoint.state_dict("random")
        processes = sum(name.startswith("cpu.") for name in states)
        if processes != self._accelerator.num_processes:
            raise TrainingError(
                "cannot continue this run with another number of processes",
                where=checkpoint.path,
                expected=processes,
                found=self._accelerator.num_processes,
                fix=f"Use `accelerate launch --num_processes {processes}`, or start again with --overwrite.",
            )
        number = self._accelerator.process_index
        torch.set_rng_state(states[f"cpu.{number}"])
        if f"cuda.{number}" in states and self._accelerator.device.type == "cuda":
            torch.cuda.set_rng_state(states[f"cuda.{number}"])


def _make_parameter_groups(model: torch.nn.Module, decay: float) -> list[dict[str, Any]]:
    """Return two parameter groups: matrices and kernels with weight decay, others without."""
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    return [
        {"params": [parameter for parameter in parameters if parameter.ndim > 1], "weight_decay": decay},
        {"params": [parameter for parameter in parameters if parameter.ndim <= 1], "weight_decay": 0.0},
    ]
