"""A worker process: makes its environments and does with them what it is told, until it is told to leave."""

from __future__ import annotations

import faulthandler
import importlib
import logging
import os
import pickle
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.core.errors import LayoutError, VectorEnvError
from robocas_ms3.core.exits import end_process
from robocas_ms3.core.remote_errors import RemoteError
from robocas_ms3.core.words import escape_log_lines, escape_tracebacks
from robocas_ms3.core.workers import use_one_torch_thread
from robocas_ms3.tasks.base import RoboCASEnv
from robocas_ms3.tasks.vector.block import Block, Field, Path, leaves, space_fields
from robocas_ms3.tasks.vector.handle import LEAVE, NUMBER, STEP, name_envs
from robocas_ms3.tasks.vector.messages import Call, EnvDescription, Order, Reset, Row, Share

_LOOK = 0.5  # s between two looks at the parent
FIRST_SEED = 2022  # of env 0's resets without a seed, as in ManiSkill; env 1 has the next
_log = logging.getLogger(__name__)


def main(connection: int, memory: int, parent: int) -> None:
    """Serve until told to leave, or until the process that started this one is no more.

    Args:
        connection: file descriptor of the way there.
        memory: the same of the shared memory.
        parent: that process.
    """
    faulthandler.enable()
    escape_log_lines()
    escape_tracebacks()
    threading.Thread(target=_leave_with, args=(parent,), daemon=True).start()
    for descriptor in (connection, memory):
        os.set_inheritable(descriptor, False)
    use_one_torch_thread()
    with suppress(EOFError, OSError):  # nobody is there any more
        _Worker(Connection(connection), memory).serve()
    end_process(0)


def _leave_with(parent: int) -> None:
    """End this process when its parent is no more, even during a step.

    Not `die_with_parent`: the thread that started this process may end before the environments do.
    """
    while os.getppid() == parent:
        time.sleep(_LOOK)
    os._exit(1)


class _Worker:
    def __init__(self, connection: Connection, memory: int) -> None:
        self.connection, self.memory = connection, memory
        self.envs: dict[int, gym.Env] = {}
        self.at_work: Any = {}

    def serve(self) -> None:
        try:
            self.answer(self.start(self.listen()))
            while (message := self.listen()) != LEAVE:
                self.answer(self.obey(None if message == STEP else pickle.loads(message)))
        finally:
            self.each(self.envs, lambda env: self.envs[env].close())

    def listen(self) -> bytes:
        """The next message."""
        message = self.connection.recv_bytes()
        self.number = message[:NUMBER]
        return message[NUMBER:]

    def answer(self, found: Any) -> None:
        """Send what was found, with the number of the message; of None there is nothing to say."""
        self.connection.send_bytes(self.number + (b"" if found is None else pickle.dumps(found)))

    def each(self, envs: Iterable[int], act: Callable[[int], None]) -> RemoteError | None:
        """Do something with each environment; the first error, after which the others have their turn all the same.

        So what becomes of an environment does not depend on which others are in its process.
        """
        failed = None
        for env in list(envs):
            self.at_work[env] = True
            try:
                act(env)
            except BaseException as error:  # noqa: BLE001  (it is raised again where it can be dealt with)
                failed = failed or _failed(name_envs([env]), error)
            self.at_work[env] = False
        return failed

    def start(self, message: bytes) -> EnvDescription | RemoteError:
        """Make what was ordered."""
        try:
            order: Order = pickle.loads(message).fn
            failed = self.each(order.envs, lambda env: self.make(order, env))
            return failed or _describe(self.envs[order.envs[0]])
        except BaseException as error:  # noqa: BLE001  (as in `each`)
            return _failed("a worker", error)

    def make(self, order: Order, env: int) -> None:
        """Make an environment, whose resets without a seed draw from a stream of its own."""
        importlib.import_module(order.module)
        made: Any = gym.make(order.env_id, **order.kwargs)
        self.envs[env] = made
        base = made.unwrapped
        if env > 0:  # ManiSkill makes each with the first one's seed
            base._set_main_rng([FIRST_SEED + env])
            if base.reconfiguration_freq == 0:  # its scene stays
                if isinstance(base, RoboCASEnv):
                    base.seeds.first_reset = True  # nobody asked for this seed either
                base.reset(seed=[FIRST_SEED + env], options={"reconfigure": True})
        for wrap in order.wrappers:
            made = self.envs[env] = wrap(made)

    def share(self, command: Share) -> None:
        """Read actions from shared memory, and write what comes of them there."""
        block = Block(self.memory, command.fields, command.num_envs)
        arrays = block.arrays
        self.actions, self.at_work = arrays["action",], arrays["at_work",]
        self.reward, self.terminated, self.truncated = (arrays[name,] for name in ("reward", "terminated", "truncated"))
        self.obs, self.info = block.under("obs"), block.under("info")
        self.rest: dict[int, bytes] = {}  # pickled infos for which the shared memory has no place, by their paths

    def obey(self, command: Share | Reset | Call | None) -> Any:
        """Do as told, None: step. What is to be answered: a `RemoteError`, results of a call, `rest`, or None."""
        if isinstance(command, Share):
            return self.share(command)
        results: dict[int, Any] = {}
        self.rest = {}
        if command is None:
            failed = self.each(self.envs, self.step)
        elif isinstance(command, Reset):
            seeds = command.seeds
            failed = self.each(seeds, lambda env: self.reset(env, *seeds[env], dict(command.options)))
        else:
            failed = self.each(self.envs, lambda env: results.update({env: self.call(env, command)}))
        return failed or results or self.rest or None

    def step(self, env: int) -> None:
        """Take an action; what does not go into the shared memory goes to `rest`."""
        obs, self.reward[env], terminated, truncated, info = self.envs[env].step(self.actions[env].copy())
        self.terminated[env], self.truncated[env] = bool(terminated), bool(truncated)
        self.show(env, obs, info)

    def reset(self, env: int, seed: int | None, replaceable: bool, options: dict) -> None:
        """Reset; without a layout for a seed that may be replaced go on to the next of the seed's stream."""
        try:
            obs, info = self.envs[env].reset(seed=seed, options=options)
        except LayoutError as error:
            if not replaceable:
                raise
            _log.warning("env %d: no layout for seed %d, another is drawn: %s", env, seed, error)
            obs, info = self.envs[env].reset(options=options)
        self.show(env, obs, info)

    def show(self, env: int, obs: Any, info: dict) -> None:
        """Write what an environment observes."""
        written = 0
        for path, leaf in leaves(obs):
            if path not in self.obs:
                fix = "A wrapper that adds one needs a single_observation_space."
                raise VectorEnvError("no such observation at first", where=".".join(path), fix=fix)
            _write(leaf, self.obs[path][env : env + 1], ("obs", *path))
            written += 1
        rest = {}
        for path, leaf in leaves(info):
            if path in self.info:
                _write(leaf, self.info[path][env : env + 1], ("info", *path))
                written += 1
            else:
                rest[path] = Row.of(leaf)
        if written < len(self.obs) + len(self.info):
            there = {path for nested in (obs, info) for path, _ in leaves(nested)}
            lacking = [".".join(path) for path in [*self.obs, *self.info] if path not in there]
            raise VectorEnvError("observation or info lacks what it had at first", expected=lacking)
        if rest:
            self.rest[env] = pickle.dumps(rest)  # here: if that can't be, it is this environment's error

    def call(self, env: int, command: Call) -> Any:
        """The method's result, or the attribute."""
        found: Any = self.envs[env].get_wrapper_attr(command.name)
        result = found(*command.args, **command.kwargs) if callable(found) else found
        pickle.dumps(result)  # if that can't be, it is this environment's error
        return result


