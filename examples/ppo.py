"""PPO learns to reach for one of a few fruits and hold it, on a CPU: one file, torch only.

    python examples/ppo.py --seed 1 --minutes 10 --out out/ppo_1

writes `progress.csv`, a row an update, and `policy.pt`. docs/rl.md says what came of it.
"""

import csv
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
import tyro
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space
from torch import nn
from torch.distributions import Normal

import robocas_ms3
from robocas_ms3.config import load_task_config

STEPS = 15  # an episode, of 0.2 s
TRIAL = 20_000  # first seed of the layouts that are not learned from
REDUCED = {  # of pick_table_scattered: one small fruit, more or less under the gripper
    "description": "A single fruit on a table.",
    "objects": {"ids": ["lemon", "plum"], "count": 1},
    "surface": {"furniture": "table", "name": "top", "min_xy": [0.18, -0.12], "max_xy": [0.34, 0.12]},
    "robot": {"position": [0.9, 0.42, 0.0], "yaw_deg": 90.0},
}


@dataclass
class Args:
    out: Path = Path("out/ppo")
    """Folder to write to."""
    seed: int = 1
    """Of the policy and its noise."""
    minutes: float = 10.0
    """Wall-clock time to learn for."""
    updates: int = 10**9
    """Or until there were so many updates."""
    envs: int = 8
    """Environments."""
    workers: int | None = None
    """Processes that they are in; default: one an environment, but no more than cores."""
    layouts: int = 64
    """Different scenes to learn from."""
    batch: int = 512
    """Steps of all environments together between updates."""
    epochs: int = 10
    minibatches: int = 4
    learning_rate: float = 7e-4
    gamma: float = 0.92
    trace: float = 0.9
    """Lambda of the advantages."""
    clip: float = 0.2
    entropy: float = 1e-3
    trials: int = 50
    """Episodes at the end, in layouts that were not learned from, without noise."""


