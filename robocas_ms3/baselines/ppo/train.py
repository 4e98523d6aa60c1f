"""Proximal policy optimisation (Schulman et al. 2017)."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import torch
from gymnasium.vector import VectorEnv
from torch import nn

from robocas_ms3.baselines.ppo.agent import Agent
from robocas_ms3.baselines.ppo.config import PpoConfig
from robocas_ms3.baselines.ppo.environments import FIRST_TEST_SEED, PpoEnvironments
from robocas_ms3.baselines.training.checkpoints import Checkpoint, join_parts, optimizer_tensors
from robocas_ms3.baselines.training.run_folder import RunFolder
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.signals import deferred_interrupts

OUTCOMES = ("return", "held", "lifted", "success")  # of an episode; except the return, at its last step
_LAST_EPISODES = 100  # averaged in the log


def train_ppo(run: RunFolder, agent: Agent, config: PpoConfig, environments: PpoEnvironments) -> None:
    """Train an agent up to the last step, then test it without noise in other layouts.

    A run that continues restores weights, optimiser, observation statistics, outcomes of the last episodes and random
    states of the last update. Its environments start again with the next layouts, so the result is not bit-identical
    to that of an uninterrupted run.
    """
    if run.accelerator.num_processes > 1:
        found, fix = f"{run.accelerator.num_processes} processes", "Call robocas train without `accelerate launch`."
        raise TrainingError("ppo trains in one process only", where=run.record.baseline, found=found, fix=fix)
    settings = config.train
    state = _TrainingState(agent, config, run.checkpoint)
    size = f"{len(environments)} steps in {environments.episodes} layouts"
    run.start(state.step, agent, agent.state_dict(), size)

    def log(split: str, outcomes: torch.Tensor, metrics: dict[str, float]) -> None:
        epoch = state.episodes / config.layouts
        means = dict(zip(OUTCOMES, outcomes.mean(dim=0).tolist(), strict=True))
        run.log(state.step, split, {**means, **metrics}, epoch=epoch, learning_rate=settings.learning_rate)

    def save() -> None:
        run.save(state.step, state.tensors(), agent.state_dict())

    run.progress.on_step(min(state.step, settings.steps), settings.steps)
    saved_step = state.step
    collector = None
    try:
        while state.step < settings.steps:
            collector = collector or RolloutCollector(environments.envs, agent, config, state.episodes, state.outcomes)
            rollout = collector.collect()
            with deferred_interrupts():  # interrupt only after a complete update
                losses = update(agent, state.optimizer, rollout, config)
                state.step += config.envs * steps_per_env(config)
                _check_finite(run, losses, state.step)
                state.episodes, state.outcomes = collector.episodes, collector.last_outcomes()
                log("train", state.outcomes, {"noise": agent.log_std.exp().mean().item(), **losses})
                is_last = state.step >= settings.steps
                if is_last or state.step // settings.save_every > saved_step // settings.save_every:
                    save()
                    saved_step = state.step
            run.progress.on_step(min(state.step, settings.steps), settings.steps)
        if config.test_episodes and not state.is_tested:
            outcomes = evaluate_agent(agent, environments, config.test_episodes)
            with deferred_interrupts(second_ends=False):
                log("val", outcomes, {"noise": 0.0})
                state.is_tested = True
                save()
            mean_return, *rates = outcomes.mean(dim=0).tolist()
            text = ", ".join(f"{name} {rate:.0%}" for name, rate in zip(OUTCOMES[1:], rates, strict=True))
            run.progress.message(f"test without noise, {len(outcomes)} other layouts: return {mean_return:.2f}, {text}")
    except KeyboardInterrupt:
        if state.step > saved_step:
            save()
        raise


def update(agent: Agent, optimizer: torch.optim.Optimizer, rollout: Rollout, config: PpoConfig) -> dict[str, float]:
    """Update an agent with a rollout; return the mean losses, entropy and gradient norm."""
    agent.update_statistics(rollout.obs)
    tensors = rollout.normalized, rollout.action, rollout.log_prob, rollout.advantage, rollout.returns
    metrics = []
    for _ in range(config.epochs):
        for rows in torch.randperm(len(rollout.normalized)).chunk(config.minibatches):
            obs, action, log_prob, advantage, returns = (tensor[rows] for tensor in tensors)
            advantage = (advantage - advantage.mean()) / (advantage.std(correction=0) + 1e-8)
            policy = agent.policy(obs)
            ratio = (policy.log_prob(action).sum(-1) - log_prob).exp()
            gain = torch.min(
                ratio * advantage, ratio.clamp(1 - config.clip_range, 1 + config.clip_range) * advantage
            ).mean()
            error = (agent.value(obs) - returns).square().mean()
            entropy = policy.entropy().sum(-1).mean()
            optimizer.zero_grad()
            (error / 2 - gain - config.entropy_coeff * entropy).backward()
            norm = nn.utils.clip_grad_norm_(agent.parameters(), config.train.clip_norm or float("inf"))
            optimizer.step()
            metrics.append(torch.stack([error, -gain, entropy, norm]).detach())
    value, gain, entropy, norm = torch.stack(metrics).mean(dim=0).tolist()
    return {"value_loss": value, "policy_loss": gain, "entropy": entropy, "gradient": norm}


@torch.inference_mode()
def evaluate_agent(agent: Agent, environments: PpoEnvironments, count: int) -> torch.Tensor:
    """Return `OUTCOMES` (count, 4) of test episodes without noise, in layouts that were not trained on."""
    envs = environments.make(count, FIRST_TEST_SEED, FIRST_TEST_SEED + count - 1)
    try:
        obs, info = envs.reset(seed=FIRST_TEST_SEED)
        while "final_info" not in info:  # all episodes end at the same step
            obs, _, _, _, info = envs.step(agent.mean_action(obs))  # pyright: ignore[reportArgumentType]
    finally:
        envs.close()
    return read_outcomes(info)


class _TrainingState:
    """State of a PPO training: optimiser, counts of steps and episodes, outcomes of the last episodes."""

    def __init__(self, agent: Agent, config: PpoConfig, checkpoint: Checkpoint | None) -> None:
        self.optimizer = torch.optim.Adam(agent.parameters(), lr=config.train.learning_rate, eps=1e-5)
        self.step, self.episodes, self.is_tested = 0, 0, False
        self.outcomes = torch.empty(0, len(OUTCOMES))
        self._agent = agent
        if checkpoint is None:
            return
        tensors = checkpoint.tensors
        checkpoint.load_model(agent, "model")
        checkpoint.load_optimizer(self.optimizer)
        self.episodes, self.outcomes = int(tensors["episodes.count"]), tensors["episodes.last"]
        self.step, self.is_tested = checkpoint.step, bool(tensors["is_tested"])
        torch.set_rng_state(tensors["random.cpu"])
        if "random.cuda" in tensors and agent.mean.is_cuda:
            torch.cuda.set_rng_state(tensors["random.cuda"])

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the tensors of a checkpoint."""
        random = {"cpu": torch.get_rng_state()}
        if self._agent.mean.is_cuda:
            random["cuda"] = torch.cuda.get_rng_state()
        parts = join_parts(
            model=self._agent.state_dict(),
            optimizer=optimizer_tensors(self.optimizer),
            episodes={"count": torch.tensor(self.episodes), "last": self.outcomes},
            random=random,
        )
        return {**parts, "is_tested": torch.tensor(self.is_tested)}


