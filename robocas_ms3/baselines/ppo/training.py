"""Learning by trying, into a run's folder, and on from where it was."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress

import torch
from accelerate import Accelerator
from torch import nn

from robocas_ms3.baselines import checkpoints
from robocas_ms3.baselines.log import MetricsLog
from robocas_ms3.baselines.ppo.agent import Agent
from robocas_ms3.baselines.ppo.config import PpoConfig
from robocas_ms3.baselines.ppo.rollouts import OUTCOMES, Rollouts, Tried, outcomes, steps_of
from robocas_ms3.baselines.ppo.trials import FIRST_TRIAL, EnvTrials
from robocas_ms3.baselines.runs import CHECKPOINT, RunRecord
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.exits import deferred_interrupts
from robocas_ms3.core.outputs import OutputFolder


class PpoTraining:
    """Learns by trying; see `Training`.

    A run that goes on has the weights, the optimiser, what observations are like, what came of the last episodes and
    the random states of the last update. Its environments begin anew, with the layouts after those that were played:
    so it does not repeat, to the bit, what it would have done had nobody stopped it.

    Args:
        config: see `PpoConfig`.
        trials: environments to try in.
        output: folder of the run.
        record: of the run.
        accelerator: what it computes on; one process.
        start: weights to begin with; None: random ones.
        on_note: called with a line when there is something to say.

    Raises:
        TrainingError: there are several processes, or the checkpoint is of something else.
    """

    def __init__(
        self,
        config: PpoConfig,
        trials: EnvTrials,
        output: OutputFolder,
        record: RunRecord,
        accelerator: Accelerator,
        *,
        start: Mapping[str, torch.Tensor] | None = None,
        on_note: Callable[[str], None] = lambda text: None,
    ) -> None:
        if accelerator.num_processes > 1:
            found, fix = f"{accelerator.num_processes} processes", "Run it without `accelerate launch`."
            raise TrainingError("learns in one process", where=record.baseline, found=found, fix=fix)
        self.config, self._trials, self._note = config, trials, on_note
        self._output, self._folder = output, output.path
        self._about = {"baseline": record.baseline, "version": str(record.version), "dataset": record.data.hash}
        torch.manual_seed(config.train.seed)
        self.agent = Agent(record.facts["observed"], record.facts["acted"], config.width).to(accelerator.device)
        if start is not None:
            checkpoints.put_in(self.agent, start, record.start)
        self.optimizer = torch.optim.Adam(self.agent.parameters(), lr=config.train.learning_rate, eps=1e-5)
        self.step, self._tried_out = 0, False
        self.played = 0, torch.empty(0, len(OUTCOMES))
        if output.recorded is not None and (self._folder / CHECKPOINT).is_file():
            self._go_on()

    def parameters(self) -> Iterator[nn.Parameter]:
        """Of the networks."""
        return self.agent.parameters()

    def train(self, on_step: Callable[[int, int], None] = lambda done, of: None) -> None:
        """Try and learn until all steps are taken, then see what it does in other layouts.

        Args:
            on_step: called with the steps done and all steps.

        Raises:
            TrainingError: the loss is no number any more, or somebody removed the folder.
            KeyboardInterrupt: Ctrl-C; what was learned is kept.
        """
        settings = self.config.train
        log = MetricsLog(self._folder, self.step)
        begun = time.monotonic() - log.seconds
        on_step(min(self.step, settings.steps), settings.steps)
        saved = self.step
        try:
            rollouts = None
            while self.step < settings.steps:
                rollouts = rollouts or Rollouts(self._trials.envs, self.agent, self.config, self.played)
                tried = rollouts.collect()
                with deferred_interrupts():  # between two updates everything is as a checkpoint has it
                    losses = learn(self.agent, self.optimizer, tried, self.config)
                    self._check(losses)
                    self.step += self.config.envs * steps_of(self.config)
                    self.played = rollouts.played, torch.tensor(list(rollouts.episodes)).reshape(-1, len(OUTCOMES))
                    self._tell(log, "train", self.played[1], time.monotonic() - begun, losses)
                    if self.step >= settings.steps or self.step // settings.save_every > saved // settings.save_every:
                        self._save()
                        saved = self.step
                on_step(min(self.step, settings.steps), settings.steps)
            if self.config.trials and not self._tried_out:
                found = try_out(self.agent, self._trials, self.config.trials)
                with deferred_interrupts(second_ends=False):
                    self._tell(log, "val", found, time.monotonic() - begun, {})
                    self._tried_out = True
                    self._save()
        except KeyboardInterrupt:
            if self.step > saved:
                self._save()
            raise
        finally:
            with suppress(OSError):
                log.close()

    def _check(self, losses: dict[str, float]) -> None:
        wrong = [name for name, value in losses.items() if not math.isfinite(value)]
        if wrong:
            raise TrainingError(
                f"the {'gradient' if wrong == ['gradient'] else 'loss'} is no number any more",
                where=f"{self._folder}, step {self.step}",
                fix="Start another run from this one (--start), with a lower train.learning_rate.",
            )

    def _tell(self, log: MetricsLog, split: str, ended: torch.Tensor, seconds: float, losses: dict[str, float]) -> None:
        """Means of what came of episodes (n, 4), NaN of none."""
        self._output.check_exists()
        about = {
            "epoch": self.played[0] / self.config.layouts,
            "seconds": seconds,
            "learning_rate": self.config.train.learning_rate,
        }
        means = dict(zip(OUTCOMES, ended.mean(dim=0).tolist(), strict=True))
        spread = self.agent.log_std.exp().mean().item() if split == "train" else 0.0
        log.add(self.step, split, about, {**means, "noise": spread, **losses})
        if split == "val":
            said = ", ".join(f"{name} {means[name]:.0%}" for name in OUTCOMES[1:])
            self._note(
                f"without noise, in {len(ended)} layouts that are new to it: return {means['return']:.2f}, {said}"
            )

    def _save(self) -> None:
        tensors = {f"model.{name}": value for name, value in self.agent.state_dict().items()}
        optimizer = checkpoints.optimizer_tensors(self.optimizer)
        tensors |= {f"optimizer.{name}": value for name, value in optimizer.items()}
        tensors |= {"episodes.played": torch.tensor(self.played[0]), "episodes.last": self.played[1]}
        tensors |= {"tried_out": torch.tensor(self._tried_out), "random.cpu": torch.get_rng_state()}
        if self.agent.mean.is_cuda:
            tensors["random.cuda"] = torch.cuda.get_rng_state()
        self._output.check_exists()
        about = {**self._about, "step": str(self.step)}
        with deferred_interrupts(second_ends=False):
            checkpoints.save_run(self._folder, tensors, self.agent.state_dict(), about)

    def _go_on(self) -> None:
        path = self._folder / CHECKPOINT
        tensors, about = checkpoints.load(path, self._about)
        checkpoints.put_in(self.agent, checkpoints.part(tensors, "model."), path)
        checkpoints.put_in_optimizer(self.optimizer, checkpoints.part(tensors, "optimizer."))
        self.played = int(tensors["episodes.played"]), tensors["episodes.last"]
        self.step, self._tried_out = checkpoints.step_of(about, path), bool(tensors["tried_out"])
        checkpoints.mend_weights(self._folder, self.agent.state_dict(), about)
        torch.set_rng_state(tensors["random.cpu"])
        if "random.cuda" in tensors and self.agent.mean.is_cuda:
            torch.cuda.set_rng_state(tensors["random.cuda"])


def learn(agent: Agent, optimizer: torch.optim.Optimizer, tried: Tried, config: PpoConfig) -> dict[str, float]:
    """Improve a policy by what was tried; means of its losses, of its entropy and of the gradient's norm."""
    agent.see(tried.obs)
    parts = tried.seen, tried.action, tried.log_prob, tried.advantage, tried.returns
    found = []
    for _ in range(config.epochs):
        for rows in torch.randperm(len(tried.seen)).chunk(config.minibatches):
            seen, action, log_prob, advantage, returns = (part[rows] for part in parts)
            advantage = (advantage - advantage.mean()) / (advantage.std(correction=0) + 1e-8)
            policy = agent.policy(seen)
            ratio = (policy.log_prob(action).sum(-1) - log_prob).exp()
            gain = torch.min(ratio * advantage, ratio.clamp(1 - config.clip, 1 + config.clip) * advantage).mean()
            error = (agent.value(seen) - returns).square().mean()
            entropy = policy.entropy().sum(-1).mean()
            optimizer.zero_grad()
            (error / 2 - gain - config.entropy * entropy).backward()
            norm = nn.utils.clip_grad_norm_(agent.parameters(), config.train.clip_norm or float("inf"))
            optimizer.step()
            found.append(torch.stack([error, -gain, entropy, norm]).detach())
    value, gain, entropy, norm = torch.stack(found).mean(dim=0).tolist()
    return {"value_loss": value, "policy_loss": gain, "entropy": entropy, "gradient": norm}


@torch.inference_mode()
def try_out(agent: Agent, trials: EnvTrials, count: int) -> torch.Tensor:
    """(count, 4) `OUTCOMES` of episodes in layouts that were not learned from, without noise."""
    envs = trials.make(count, FIRST_TRIAL, FIRST_TRIAL + count - 1)
    try:
        obs, info = envs.reset(seed=FIRST_TRIAL)
        while "final_info" not in info:  # all end at once
            obs, _, _, _, info = envs.step(agent.best(obs))  # pyright: ignore[reportArgumentType]
    finally:
        envs.close()
    return outcomes(info)
