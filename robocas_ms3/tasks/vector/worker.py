"""A worker of `ProcessEnv`: some of its environments, in a process of their own."""

from __future__ import annotations

import faulthandler
import importlib
import logging
import mmap
import os
import pickle
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.exits import exit_error
from robocas_ms3.core.remote_errors import RemoteError
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
        with open(self._settings.at_work, "r+b") as file:
            self._at_work = mmap.mmap(file.fileno(), 0)
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
    ) -> tuple[Rows, RemoteError | None]:
        """Reset some environments: of each its seed or None, and whether another may replace it without a layout."""
        rows, failed = self._each(seeds, lambda env: self._reset(env, *seeds[env], dict(options)))
        return join_rows([(1, row) for row in rows]), failed

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
            except KeyboardInterrupt as error:  # of the code: the process ignores Ctrl-C
                failed = failed or RemoteError.of(exit_error(error, f"env {env}"), f"env {env}")
            except BaseException as error:  # noqa: BLE001  (raised again in the main process)
                failed = failed or RemoteError.of(error, f"env {env}")
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


def as_rows(nested: dict[str, Any]) -> Rows:
    """Return nested dictionaries of one env as rows; arrays pickle in a thirtieth of the time of tensors."""
    return {path: _as_row(leaf) for path, leaf in _leaves(nested, ())}


def _as_row(leaf: Any) -> Any:
    if isinstance(leaf, torch.Tensor):
        leaf = (leaf.float() if leaf.dtype == torch.bfloat16 else leaf).detach().cpu().numpy()
    return leaf if isinstance(leaf, np.ndarray) and leaf.shape[:1] == (1,) else [leaf]


def _leaves(nested: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    if isinstance(nested, dict):
        for name, value in nested.items():
            yield from _leaves(value, (*path, name))
    else:
        yield path, nested


def join_rows(parts: Sequence[tuple[int, Rows]]) -> Rows:
    """Return rows of several (number of envs, rows) as rows of all envs; None where an env has none."""
    paths = dict.fromkeys(path for _, rows in parts for path in rows)
    return {path: _join([rows.get(path, [None] * count) for count, rows in parts]) for path in paths}


def _join(pieces: Sequence[Any]) -> Any:
    """Join pieces into one array, which is a copy; where that is impossible, into a list of an entry per env."""
    first = pieces[0]
    if all(_are_alike(piece, first) for piece in pieces):
        return np.concatenate(pieces)
    return [row for piece in pieces for row in _split(piece)]


def _are_alike(one: Any, other: Any) -> bool:
    both = isinstance(one, np.ndarray) and isinstance(other, np.ndarray)
    return both and one.dtype == other.dtype and one.shape[1:] == other.shape[1:]


def _split(piece: Any) -> list[Any]:
    """Return one entry per env of an array (E, ...), which becomes copies (1, ...), or of a list."""
    return [piece[i : i + 1].copy() for i in range(len(piece))] if isinstance(piece, np.ndarray) else list(piece)


def replace_rows(old: Any, envs: list[int], new: Any) -> Any:
    """Return the piece of all envs of a worker with new entries of some; an array of the same kind is changed."""
    if _are_alike(old, new):
        old[envs] = new
        return old
    rows = _split(old)
    for env, row in zip(envs, _split(new), strict=True):
        rows[env] = row
    return _join(rows) if all(isinstance(row, np.ndarray) for row in rows) else rows
