"""PPO learns to reach for one of a few fruits and hold it, on a CPU: one file, torch only.

    python examples/ppo.py --seed 1 --minutes 10 --out out/ppo_1

writes `progress.csv`, a row an update, and `policy.pt`. docs/rl.md says what came of it.
"""

import csv
import os
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
import tyro
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from torch import nn
from torch.distributions import Normal

import robocas_ms3  # noqa: F401  (registers the environments)
from robocas_ms3.config import load_task_config

STEPS = 15  # an episode, of 0.2 s
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
    processes: bool = (os.cpu_count() or 1) > 4
    """Each in a process of its own, which takes cores that are free: else this one steps them all."""
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


class TopDown(gym.Wrapper):
    """Five numbers in [-1, 1] in place of the pose's seven: the gripper keeps pointing down and only turns about that.

    1 is a shift by 5 cm, or a turn by 0.25 rad, in a fifth of a second. A success does not end an episode: the reward
    is a level, and goes on. Of ``info`` only what came of an episode is kept: all of it, at every step, would be much
    to hand on between processes.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.action_space = gym.spaces.Box(-1, 1, (5,), np.float32)
        self.observation_space = env.unwrapped.single_observation_space

    def step(self, action: np.ndarray) -> tuple:
        x, y, z, yaw, gripper = np.clip(action, -1, 1)
        pose = np.array([x / 2, y / 2, z / 2, 0, 0, yaw / 2, gripper], np.float32)
        obs, reward, _, truncated, info = self.env.step(pose)
        over = bool(truncated)
        held = {"held": bool(info["reward_terms"]["grasp"] == 1), "lifted": bool(info["target_lifted"])} if over else {}
        return obs[0].numpy(), float(reward), False, over, held

    def reset(self, **kwargs) -> tuple:
        return self.env.reset(**kwargs)[0][0].numpy(), {}


def make_env(first: int, last: int) -> gym.Env:
    """An environment whose layouts are those of some seeds."""
    torch.set_num_threads(1)
    env = gym.make(
        "RoboCASPick-v1",
        config={**load_task_config("pick_table_scattered").model_dump(mode="json"), **REDUCED},
        seeds=(first, last),
        reconfiguration_freq=0,  # each environment keeps its fruit
        obs_mode="state",
        reward_mode="normalized_dense",
        control_mode="pd_ee_delta_pose",
        sim_config={"control_freq": 5},
        max_episode_steps=STEPS,
        render_backend="none",
    )
    return TopDown(env)


def make_vec(args: "Args") -> VectorEnv:
    """Environments that start anew when an episode is over, each in a process of its own or all in this one."""
    makers = [lambda: make_env(0, args.layouts - 1)] * args.envs
    if args.processes:
        return AsyncVectorEnv(makers, context="spawn", autoreset_mode=AutoresetMode.SAME_STEP)
    return SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)


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


def _layers(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    layers = nn.Sequential(
        nn.Linear(inputs, 128), nn.Tanh(), nn.Linear(128, 128), nn.Tanh(), nn.Linear(128, outputs)
    )  # fmt: skip
    for layer in layers[::2]:
        nn.init.orthogonal_(layer.weight, gain if layer is layers[-1] else 2**0.5)
        nn.init.zeros_(layer.bias)
    return layers


def tensor(array: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(np.asarray(array, np.float32))


class Rollouts:
    """Steps the environments with the policy, and keeps what came of the last episodes."""

    def __init__(self, env: VectorEnv, agent: Agent, args: Args) -> None:
        self.env, self.agent, self.args = env, agent, args
        self.obs = tensor(env.reset(seed=args.seed * 1000)[0])
        self.returns, self.episodes = np.zeros(args.envs), deque(maxlen=100)

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
            obs, reward, _, over, info = self.env.step(action.numpy())
            value, after = agent.critic(seen)[:, 0], tensor(obs)
            following = after.clone()
            self.returns += reward
            for i in np.flatnonzero(over):  # time was up, and nothing else: what would have come next still counts
                following[i] = tensor(info["final_obs"][i])
                ended = info["final_info"]
                self.episodes.append((self.returns[i], float(ended["held"][i]), float(ended["lifted"][i])))
                self.returns[i] = 0
            next_value = agent.critic(agent.normal(following))[:, 0]
            delta = tensor(reward) + args.gamma * next_value - value
            steps.append((seen, action, policy.log_prob(action).sum(-1), delta, tensor(over), value))
            self.obs = after
        agent.see(torch.cat(raw))
        seen, action, log_prob, delta, over, value = (torch.stack(part) for part in zip(*steps, strict=True))
        advantage, last = torch.zeros_like(delta), torch.zeros(args.envs)
        for t in reversed(range(len(delta))):
            last = advantage[t] = delta[t] + args.gamma * args.trace * (1 - over[t]) * last
        return [part.flatten(0, 1) for part in (seen, action, log_prob, advantage, advantage + value)]


def update(agent: Agent, optimizer: torch.optim.Optimizer, data: list[torch.Tensor], args: Args) -> None:
    """Improve the policy by what was collected."""
    for _ in range(args.epochs):
        for rows in torch.randperm(len(data[0])).chunk(args.minibatches):
            seen, action, log_prob, advantage, returns = (part[rows] for part in data)
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            policy = agent.policy(seen)
            ratio = (policy.log_prob(action).sum(-1) - log_prob).exp()
            gain = torch.min(ratio * advantage, ratio.clamp(1 - args.clip, 1 + args.clip) * advantage).mean()
            error = (agent.critic(seen)[:, 0] - returns).square().mean()
            optimizer.zero_grad()
            (error / 2 - gain - args.entropy * policy.entropy().sum(-1).mean()).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimizer.step()


@torch.no_grad()
def try_out(agent: Agent, args: Args) -> float:
    """The share of unseen layouts in which the policy, without its noise, holds the target at the end."""
    env, held = make_env(10_000, 10_000 + args.trials), 0
    for seed in range(10_000, 10_000 + args.trials):
        obs, info = env.reset(seed=seed)
        while not info:
            obs, _, _, _, info = env.step(agent.actor(agent.normal(tensor(obs))).numpy())
        held += info["held"]
    env.close()
    return held / args.trials


def main(args: Args) -> None:
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    env = make_vec(args)
    agent = Agent(env.single_observation_space.shape[0], env.single_action_space.shape[0])
    optimizer = torch.optim.Adam([p for p in agent.parameters() if p.requires_grad], lr=args.learning_rate, eps=1e-5)
    rollouts, begun = Rollouts(env, agent, args), time.perf_counter()
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
    env.close()
    print(f"without noise, in {args.trials} layouts that are new to it: held {try_out(agent, args):.0%}")


if __name__ == "__main__":
    main(tyro.cli(Args))