class TopDown(gym.ActionWrapper):
    """Five numbers in [-1, 1] in place of the pose's seven: the gripper keeps pointing down and only turns about that.

    1 is a shift by 5 cm, or a turn by 0.25 rad, in a fifth of a second.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.single_action_space = gym.spaces.Box(-1, 1, (5,), np.float32)
        self.action_space = batch_space(self.single_action_space, env.unwrapped.num_envs)  # a GPU's batch

    def action(self, action: np.ndarray | torch.Tensor) -> torch.Tensor:
        """From (..., 5) to (..., 7)."""
        x, y, z, yaw, gripper = torch.as_tensor(action, device=self.unwrapped.device).clip(-1, 1).unbind(-1)
        still = torch.zeros_like(x)
        return torch.stack([x / 2, y / 2, z / 2, still, still, yaw / 2, gripper], dim=-1)


def make_envs(count: int, first_seed: int, last_seed: int, workers: int | None = None) -> VectorEnv:
    """Environments whose layouts are those of some seeds; each keeps its fruit. A success does not end an episode."""
    config = load_task_config("pick_table_scattered").model_dump(mode="json") | REDUCED
    return robocas_ms3.make_vec(
        "RoboCASPick-v1",
        count,
        workers=workers,
        wrappers=[TopDown],
        ignore_terminations=True,
        reconfiguration_freq=0,
        seeds=(first_seed, last_seed),
        **robocas_ms3.rl_kwargs("pick", config) | {"max_episode_steps": STEPS},
    )


class Agent(nn.Module):
    """Policy and value of normalised observations."""

    def __init__(self, observed: int, acted: int) -> None:
        super().__init__()
        self.mean, self.square, self.count = (
            nn.Parameter(start, requires_grad=False)
            for start in (torch.zeros(observed), torch.ones(observed), torch.tensor(1e-4))
        )
        self.actor, self.critic = _layers(observed, acted, 0.01), _layers(observed, 1, 1.0)
        self.log_std = nn.Parameter(torch.full((acted,), -0.7))

    def see(self, obs: torch.Tensor) -> None:
        """Learn what observations are like."""
        self.count += len(obs)
        share = len(obs) / self.count
        self.mean += share * (obs.mean(dim=0) - self.mean)
        self.square += share * ((obs**2).mean(dim=0) - self.square)

    def normal(self, obs: torch.Tensor) -> torch.Tensor:
        deviation = (self.square - self.mean**2).clamp(min=1e-6).sqrt()
        return ((obs - self.mean) / deviation).clamp(-5, 5)

    def policy(self, seen: torch.Tensor) -> Normal:
        return Normal(self.actor(seen), self.log_std.exp())

    def value(self, seen: torch.Tensor) -> torch.Tensor:
        return self.critic(seen)[:, 0]


def _layers(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    layers = nn.Sequential(
        nn.Linear(inputs, 128), nn.Tanh(), nn.Linear(128, 128), nn.Tanh(), nn.Linear(128, outputs)
    )  # fmt: skip
    for layer in layers[::2]:
        nn.init.orthogonal_(layer.weight, gain if layer is layers[-1] else 2**0.5)
        nn.init.zeros_(layer.bias)
    return layers


class Rollouts:
    """Steps the environments with the policy, and keeps what came of the last episodes: return, held, lifted."""

    def __init__(self, envs: VectorEnv, agent: Agent, args: Args) -> None:
        self.envs, self.agent, self.args = envs, agent, args
        self.obs = envs.reset(seed=args.seed * args.envs % args.layouts)[0]  # each env of each run goes on otherwise
        self.episodes = deque(maxlen=100)

    @torch.no_grad()
    def collect(self) -> list[torch.Tensor]:
        """Observations as the policy saw them, actions, their log-probabilities, advantages and returns."""
        agent, args = self.agent, self.args
        steps, raw = [], []
        for _ in range(args.batch // args.envs):
            seen = agent.normal(self.obs)
            policy = agent.policy(seen)
            action = policy.sample()
            raw.append(self.obs)
            self.obs, reward, _, over, info = self.envs.step(action)
            # time was up, and nothing else: what would have come next still counts
            following = info.get("final_observation", self.obs)
            value, next_value = agent.value(seen), agent.value(agent.normal(following))
            delta = reward + args.gamma * next_value - value
            steps.append((seen, action, policy.log_prob(action).sum(-1), delta, over.float(), value))
            if "final_info" in info:
                self.episodes.extend(outcomes(info).tolist())
        agent.see(torch.cat(raw))
        seen, action, log_prob, delta, over, value = (torch.stack(part) for part in zip(*steps, strict=True))
        advantage, last = torch.zeros_like(delta), torch.zeros_like(delta[0])
        for t in reversed(range(len(delta))):
            last = advantage[t] = delta[t] + args.gamma * args.trace * (1 - over[t]) * last
        return [part.flatten(0, 1) for part in (seen, action, log_prob, advantage, advantage + value)]


def outcomes(info: dict) -> torch.Tensor:
    """(n, 3) of the episodes that have just ended: return, whether the target is held, whether it was lifted."""
    final = info["final_info"]
    held = final["reward_terms"]["grasp"] == 1
    return torch.stack([final["episode"]["return"], held, final["target_lifted"]], dim=1)[info["_final_info"]]


def update(agent: Agent, optimizer: torch.optim.Optimizer, data: list[torch.Tensor], args: Args) -> None:
    """Improve the policy by what was collected."""
    for _ in range(args.epochs):
        for rows in torch.randperm(len(data[0])).chunk(args.minibatches):
            seen, action, log_prob, advantage, returns = (part[rows] for part in data)
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            policy = agent.policy(seen)
            ratio = (policy.log_prob(action).sum(-1) - log_prob).exp()
            gain = torch.min(ratio * advantage, ratio.clamp(1 - args.clip, 1 + args.clip) * advantage).mean()
            error = (agent.value(seen) - returns).square().mean()
            optimizer.zero_grad()
            (error / 2 - gain - args.entropy * policy.entropy().sum(-1).mean()).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimizer.step()


@torch.no_grad()
def try_out(agent: Agent, args: Args) -> float:
    """The share of unseen layouts in which the policy, without its noise, holds the target at the end."""
    envs = make_envs(args.trials, TRIAL, TRIAL + args.trials - 1, args.workers)
    obs, info = envs.reset(seed=TRIAL)
    while "final_info" not in info:  # all end at once
        obs, _, _, _, info = envs.step(agent.actor(agent.normal(obs)))
    envs.close()
    return outcomes(info)[:, 1].mean().item()


def main(args: Args) -> None:
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    envs = make_envs(args.envs, 0, args.layouts - 1, args.workers)
    agent = Agent(envs.single_observation_space.shape[0], envs.single_action_space.shape[0]).to(envs.device)
    optimizer = torch.optim.Adam([p for p in agent.parameters() if p.requires_grad], lr=args.learning_rate, eps=1e-5)
    rollouts, begun = Rollouts(envs, agent, args), time.perf_counter()
    with (args.out / "progress.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["steps", "seconds", "return", "held", "lifted", "std"])
        for number in range(1, args.updates + 1):
            update(agent, optimizer, rollouts.collect(), args)
            seconds, spread = time.perf_counter() - begun, agent.log_std.exp().mean().item()
            of_last = np.mean(rollouts.episodes, axis=0) if rollouts.episodes else [np.nan] * 3
            rows.writerow([number * args.batch, f"{seconds:.1f}", *(f"{x:.3f}" for x in (*of_last, spread))])
            file.flush()
            if number % 10 == 0 or number == args.updates or seconds > 60 * args.minutes:
                done = f"held at the end {of_last[1]:.0%}, lifted {of_last[2]:.0%}"
                print(
                    f"{number * args.batch} steps, {seconds:.0f} s: return {of_last[0]:.2f} of {STEPS}, {done}",
                    flush=True,
                )
            if seconds > 60 * args.minutes:
                break
    torch.save(agent.state_dict(), args.out / "policy.pt")
    envs.close()
    print(f"without noise, in {args.trials} layouts that are new to it: held {try_out(agent, args):.0%}")


if __name__ == "__main__":
    main(tyro.cli(Args))
