"""Several RoboCAS episodes at a time as a vector environment in LeRobot's terms; another process simulates them."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from lerobot_env_robocas.process import Process

VERSION = 1  # of the messages


class RoboCASVectorEnv(gym.vector.VectorEnv):
    """Plays the episodes of a task of a frozen protocol, N at a time.

    A seed is the number of an episode in the task's list, modulo the list's length. An env whose episode has ended
    is shown as it ended, until the next reset.

    Observations: ``pixels`` by camera (N, H, W, 3) uint8, ``agent_pos`` (N, 18), ``joint_velocity`` (N, 7),
    ``arm_base`` (N, 7), ``gripper_open`` (N, 1): columns of robocas_ms3's LeRobot datasets. Reward: 1 where an episode
    ends as a success, else 0. ``info["is_success"]`` (N,) whether it has.

    Args:
        task: one of the protocol's.
        num_envs: N.
        protocol: a shipped one of robocas_ms3, or a folder.
        split: which of its episodes; empty: all.
        fps: actions a second.
        convention, reference: what actions mean; see robocas_ms3's docs/evaluation.md.
        cameras: (width, height) by name.
        python: interpreter that has robocas_ms3; None: see `process.find_python`.
        backend: ``processes`` on a CPU, ``gpu``, or ``auto``.
        results: folder for a result that robocas' commands read; None: none.
        name: of the policy, in that result.
        timeout_s: clock time a step or a reset may take.

    Raises:
        RoboCASProcessError: they can't be played; also of `reset` and `step`.
    """

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        *,
        protocol: str = "ms3-v1",
        split: str = "",
        fps: int = 5,
        convention: str = "robocas",
        reference: str = "tcp",
        cameras: dict[str, tuple[int, int]],
        python: str | None = None,
        backend: str = "auto",
        results: str | None = None,
        name: str = "lerobot",
        timeout_s: float = 600.0,
    ) -> None:
        asked = {
            "version": VERSION,
            "protocol": protocol,
            "split": split,
            "task": task,
            "num_envs": num_envs,
            "convention": convention,
            "reference": reference,
            "rate_hz": fps,
            "cameras": {camera: list(size) for camera, size in cameras.items()},
            "backend": backend,
            "results": results,
            "name": name,
        }
        self._process = Process(python, asked, timeout_s)
        self.ready = self._process.ready
        self.num_envs, self.render_mode = num_envs, "rgb_array"
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": fps, "autoreset_mode": AutoresetMode.DISABLED}
        self.single_observation_space = _space(cameras, self.ready["widths"])
        self.single_action_space = gym.spaces.Box(-np.inf, np.inf, (self.ready["action_size"],), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.episodes = np.zeros(num_envs, np.int64)  # numbers in the protocol
        self._task, self._instructions, self._next = task, [""] * num_envs, 0
        self._ended = np.ones(num_envs, bool)
        self._success, self._truncated = np.zeros(num_envs, bool), np.zeros(num_envs, bool)
        self._obs = {
            "pixels": {name: np.zeros((num_envs, h, w, 3), np.uint8) for name, (w, h) in cameras.items()},
            **{name: np.zeros((num_envs, width), np.float32) for name, width in self.ready["widths"].items()},
        }

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode in each env.

        Args:
            seed: of the first env, which the others follow, or of each; None: on from the last reset's.
            options: not looked at.
        """
        first: Any = self._next if seed is None else seed
        numbers = [first + env for env in range(self.num_envs)] if np.ndim(first) == 0 else list(first)
        if len(numbers) != self.num_envs or any(number is None for number in numbers):
            raise ValueError(f"seeds: expected {self.num_envs}, found {numbers}")
        numbers = [int(number) % self.ready["episodes"] for number in numbers if number is not None]
        self._next = numbers[-1] + 1
        answer = self._process.ask({"play": numbers})
        self._instructions = list(answer["instructions"])
        self.episodes = np.array(answer["episodes"], np.int64)
        for flags in (self._ended, self._success, self._truncated):
            flags[:] = False
        self._take(answer)
        return self._shown(), self._info()

    def step(
        self, actions: Any
    ) -> tuple[dict[str, Any], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Act in the envs whose episodes go on.

        Args:
            actions: (N, A).
        """
        acts = np.ascontiguousarray(actions, np.float32)
        if acts.shape != self.action_space.shape:
            raise ValueError(f"actions: expected {self.action_space.shape}, found {acts.shape}")
        before = self._success.copy()
        if not self._ended.all():
            self._take(self._process.ask({"act": acts}))
        reward = (self._success & ~before).astype(np.float64)
        return self._shown(), reward, self._ended & ~self._truncated, self._truncated.copy(), self._info()

    def render(self) -> tuple[NDArray[np.uint8], ...]:
        """What the first camera sees, (H, W, 3) of each env."""
        return tuple(next(iter(self._obs["pixels"].values())).copy())

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """One of ``task``, ``task_description``, ``_max_episode_steps`` of each env."""
        if name == "task_description":
            return tuple(self._instructions)
        each = {"task": self._task, "_max_episode_steps": self.ready["max_steps"]}
        if name not in each:
            raise AttributeError(name)
        return (each[name],) * self.num_envs

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """`render`, or what `get_attr` knows, of each env."""
        return self.render() if name == "render" else self.get_attr(name)

    def close_extras(self, **kwargs: Any) -> None:
        """End the simulating process."""
        self._process.close()

    def _take(self, answer: dict[str, Any]) -> None:
        envs = answer["envs"]
        for name, rows in answer["numbers"].items():
            self._obs[name][envs] = rows
        for name, rows in answer["images"].items():
            self._obs["pixels"][name][envs] = rows
        for one in answer["ended"]:
            env = one["env"]
            self._ended[env], self._success[env] = True, one["success"]
            self._truncated[env] = not one["success"] and one["steps"] >= self.ready["max_steps"]

    def _shown(self) -> dict[str, Any]:
        """Copies: a policy may keep what it was shown."""
        numbers = {name: value.copy() for name, value in self._obs.items() if name != "pixels"}
        return {"pixels": {name: value.copy() for name, value in self._obs["pixels"].items()}, **numbers}

    def _info(self) -> dict[str, Any]:
        return {"is_success": self._success.copy(), "_is_success": np.ones(self.num_envs, bool)}


def tasks_of(protocol: str, split: str = "", *, python: str | None = None, timeout_s: float = 600.0) -> list[str]:
    """The tasks of a protocol, in its order; the other arguments are those of `RoboCASVectorEnv`.

    Raises:
        RoboCASProcessError: there is no such protocol or split, or no process that knows.
    """
    process = Process(python, {"version": VERSION, "tasks_of": protocol, "split": split}, timeout_s)
    process.close()
    return list(process.ready["tasks"])


def _space(cameras: dict[str, tuple[int, int]], widths: dict[str, int]) -> gym.spaces.Dict:
    spaces: dict[str, gym.Space[Any]] = {
        name: gym.spaces.Box(-np.inf, np.inf, (width,), np.float32) for name, width in widths.items()
    }
    pixels: dict[str, gym.Space[Any]] = {
        name: gym.spaces.Box(0, 255, (h, w, 3), np.uint8) for name, (w, h) in cameras.items()
    }
    return gym.spaces.Dict({"pixels": gym.spaces.Dict(pixels), **spaces})
