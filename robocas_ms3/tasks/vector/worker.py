"""A worker of `ProcessEnv`: some of its environments, in a process of their own."""

from __future__ import annotations

import faulthandler
import importlib
import logging
import os
import pickle
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.remote_errors import RemoteError
from robocas_ms3.core.worker_process import worker_error
from robocas_ms3.core.workers import use_one_torch_thread
from robocas_ms3.tasks.base import RoboCASEnv

FIRST_SEED = 2022  # of env 0's resets without a seed, as in ManiSkill; env 1 has the next
Rows = dict[tuple[str, ...], Any]
"""By path in nested dictionaries: an array (E, ...) of all envs, or a list of E where an env has none of that shape."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class EnvSettings:
    """What all environments are made with."""

    env_id: str
    module: str  # that registers the environment
    kwargs: dict[str, Any]  # for `gym.make`
    wrappers: tuple[Callable[[gym.Env], gym.Env], ...]  # the first one is the innermost
    at_work: str  # file of (num_envs,) bytes, 1 while an env works, for when a process dies


class EnvWorker:
    """Runs commands, ``(method, *arguments)``; returns a pair of what was found, and the first error if any.

    After an error the other envs have their turn all the same, so that what becomes of an environment does not depend
    on which others are in its process.

    Args:
        settings: pickled `EnvSettings`.
        envs: numbers of the environments.
    """

    def __init__(self, settings: bytes, envs: range) -> None:
        faulthandler.enable()
        os.environ.setdefault("LP_NUM_THREADS", "1")  # several processes render in software
        use_one_torch_thread()
        self._settings: EnvSettings = pickle.loads(settings)
        self._at_work = np.memmap(self._settings.at_work, mode="r+")
        self._first, self._envs = envs.start, dict[int, gym.Env]()
        _, failed = self._each(envs, self._make)
        if failed:
            self.close()
            failed.reraise()

    def run(self, command: tuple[Any, ...]) -> tuple[Any, RemoteError | None]:
        name, *arguments = command
        return getattr(self, name)(*arguments)

    def close(self) -> None:
        self._each(self._envs, lambda env: self._envs[env].close())

    def step(self, actions: np.ndarray) -> tuple[Rows, RemoteError | None]:
        """Step all environments with actions (E, A)."""
        rows, failed = self._each(self._envs, lambda env: self._step(env, actions[env - self._first]))
        return join_rows([(1, row) for row in rows]), failed

    def reset(
        self, seeds: dict[int, tuple[int | None, bool]], options: dict[str, Any]
    ) -> tuple[list[Rows], RemoteError | None]:
        """Reset some environments: of each its seed or None, and whether another may replace it without a layout."""
        return self._each(seeds, lambda env: self._reset(env, *seeds[env], dict(options)))

    def call(self, name: str, args: tuple, kwargs: dict[str, Any]) -> tuple[list[bytes], RemoteError | None]:
        """Call a method of each environment, or read an attribute; the results are pickled."""

        def call(env: int) -> bytes:
            found: Any = self._envs[env].get_wrapper_attr(name)
            # not by the connection: there torch's tensors would share memory
            return pickle.dumps(found(*args, **kwargs) if callable(found) else found)

        return self._each(self._envs, call)

    def _each(self, envs: Iterable[int], act: Callable[[int], Any]) -> tuple[list[Any], RemoteError | None]:
        results, failed = [], None
        for env in list(envs):
            self._at_work[env] = 1
            try:
                results.append(act(env))
            except BaseException as error:  # noqa: BLE001  (raised again in the main process)
                failed = failed or worker_error(error, f"env {env}")
            self._at_work[env] = 0
        return results, failed

    def _make(self, env: int) -> None:
        importlib.import_module(self._settings.module)
        made: Any = gym.make(self._settings.env_id, **self._settings.kwargs)
        self._envs[env] = made
        base = made.unwrapped
        if env > 0:  # ManiSkill makes each with the first one's seed
            base._set_main_rng([FIRST_SEED + env])
            if base.reconfiguration_freq == 0:  # its scene stays
                if isinstance(base, RoboCASEnv):
                    base.seeds.first_reset = True  # nobody asked for this seed either
                base.reset(seed=[FIRST_SEED + env], options={"reconfigure": True})
        for wrap in self._settings.wrappers:
            made = self._envs[env] = wrap(made)

    def _step(self, env: int, action: np.ndarray) -> Rows:
        obs, reward, terminated, truncated, info = self._envs[env].step(action)
        ends = {"terminated": np.array([bool(terminated)]), "truncated": np.array([bool(truncated)])}
        return as_rows({"obs": obs, "reward": np.array([float(reward)], np.float32), **ends, "info": info})

    def _reset(self, env: int, seed: int | None, replaceable: bool, options: dict) -> Rows:
        try:
            obs, info = self._envs[env].reset(seed=seed, options=options)
        except LayoutError as error:
            if not replaceable:
                raise
            _log.warning("env %d: no layout for seed %d, another is drawn: %s", env, seed, error)
            obs, info = self._envs[env].reset(options=options)
        return as_rows({"obs": obs, "info": info})


def as_rows(nested: dict[str, Any], path: tuple[str, ...] = ()) -> Rows:
    """Return nested dictionaries of one env as rows; arrays pickle in a thirtieth of the time of tensors."""
    rows: Rows = {}
    for name, value in nested.items():
        rows |= as_rows(value, (*path, name)) if isinstance(value, dict) else {(*path, name): _as_row(value)}
    return rows


def _as_row(leaf: Any) -> Any:
    if isinstance(leaf, torch.Tensor):
        leaf = (leaf.float() if leaf.dtype == torch.bfloat16 else leaf).detach().cpu().numpy()
    return leaf if isinstance(leaf, np.ndarray) and leaf.shape[:1] == (1,) else [leaf]


def join_rows(parts: Sequence[tuple[int, Rows]]) -> Rows:
    """Return rows of several (number of envs, rows) as rows of all envs; None where an env has none."""
    paths = dict.fromkeys(path for _, rows in parts for path in rows)
    return {path: _join([rows.get(path, [None] * count) for count, rows in parts]) for path in paths}


def _join(pieces: Sequence[Any]) -> Any:
    """Join pieces into one array, which is a copy; where that is impossible, into a list of an entry per env."""
    kinds = [isinstance(piece, np.ndarray) and (piece.dtype, piece.shape[1:]) for piece in pieces]
    if kinds[0] and kinds.count(kinds[0]) == len(kinds):
        return np.concatenate(pieces)
    rows = (np.split(piece.copy(), len(piece)) if isinstance(piece, np.ndarray) else piece for piece in pieces)
    return [*chain.from_iterable(rows)]


def split_rows(count: int, rows: Rows) -> list[Rows]:
    """Return rows of several envs as rows of each env, which are views."""
    return [{path: piece[i : i + 1] for path, piece in rows.items()} for i in range(count)]
