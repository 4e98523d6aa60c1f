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
from robocas_ms3.baselines.training.checkpoints import Checkpoint, flatten_optimizer_state, join_state_dicts
from robocas_ms3.baselines.training.run_folder import RunFolder
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.signals import defer_interrupts

OUTCOMES = ("return", "held", "lifted", "success")  # sum of rewards; then whether true at the last step of an episode
_LAST_EPISODES = 100  # number of episodes that the log averages


def train_ppo(run: RunFolder, agent: Agent, config: PpoConfig, environments: PpoEnvironments) -> None:
    """Train an agent with PPO up to ``config.train.steps``, then test its mean actions in new layouts.

    A run that continues restores weights, optimiser, observation statistics, outcomes of the last episodes and random
    states from the checkpoint. Its environments start new episodes in the next layouts. Therefore the result is not
    bit-identical to that of an uninterrupted run.
    """
    if run.accelerator.num_processes > 1:
        found, fix = f"{run.accelerator.num_processes} processes", "Call robocas train without `accelerate launch`."
        raise TrainingError(
            "ppo trains in one process only", where=run.record.baseline, expected="1 process", found=found, fix=fix
        )
    settings = config.train
    state = _TrainingState(agent, config, run.checkpoint)
    size = f"{len(environments)} steps in {environments.episodes} layouts"
    run.start(state.step, agent, agent.state_dict(), size)

    def log(split: str, outcomes: torch.Tensor, metrics: dict[str, float]) -> None:
        epoch = state.episodes / config.layouts
        means = dict(zip(OUTCOMES, outcomes.mean(dim=0).tolist(), strict=True))
        run.log(state.step, split, {**means, **metrics}, epoch=epoch, learning_rate=settings.learning_rate)

    def save() -> None:
        run.save(state.step, state.checkpoint_tensors(), agent.state_dict())

    run.progress.on_step(min(state.step, settings.steps), settings.steps)
    saved_step = state.step
    collector = None
    try:
        while state.step < settings.steps:
            collector = collector or RolloutCollector(environments.envs, agent, config, state.episodes, state.outcomes)
            rollout = collector.collect_rollout()
            with defer_interrupts():  # interrupt only after a complete update
                losses = update_agent(agent, state.optimizer, rollout, config)
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
            with defer_interrupts(second_ends=False):
                log("val", outcomes, {"noise": 0.0})
                state.is_tested = True
                save()
            mean_return, *rates = outcomes.mean(dim=0).tolist()
            text = ", ".join(f"{name} {rate:.0%}" for name, rate in zip(OUTCOMES[1:], rates, strict=True))
            run.progress.message(
                f"test with mean actions, {len(outcomes)} new layouts: return {mean_return:.2f}, {text}"
            )
    except KeyboardInterrupt:
        if state.step > saved_step:
            save()
        raise


def update_agent(
    agent: Agent, optimizer: torch.optim.Optimizer, rollout: Rollout, config: PpoConfig
) -> dict[str, float]:
    """Update the networks of an agent with a rollout.

    Returns:
        Means over the minibatches: ``value_loss``, ``policy_loss``, ``entropy``, and the gradient norm ``gradient``.
    """
    agent.update_statistics(rollout.obs)
    tensors = rollout.normalized, rollout.action, rollout.log_prob, rollout.advantage, rollout.returns
    metrics = []
    for _ in range(config.epochs):
        for rows in torch.randperm(len(rollout.normalized)).chunk(config.minibatches):
            obs, action, log_prob, advantage, returns = (tensor[rows] for tensor in tensors)
            advantage = (advantage - advantage.mean()) / (advantage.std(correction=0) + 1e-8)
            policy = agent.action_distribution(obs)
            ratio = (policy.log_prob(action).sum(-1) - log_prob).exp()
            gain = torch.min(
                ratio * advantage, ratio.clamp(1 - config.clip_range, 1 + config.clip_range) * advantage
            ).mean()
            error = (agent.estimate_value(obs) - returns).square().mean()
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
    """Run test episodes with mean actions, and return their `OUTCOMES` (count, 4).

    The layouts are not in the training.
    """
    envs = environments.make_envs(count, FIRST_TEST_SEED, FIRST_TEST_SEED + count - 1)
    try:
        obs, info = envs.reset(seed=FIRST_TEST_SEED)
        while "final_info" not in info:  # all episodes end at the same step
            obs, _, _, _, info = envs.step(agent.mean_action(obs))  # pyright: ignore[reportArgumentType]
    finally:
        envs.close()
    return read_outcomes(info)


