"""Environments in worker processes, with the interface of ManiSkill's batched environment on a GPU."""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from copy import copy
from functools import partial
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector.utils import batch_space
from mani_skill.utils.registration import REGISTERED_ENVS

from robocas_ms3.core.errors import VectorEnvCrashError, VectorEnvError
from robocas_ms3.core.worker_process import NO_LIMITS, Limits, ProcessCrashError
from robocas_ms3.tasks.seeds import consecutive_seeds
from robocas_ms3.tasks.vector.pinned_workers import InProcessWorkers, PinnedWorkers
from robocas_ms3.tasks.vector.worker import EnvSettings, EnvWorker, Rows, join_rows, make_process_worker, split_rows


class ProcessEnv(gym.Env):
    """Single CPU environments in worker processes, with the interface of a batched ``BaseEnv`` on a GPU.

    An env depends on its seeds and actions only, not on other envs or on its process. Before the first seed, the random
    stream of env i starts with seed 2022 + i, as in ManiSkill. benchmarks/vector.py compares this class with
    gymnasium's ``AsyncVectorEnv``, which uses one process per env.

    Args:
        env_id: gymnasium id of a ManiSkill environment.
        num_envs: number of envs, N.
        workers: number of processes; each has equally many envs, or one more; 0: all envs are in this process.
        kwargs: arguments of ``gym.make``; sent with cloudpickle.
        wrappers: functions that wrap each env; the first function makes the innermost wrapper. Sent with cloudpickle.
        limits: time and memory limits of a process per step or reset; a process that exceeds them is killed.

    Raises:
        VectorEnvError: the arguments can't be sent to the processes.
        VectorEnvCrashError: a worker process crashed.
        Exception: any error that ``gym.make`` raises.

    Attributes:
        pids: ids of the worker processes.
        elapsed_steps: (N,) int32 control steps since each env's reset; read only.
    """

    single_observation_space: gym.Space
    single_action_space: gym.Space

    def __init__(
        self,
        env_id: str,
        num_envs: int,
        workers: int,
        kwargs: dict[str, Any],
        wrappers: Sequence[Callable[[gym.Env], gym.Env]] = (),
        limits: Limits = NO_LIMITS,
    ) -> None:
        self.num_envs, self.device = num_envs, torch.device("cpu")
        self.reconfiguration_freq = 0  # of the batch; each env has its own value
        self.spec = copy(gym.spec(env_id))
        if kwargs.get("max_episode_steps") is not None:  # ManiSkill's helpers read it from the spec
            self.spec.max_episode_steps = kwargs["max_episode_steps"]
        self._seed_range: tuple[int, int] | None = kwargs.get("seeds")
        self._must_reset: set[int] = set()  # envs in an unknown state after an interrupted or failed call
        self._last_results: list[tuple[int, Rows]] = []  # last result of each worker, with its number of envs
        self.elapsed_steps = torch.zeros(num_envs, dtype=torch.int32)
        registered = REGISTERED_ENVS.get(self.spec.id)
        module = registered.cls.__module__ if registered else "robocas_ms3"
        if module == "__main__":
            fix = f'Register the environment in a module, and pass the id "my_module:{self.spec.id}".'
            what = "worker processes can't import an environment that is registered in the main program"
            raise VectorEnvError(what, where=env_id, fix=fix)
        parts = max(workers, 1)
        cuts = [num_envs * part // parts for part in range(parts + 1)]
        self._env_ranges = [range(*cut) for cut in zip(cuts, cuts[1:], strict=False)]
        with tempfile.NamedTemporaryFile(prefix="robocas-envs-") as busy_file:
            self._busy = np.memmap(busy_file, mode="w+", shape=num_envs)
            settings = EnvSettings(env_id, module, kwargs, tuple(wrappers), busy_file.name)
            try:
                pickled = cloudpickle.dumps(settings)
            except Exception as error:
                raise VectorEnvError(
                    "the arguments can't be sent to worker processes", where=env_id, found=error
                ) from error
            make = make_process_worker if workers else EnvWorker
            make_workers = [partial(make, pickled, env_range) for env_range in self._env_ranges]
            self._workers = PinnedWorkers(make_workers, limits) if workers else InProcessWorkers(make_workers)
            for name in ("render_mode", "metadata", "single_observation_space", "single_action_space"):
                setattr(self, name, self.call(name)[0])
        self.pids = self._workers.pids
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset all envs, or only the envs ``options["env_idx"]``.

        Args:
            seed: seed of each env. A single seed is for the first env; the other envs get the next seeds, which wrap
                around in the range ``seeds`` if the seed is in it. None: each env draws from its random stream.
            options: options of ``BaseEnv.reset``.

        Raises:
            VectorEnvError: the number of seeds or ``env_idx`` is invalid, or the first reset is not of all envs.
            LayoutError: a requested seed has no layout, or none of many drawn seeds has one.
        """
        options = dict(options or {})
        envs = self._parse_env_indices(options.pop("env_idx")) if "env_idx" in options else list(range(self.num_envs))
        seeds = dict(zip(envs, self._seeds_per_env(seed, len(envs)), strict=True))
        if not self._last_results and len(envs) < self.num_envs:
            what = "the first reset must be of all environments"
            raise VectorEnvError(what, found=f"a reset of {format_envs(envs)}", fix="Call reset without env_idx first.")
        self._must_reset |= set(envs)
        seeds_of_workers = [{env: seeds[env] for env in env_range if env in seeds} for env_range in self._env_ranges]
        new = [
            row
            for rows in self._run_commands(
                [("reset", seeds_of_worker, options) for seeds_of_worker in seeds_of_workers]
            )
            for row in rows
        ]
        self._must_reset -= set(envs)
        if new:
            paths = dict.fromkeys(
                path for row in new for path in row
            )  # entries that a reset does not return are dropped
            rows = dict(enumerate(row for part in self._last_results for row in split_rows(*part)))
            rows |= zip(sorted(envs), new, strict=True)
            self._last_results = [(1, {path: rows[i][path] for path in paths if path in rows[i]}) for i in sorted(rows)]
        found = self._batch_last_results()
        return found.get("obs", {}), found["info"]

    def step(self, action: Any) -> tuple[Any, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Step every env; returns the batched values of ``BaseEnv.step``.

        Args:
            action: (N, A) array or tensor; for one env also (A,).

        Raises:
            VectorEnvError: the action has an invalid shape, or some envs must be reset after a failed call.
        """
        self._check_states_known(set(range(self.num_envs)))
        action = action.cpu().numpy() if isinstance(action, torch.Tensor) else np.asarray(action)
        expected = self.action_space.shape
        if action.shape not in (expected, expected[1:] if self.num_envs == 1 else expected):  # pyright: ignore[reportOptionalSubscript]
            raise VectorEnvError("invalid shape of the actions", expected=expected, found=action.shape)
        action = action.astype(self.action_space.dtype).reshape(expected)
        self._must_reset = set(range(self.num_envs))
        answers = self._run_commands(
            [("step", action[env_range.start : env_range.stop]) for env_range in self._env_ranges]
        )
        self._must_reset = set()
        self._last_results = [*zip(map(len, self._env_ranges), answers, strict=True)]
        found = self._batch_last_results()
        return found.get("obs", {}), found["reward"], found["terminated"], found["truncated"], found["info"]

    def render_images(self, envs: Any) -> dict[str, dict[str, torch.Tensor]]:
        """Render the present state of the E envs ``envs`` (`SceneEnv.render_images`).

        Returns camera -> kind, such as ``rgb`` -> (E, H, W, C), in the order of ``envs``.

        Raises:
            VectorEnvError: ``envs`` is invalid, or one of the envs must be reset after a failed call.
        """
        numbers = self._parse_env_indices(envs)
        self._check_states_known(set(numbers))
        envs_of_workers = [[env for env in numbers if env in env_range] for env_range in self._env_ranges]
        answers = self._run_commands([("render_images", envs_of_worker) for envs_of_worker in envs_of_workers])
        rendered = [env for envs_of_worker in envs_of_workers for env in envs_of_worker]
        order = [rendered.index(env) for env in numbers]
        rows = join_rows([(len(part), found) for part, found in zip(envs_of_workers, answers, strict=True) if part])
        images: dict[str, dict[str, torch.Tensor]] = {}
        for (camera, kind), value in rows.items():
            images.setdefault(camera, {})[kind] = torch.from_numpy(value[order])
        return images

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method or read an attribute of each env; return a tuple of N picklable results."""
        answers = self._run_commands([("call", name, args, kwargs)] * len(self._env_ranges))
        return tuple(pickle.loads(result) for results in answers for result in results)

    def call_each(self, name: str, args: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
        """Call a method of some envs, by index, with their own arguments; return the picklable results by index."""
        parts = [{env: args[env] for env in env_range if env in args} for env_range in self._env_ranges]
        answers = self._run_commands([("call_each", name, part) for part in parts])
        return {
            env: pickle.loads(result)
            for part, results in zip(parts, answers, strict=True)
            for env, result in zip(part, results, strict=True)
        }

    def get_language_instruction(self) -> list[str]:
        return [text for texts in self.call("get_language_instruction") for text in texts]

    def render(self) -> Any:
        """Return images (N, H, W, 3) of all envs in their ``render_mode``; None if they have no render mode."""
        images = self.call("render")
        return None if any(image is None for image in images) else torch.cat([*map(torch.as_tensor, images)])

    def close(self) -> None:
        """Close all environments and end their processes; kill processes that still run a call."""
        if self._workers.closed:
            return
        try:
            if not self._workers.busy:
                with suppress(Exception):
                    self.call("close")
        finally:
            self._must_reset.clear()
            self._workers.close()

    def _run_commands(self, commands: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Send one command to each worker, and return the results in the order of the workers.

        Raises:
            VectorEnvError: the environments are closed.
            VectorEnvCrashError: a worker process crashed; all processes are ended then.
            Exception: error of the first failed env.
        """
        if self._workers.closed:
            raise VectorEnvError("the environments are closed", fix="Make a new vector environment.")
        try:
            answers = self._workers.run(commands)
        except ProcessCrashError as crash:
            env_range = self._env_ranges[self._workers.pids.index(crash.pid)]
            envs = [env for env in env_range if self._busy[env]] or list(env_range)
            fix = "Read the output above, run robocas doctor, and make a new vector environment."
            died = VectorEnvCrashError(
                "its worker process crashed", where=format_envs(envs), found=crash.found, fix=fix
            )
            died.envs = tuple(envs)
            self._must_reset.clear()
            self._workers.close()
            raise died from crash
        for _, failed in answers:
            if failed is not None:
                failed.reraise()
        return [found for found, _ in answers]

    def _check_states_known(self, envs: set[int]) -> None:
        if unknown := self._must_reset & envs:
            what = "the state is unknown, because an earlier call was interrupted or failed"
            raise VectorEnvError(
                what, where=format_envs(sorted(unknown)), fix="Reset these environments before the next step."
            )

    def _batch_last_results(self) -> dict[str, Any]:
        """Return the last results of all envs as a nested dictionary of tensors (N, ...) or lists."""
        nested: dict[str, Any] = {}
        for (*path, name), value in join_rows(self._last_results).items():
            inner = nested
            for part in path:
                inner = inner.setdefault(part, {})
            inner[name] = torch.from_numpy(value) if isinstance(value, np.ndarray) else [*map(_as_tensor, value)]
        if "reconfigure" in nested["info"]:
            nested["info"]["reconfigure"] = any(nested["info"]["reconfigure"])
        self.elapsed_steps = nested["info"]["elapsed_steps"].clone()
        return nested

    def _parse_env_indices(self, chosen: Any) -> list[int]:
        """Return the indices of the envs that ``env_idx`` names by indices or by flags (N,)."""
        chosen = np.asarray(chosen.cpu() if isinstance(chosen, torch.Tensor) else chosen)
        envs = np.flatnonzero(chosen) if chosen.dtype == bool and chosen.shape == (self.num_envs,) else chosen
        numbers = envs.tolist()
        if envs.ndim != 1 or len(set(numbers)) < len(numbers) or not set(numbers) <= set(range(self.num_envs)):
            expected = f"different indices from 0 to {self.num_envs - 1}"
            raise VectorEnvError("invalid env_idx", where="options", expected=expected, found=numbers)
        return numbers

    def _seeds_per_env(self, seed: Any, count: int) -> list[tuple[int | None, bool]]:
        """Return the seed of each env to reset, and whether another seed may replace it if it has no layout."""
        if seed is None:  # each env draws until a seed has a layout
            return [(None, False)] * count
        if np.ndim(seed) == 0:
            seeds = consecutive_seeds(int(seed), count, self._seed_range)
            return [(one, i > 0) for i, one in enumerate(seeds)]
        if len(seed) != count:
            raise VectorEnvError("invalid number of seeds", expected=f"{count}, or a single seed", found=len(seed))
        return [(None if one is None else int(one), False) for one in seed]


def format_envs(envs: Sequence[int]) -> str:
    """Return the indices of environments as text for messages, such as "envs 0, 2"."""
    return f"env{'s' * (len(envs) > 1)} {', '.join(map(str, envs))}"


def _as_tensor(row: Any) -> Any:
    return torch.from_numpy(row) if isinstance(row, np.ndarray) else row