def _check_finite(run: RunFolder, losses: dict[str, float], step: int) -> None:
    wrong = [name for name, value in losses.items() if not math.isfinite(value)]
    if wrong:
        raise run.make_error(f"the {'gradient' if wrong == ['gradient'] else 'loss'} is NaN or infinite", step)


@dataclass(frozen=True)
class Rollout:
    """B steps of all environments.

    Attributes:
        obs: (B, O) observations.
        normalized: (B, O) normalised observations, as the policy got them.
        action: (B, A) actions.
        log_prob: (B,) log probabilities of the actions.
        advantage: (B,) advantages.
        returns: (B,) targets of the value network.
    """

    obs: torch.Tensor
    normalized: torch.Tensor
    action: torch.Tensor
    log_prob: torch.Tensor
    advantage: torch.Tensor
    returns: torch.Tensor


class RolloutCollector:
    """Collector of rollouts with exploration noise; keeps the outcomes of the last episodes."""

    def __init__(self, envs: VectorEnv, agent: Agent, config: PpoConfig, episodes: int, outcomes: torch.Tensor) -> None:
        self.episodes = episodes
        self._envs, self._agent, self._config = envs, agent, config
        self._outcomes: deque[list[float]] = deque(outcomes.tolist(), maxlen=_LAST_EPISODES)
        first = config.train.seed * config.envs + episodes
        self._obs: torch.Tensor = envs.reset(seed=first % config.layouts)[0]

    def last_outcomes(self) -> torch.Tensor:
        """Return `OUTCOMES` (n, 4) of the last episodes."""
        return torch.tensor(list(self._outcomes)).reshape(-1, len(OUTCOMES))

    @torch.no_grad()
    def collect(self) -> Rollout:
        """Step the environments and return the rollout."""
        agent, config = self._agent, self._config
        steps = []
        for _ in range(steps_per_env(config)):
            obs = self._obs
            normalized = agent.normalize(obs)
            policy = agent.policy(normalized)
            action = policy.sample()
            self._obs, reward, _, truncated, info = self._envs.step(action)  # pyright: ignore[reportArgumentType]
            # Episodes end by truncation only, so the value of the final observation counts
            next_value = agent.value(agent.normalize(info.get("final_obs", self._obs)))
            log_prob = policy.log_prob(action).sum(-1)
            value = agent.value(normalized)
            steps.append((obs, normalized, action, log_prob, reward, value, next_value, truncated))
            if "final_info" in info:
                ended = read_outcomes(info)
                self._outcomes.extend(ended.tolist())
                self.episodes += len(ended)
        obs, normalized, action, log_prob, reward, value, next_value, truncated = (
            torch.stack(part) for part in zip(*steps, strict=True)
        )
        deltas = reward + config.gamma * next_value - value
        advantage = advantages(deltas, truncated, config.gamma * config.gae_lambda)
        parts = (obs, normalized, action, log_prob, advantage, advantage + value)
        return Rollout(*(part.flatten(0, 1) for part in parts))


def steps_per_env(config: PpoConfig) -> int:
    """Return the number of steps of each environment between updates."""
    return max(config.train.batch_size // config.envs, 1)


def advantages(deltas: torch.Tensor, truncated: torch.Tensor, decay: float) -> torch.Tensor:
    """Return generalised advantages (T, N) of temporal differences (Schulman et al. 2016).

    ``decay`` is gamma * lambda.
    """
    result, last = torch.zeros_like(deltas), torch.zeros_like(deltas[0])
    for t in reversed(range(len(deltas))):
        last = result[t] = deltas[t] + decay * ~truncated[t] * last
    return result


def read_outcomes(info: dict[str, Any]) -> torch.Tensor:
    """Return `OUTCOMES` (n, 4) of the episodes that ended at this step."""
    final = info["final_info"]
    held = final["reward_terms"]["grasp"] == 1
    parts = [final["episode"]["return"], held, final["target_lifted"], final["success"]]
    return torch.stack([part.float() for part in parts], dim=1)[info["_final_info"]]