def _write(leaf: Any, row: NDArray[Any], path: Path) -> None:
    """Write a batch of one env to its row (1, ...)."""
    shape = tuple(np.shape(leaf))
    if shape != row.shape:  # NumPy would repeat what is smaller
        where, fix = ".".join(path), "A wrapper that changes it needs a single_observation_space." * (path[0] == "obs")
        raise VectorEnvError("has not the shape it had at first", where=where, expected=row.shape, found=shape, fix=fix)
    row[...] = leaf.cpu().numpy() if isinstance(leaf, torch.Tensor) else leaf


def _describe(env: gym.Env) -> EnvDescription:
    """What environments like this one share.

    Raises:
        VectorEnvError: actions or observations are not of a kind that can be shared.
    """
    observations, actions = (env.get_wrapper_attr(f"single_{kind}_space") for kind in ("observation", "action"))
    if not isinstance(actions, gym.spaces.Box):
        raise VectorEnvError("these actions can't be sent to processes", expected="a box", found=actions)
    infos_of = env.get_wrapper_attr("get_info")  # of the outermost that says what infos hold
    infos = [(path, np.asarray(leaf)) for path, leaf in leaves(infos_of()) if isinstance(leaf, torch.Tensor)]
    fields = [
        Field(("action",), actions.shape, actions.dtype.name),
        Field(("at_work",), (), "bool"),
        Field(("reward",), (), "float32"),
        Field(("terminated",), (), "bool"),
        Field(("truncated",), (), "bool"),
        *space_fields(observations, ("obs",)),
        *(Field(("info", *path), array.shape[1:], array.dtype.name) for path, array in infos),
    ]
    return EnvDescription(observations, actions, tuple(fields), env.render_mode, dict(env.metadata))


def _failed(where: str, error: BaseException) -> RemoteError:
    """An error of an environment; what is none of an `Exception` must not end the starter."""
    return RemoteError.of(error, where, sendable=Exception, otherwise=VectorEnvError)
