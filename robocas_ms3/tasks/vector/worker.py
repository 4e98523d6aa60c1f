"""Worker of `ProcessEnv`, which runs some of the environments in a process."""

from __future__ import annotations

import faulthandler
import importlib
import logging
import os
import pickle
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.remote_errors import RemoteError
from robocas_ms3.core.worker_process import make_worker_error
from robocas_ms3.core.workers import use_one_torch_thread
from robocas_ms3.tasks.base import RoboCASEnv

FIRST_SEED = 2022  # start of env 0's random stream, as in ManiSkill; env i has FIRST_SEED + i
Rows = dict[tuple[str, ...], Any]
"""Flat form of a nested dictionary of E envs: path of keys -> array (E, ...), or list of E values."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class EnvSettings:
    """Settings from which a worker makes its environments."""

    env_id: str
    module: str  # module that registers the environment
    kwargs: dict[str, Any]  # arguments of `gym.make`
    wrappers: tuple[Callable[[gym.Env], gym.Env], ...]  # the first function makes the innermost wrapper
    busy_file: str  # file of (num_envs,) bytes: 1 while an env is busy; read after a crash


class EnvWorker:
    """Worker that runs commands in some environments, and returns the results and the first error.

    A command is a tuple of a method name, such as ``step``, and its arguments. After
    an error in one env, the command still runs in the other envs, so that an env does not depend on its process.

    Args:
        settings: pickled `EnvSettings`.
        envs: indices of the environments of this worker.
    """

    def __init__(self, settings: bytes, envs: range) -> None:
        self._settings: EnvSettings = pickle.loads(settings)
        self._busy = np.memmap(self._settings.busy_file, mode="r+")
        self._first, self._envs = envs.start, dict[int, gym.Env]()
        _, failed = self._run_each(envs, self._make_env)
        if failed:
            self.close()
            failed.reraise()

    def run(self, command: tuple[Any, ...]) -> tuple[Any, RemoteError | None]:
        name, *arguments = command
        return getattr(self, name)(*arguments)

    def close(self) -> None:
        self._run_each(self._envs, lambda env: self._envs[env].close())

    def step(self, actions: np.ndarray) -> tuple[Rows, RemoteError | None]:
        """Step all E environments of this worker with actions (E, A)."""
        rows, failed = self._run_each(self._envs, lambda env: self._step_env(env, actions[env - self._first]))
        return join_rows([(1, row) for row in rows]), failed

    def reset(
        self, seeds: dict[int, tuple[int | None, bool]], options: dict[str, Any]
    ) -> tuple[list[Rows], RemoteError | None]:
        """Reset some environments.

        Args:
            seeds: index of an env -> its seed or None, and whether another seed may replace it if it has no layout.
            options: options of ``BaseEnv.reset``.
        """
        return self._run_each(seeds, lambda env: self._reset_env(env, *seeds[env], dict(options)))

    def render_images(self, envs: Sequence[int]) -> tuple[Rows, RemoteError | None]:
        """Render the present state of some environments."""

        def render(env: int) -> Rows:
            return flatten_to_rows(self._envs[env].get_wrapper_attr("render_images")())

        rows, failed = self._run_each(envs, render)
        return join_rows([(1, row) for row in rows]), failed

    def call(self, name: str, args: tuple, kwargs: dict[str, Any]) -> tuple[list[bytes], RemoteError | None]:
        """Call a method or read an attribute of each environment; return pickled results."""

        def call(env: int) -> bytes:
            found: Any = self._envs[env].get_wrapper_attr(name)
            # pickled here, since the connection would put torch's tensors into shared memory
            return pickle.dumps(found(*args, **kwargs) if callable(found) else found)

        return self._run_each(self._envs, call)

    def call_each(self, name: str, args: Mapping[int, tuple]) -> tuple[list[bytes], RemoteError | None]:
        """Call a method of some environments, by index, with their own arguments; return pickled results."""
        return self._run_each(args, lambda env: pickle.dumps(self._envs[env].get_wrapper_attr(name)(*args[env])))

    def _run_each(self, envs: Iterable[int], act: Callable[[int], Any]) -> tuple[list[Any], RemoteError | None]:
        """Call ``act`` with the index of each env; return the results and the first error."""
        results, failed = [], None
        for env in list(envs):
            self._busy[env] = 1
            try:
                results.append(act(env))
            except BaseException as error:  # noqa: BLE001  (raised again in the main process)
                failed = failed or make_worker_error(error, f"env {env}")
            self._busy[env] = 0
        return results, failed

    def _make_env(self, env: int) -> None:
        importlib.import_module(self._settings.module)
        made: Any = gym.make(self._settings.env_id, **self._settings.kwargs)
        self._envs[env] = made
        base = made.unwrapped
        if env > 0:  # ManiSkill makes every env with seed 2022
            base._set_main_rng([FIRST_SEED + env])
            if base.reconfiguration_freq == 0:  # its scene is built once
                if isinstance(base, RoboCASEnv):
                    base.seeds.first_reset = True  # this seed was not requested either
                base.reset(seed=[FIRST_SEED + env], options={"reconfigure": True})
        for wrap in self._settings.wrappers:
            made = self._envs[env] = wrap(made)

    def _step_env(self, env: int, action: np.ndarray) -> Rows:
        obs, reward, terminated, truncated, info = self._envs[env].step(action)
        ends = {"terminated": np.array([bool(terminated)]), "truncated": np.array([bool(truncated)])}
        return flatten_to_rows({"obs": obs, "reward": np.array([float(reward)], np.float32), **ends, "info": info})

    def _reset_env(self, env: int, seed: int | None, replaceable: bool, options: dict) -> Rows:
        try:
            obs, info = self._envs[env].reset(seed=seed, options=options)
        except LayoutError as error:
            if not replaceable:
                raise
            _log.warning("env %d: no layout for seed %d; drawing another seed: %s", env, seed, error)
            obs, info = self._envs[env].reset(options=options)
        return flatten_to_rows({"obs": obs, "info": info})


def make_process_worker(settings: bytes, envs: range) -> EnvWorker:
    """Return the worker of a process of its own, whose global settings this function changes."""
    faulthandler.enable()
    os.environ.setdefault("LP_NUM_THREADS", "1")  # several processes render in software
    use_one_torch_thread()
    return EnvWorker(settings, envs)


def flatten_to_rows(nested: dict[str, Any], path: tuple[str, ...] = ()) -> Rows:
    """Convert a nested dictionary of one env to NumPy `Rows`, which pickle 30 times faster than tensors."""
    rows: Rows = {}
    for name, value in nested.items():
        rows |= flatten_to_rows(value, (*path, name)) if isinstance(value, dict) else {(*path, name): _to_row(value)}
    return rows


def _to_row(leaf: Any) -> Any:
    if isinstance(leaf, torch.Tensor):
        leaf = (leaf.float() if leaf.dtype == torch.bfloat16 else leaf).detach().cpu().numpy()
    return leaf if isinstance(leaf, np.ndarray) and leaf.shape[:1] == (1,) else [leaf]


def join_rows(parts: Sequence[tuple[int, Rows]]) -> Rows:
    """Join pairs (number of envs, rows) to the rows of all envs; values that an env lacks are None."""
    paths = dict.fromkeys(path for _, rows in parts for path in rows)
    return {path: _join_pieces([rows.get(path, [None] * count) for count, rows in parts]) for path in paths}


def _join_pieces(pieces: Sequence[Any]) -> Any:
    """Join arrays to one new array, or to a list with one value per env if types or shapes differ."""
    kinds = [isinstance(piece, np.ndarray) and (piece.dtype, piece.shape[1:]) for piece in pieces]
    if kinds[0] and kinds.count(kinds[0]) == len(kinds):
        return np.concatenate(pieces)
    rows = (np.split(piece.copy(), len(piece)) if isinstance(piece, np.ndarray) else piece for piece in pieces)
    return [*chain.from_iterable(rows)]


def split_rows(count: int, rows: Rows) -> list[Rows]:
    """Split the rows of ``count`` envs into a list of rows of single envs; the arrays are views."""
    return [{path: piece[i : i + 1] for path, piece in rows.items()} for i in range(count)]