class _TrainingState:
    """State of a training: optimiser, numbers of steps and episodes, outcomes of the last episodes.

    The state comes from a checkpoint, if there is one.
    """

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

    def checkpoint_tensors(self) -> dict[str, torch.Tensor]:
        """Return the tensors that a checkpoint stores."""
        random = {"cpu": torch.get_rng_state()}
        if self._agent.mean.is_cuda:
            random["cuda"] = torch.cuda.get_rng_state()
        parts = join_state_dicts(
            model=self._agent.state_dict(),
            optimizer=flatten_optimizer_state(self.optimizer),
            episodes={"count": torch.tensor(self.episodes), "last": self.outcomes},
            random=random,
        )
        return {**parts, "is_tested": torch.tensor(self.is_tested)}


def _check_finite(run: RunFolder, losses: dict[str, float], step: int) -> None:
    wrong = [name for name, value in losses.items() if not math.isfinite(value)]
    if wrong:
        raise run.make_step_error(f"the {'gradient' if wrong == ['gradient'] else 'loss'} is NaN or infinite", step)


@dataclass(frozen=True)
class Rollout:
    """Steps of all environments between two updates, B in total.

    Attributes:
        obs: (B, O) observations.
        normalized: (B, O) normalised observations, from which the actions were sampled.
        action: (B, A) actions.
        log_prob: (B,) log probabilities of the actions.
        advantage: (B,) generalised advantage estimates.
        returns: (B,) targets of the value network.
    """

    obs: torch.Tensor
    normalized: torch.Tensor
    action: torch.Tensor
    log_prob: torch.Tensor
    advantage: torch.Tensor
    returns: torch.Tensor


class RolloutCollector:
    """Collects rollouts with actions sampled from the policy, and keeps the outcomes of the last episodes.

    episodes, outcomes: number and outcomes of the episodes before the first rollout.
    """

    def __init__(self, envs: VectorEnv, agent: Agent, config: PpoConfig, episodes: int, outcomes: torch.Tensor) -> None:
        self.episodes = episodes
        self._envs, self._agent, self._config = envs, agent, config
        self._outcomes: deque[list[float]] = deque(outcomes.tolist(), maxlen=_LAST_EPISODES)
        first = config.train.seed * config.envs + episodes
        self._obs: torch.Tensor = envs.reset(seed=first % config.layouts)[0]

    def last_outcomes(self) -> torch.Tensor:
        """Return `OUTCOMES` (n, 4) of the last episodes that have ended."""
        return torch.tensor(list(self._outcomes)).reshape(-1, len(OUTCOMES))

    @torch.no_grad()
    def collect_rollout(self) -> Rollout:
        """Step the environments ``steps_per_env`` times and return the rollout."""
        agent, config = self._agent, self._config
        steps = []
        for _ in range(steps_per_env(config)):
            obs = self._obs
            normalized = agent.normalize(obs)
            policy = agent.action_distribution(normalized)
            action = policy.sample()
            self._obs, reward, _, truncated, info = self._envs.step(action)  # pyright: ignore[reportArgumentType]
            # Episodes end by truncation only, so the value of the final observation counts
            next_value = agent.estimate_value(agent.normalize(info.get("final_obs", self._obs)))
            log_prob = policy.log_prob(action).sum(-1)
            value = agent.estimate_value(normalized)
            steps.append((obs, normalized, action, log_prob, reward, value, next_value, truncated))
            if "final_info" in info:
                ended = read_outcomes(info)
                self._outcomes.extend(ended.tolist())
                self.episodes += len(ended)
        obs, normalized, action, log_prob, reward, value, next_value, truncated = (
            torch.stack(part) for part in zip(*steps, strict=True)
        )
        deltas = reward + config.gamma * next_value - value
        advantage = compute_advantages(deltas, truncated, config.gamma * config.gae_lambda)
        parts = (obs, normalized, action, log_prob, advantage, advantage + value)
        return Rollout(*(part.flatten(0, 1) for part in parts))


def steps_per_env(config: PpoConfig) -> int:
    """Return the number of steps per environment between two updates of the networks."""
    return max(config.train.batch_size // config.envs, 1)


def compute_advantages(deltas: torch.Tensor, truncated: torch.Tensor, decay: float) -> torch.Tensor:
    """Return the generalised advantage estimates (T, N) of T steps in N environments.

    Source: Schulman et al. 2016.

    deltas: (T, N) temporal differences of the values. truncated: (T, N) bool, whether the episode ended at this step.
    decay: gamma * lambda.
    """
    result, last = torch.zeros_like(deltas), torch.zeros_like(deltas[0])
    for t in reversed(range(len(deltas))):
        last = result[t] = deltas[t] + decay * ~truncated[t] * last
    return result


def read_outcomes(info: dict[str, Any]) -> torch.Tensor:
    """Return `OUTCOMES` (n, 4) of the episodes that ended at a step, from the ``info`` of this step."""
    final = info["final_info"]
    held = final["reward_terms"]["grasp"] == 1
    parts = [final["episode"]["return"], held, final["target_lifted"], final["success"]]
    return torch.stack([part.float() for part in parts], dim=1)[info["_final_info"]]
