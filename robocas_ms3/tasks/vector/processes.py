"""Environments in processes of their own, which look like one of ManiSkill's batched environments on a GPU."""

from __future__ import annotations

import os
import pickle
import weakref
from collections.abc import Callable, Sequence
from copy import copy
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector.utils import CloudpickleWrapper, batch_space
from mani_skill.utils.common import torch_clone_dict
from mani_skill.utils.registration import REGISTERED_ENVS

from robocas_ms3.core.errors import VectorEnvError, WorkerDied
from robocas_ms3.core.remote_errors import RemoteError
from robocas_ms3.core.workers import NO_LIMITS, Limits
from robocas_ms3.tasks.seeds import following_seeds
from robocas_ms3.tasks.vector.block import Block, nest, open_memory
from robocas_ms3.tasks.vector.handle import STEP, WorkerHandle, close_all, name_envs
from robocas_ms3.tasks.vector.messages import Call, EnvDescription, Order, Reset, Row, Share


class ProcessEnv(gym.Env):
    """Several environments, each of one env on the CPU, in worker processes; batched as ``BaseEnv`` is on a GPU.

    What an env does follows from its seeds and actions alone, whatever the others do and whichever process it is in.
    Without a seed, env i's stream of seeds begins with 2022 + i, as ManiSkill's.

    Gymnasium's ``AsyncVectorEnv`` does not serve: it takes a process for each env and one more in this one, and
    makes of an error in a worker one without its traceback, and of a killed worker an ``EOFError``.

    Args:
        env_id: gymnasium's, of a ManiSkill environment.
        num_envs: how many.
        workers: processes, each with as many envs as the others, or one more.
        kwargs: for ``gym.make``; pickled, with what the main program defines.
        wrappers: put around each env, the first one first; pickled the same way.
        limits: of what a process may take for a step or a reset of its envs; it is ended where it takes more.

    Raises:
        VectorEnvError: they can't be sent to processes.
        WorkerDied: a process died.
        Exception: whatever making an environment raises.
    """

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
        self.reconfiguration_freq = 0  # of the batch; what a reset builds anew is each env's own affair
        self.spec = copy(gym.spec(env_id))
        if kwargs.get("max_episode_steps") is not None:  # which ManiSkill's helpers read here
            self.spec.max_episode_steps = kwargs["max_episode_steps"]
        self._limits = limits
        self._seed_range: tuple[int, int] | None = kwargs.get("seeds")
        self._must_reset: set[int] = set()  # envs that an interrupted or failed call left in who knows what state
        cuts = [num_envs * worker // workers for worker in range(workers + 1)]
        shares = [range(*cut) for cut in zip(cuts, cuts[1:], strict=False)]
        theirs = REGISTERED_ENVS.get(self.spec.id)  # ours are there once they are loaded
        module = theirs.cls.__module__ if theirs else "robocas_ms3"
        if module == "__main__":
            fix = f'Put it into a module, and pass "the_module:{self.spec.id}".'
            raise VectorEnvError("registered in the program itself, which processes don't know", where=env_id, fix=fix)
        orders = [_pickled(Order(env_id, module, share, kwargs, tuple(wrappers))) for share in shares]
        self._workers: list[WorkerHandle] = []
        memory = open_memory()
        # runs at `close`, when this is collected, or when Python ends; in a fork of this process it does nothing
        self._close = weakref.finalize(self, close_all, self._workers, memory, os.getpid())
        try:
            self._workers += [WorkerHandle(share, memory) for share in shares]
            made: list[EnvDescription] = self._ask(orders)
            if any(set(one.fields) != set(made[0].fields) for one in made):  # pictures come in any order
                raise VectorEnvError("environments differ in what they observe", where=env_id)
            self._share(Block(memory, made[0].fields, num_envs))
            self._ask([pickle.dumps(Share(made[0].fields, num_envs))] * workers)
        except BaseException:
            self.close()
            raise
        self.render_mode, self.metadata = made[0].render_mode, made[0].metadata
        self.single_observation_space, self.single_action_space = made[0].observation_space, made[0].action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def _share(self, block: Block) -> None:
        self._actions = block.arrays["action",]
        shown = {path: torch.from_numpy(array) for path, array in block.arrays.items() if path[0] != "action"}
        self._reward, self._terminated, self._truncated = (shown[n,] for n in ("reward", "terminated", "truncated"))
        views = nest({path: shown[path] for path in shown if len(path) > 1 or path == ("obs",)})
        self._obs, self._info = views.get("obs", {}), views["info"]
        for worker in self._workers:
            worker.at_work = block.arrays["at_work",]
            worker.limits = self._limits

    @property
    def pids(self) -> list[int]:
        """The worker processes."""
        return [worker.process.pid for worker in self._workers]

    @property
    def elapsed_steps(self) -> torch.Tensor:
        """(N,) int32 control steps since each env's reset; don't write to it."""
        return self._info["elapsed_steps"]

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset all envs, or those of ``options["env_idx"]``; the others stay as they are.

        Args:
            seed: of each env that is reset; a single one is the first one's, and the others take those after it, within
                the range ``seeds`` if it is of the range. None: the next of each env's own stream.
            options: of ``BaseEnv``.

        Raises:
            VectorEnvError: seeds or envs don't fit.
            LayoutError: there is no layout for a seed that was asked for, or for many that were drawn.
        """
        options = dict(options or {})
        envs = self._numbers(options.pop("env_idx")) if "env_idx" in options else list(range(self.num_envs))
        seeds = self._seeds(seed, len(envs))
        # Of a single seed only the first env's was asked for. Without a seed each env looks for a possible one itself.
        replaceable = [seed is not None and np.ndim(seed) == 0 and i > 0 for i in range(len(envs))]
        asked = dict(zip(envs, zip(seeds, replaceable, strict=True), strict=True))
        self._must_reset |= set(envs)
        messages = [
            pickle.dumps(Reset({env: asked[env] for env in worker.envs if env in asked}, options))
            for worker in self._workers
        ]
        rest = self._ask(messages)
        self._must_reset -= set(envs)
        return torch_clone_dict(self._obs), self._infos(rest)

    def step(self, action: Any) -> tuple[Any, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Step every env; see ``BaseEnv``.

        Args:
            action: (N, A) array or tensor, for one env (A,) too.

        Raises:
            VectorEnvError: it is of another shape, or all envs have to be reset first.
        """
        if self._must_reset:
            left = name_envs(sorted(self._must_reset))
            raise VectorEnvError("an earlier call was interrupted or failed", where=left, fix="Reset them first.")
        action = action.cpu().numpy() if isinstance(action, torch.Tensor) else np.asarray(action)
        if self._actions.shape not in (action.shape, (1, *action.shape)):
            raise VectorEnvError("actions don't fit", expected=self._actions.shape, found=action.shape)
        self._actions[:] = action
        self._must_reset = set(range(self.num_envs))
        rest = self._ask([STEP] * len(self._workers))
        self._must_reset = set()
        obs, info = torch_clone_dict(self._obs), self._infos(rest)
        return obs, self._reward.clone(), self._terminated.clone(), self._truncated.clone(), info

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """What a method of each env gives, or the attribute of that name; it is pickled."""
        message = pickle.dumps(Call(name, args, kwargs))
        answers = self._ask([message] * len(self._workers))
        results = {env: result for answer in answers for env, result in answer.items()}
        return tuple(results[env] for env in range(self.num_envs))

    def get_language_instruction(self) -> list[str]:
        """The instruction of each env."""
        return [said for one in self.call("get_language_instruction") for said in one]

    def render(self) -> Any:
        """Pictures (N, H, W, 3) of all envs, as ``render_mode`` says."""
        pictures = self.call("render")
        return None if any(picture is None for picture in pictures) else torch.cat([*map(torch.as_tensor, pictures)])

    def close(self) -> None:
        """Close all environments and end their processes; nothing happens where that was done."""
        self._must_reset.clear()
        self._close()

    def _ask(self, messages: Sequence[bytes]) -> list[Any]:
        """Send each worker its message; their answers.

        Raises:
            VectorEnvError: it is closed.
            WorkerDied: a process died; all of them are ended.
            Exception: whatever the first env that failed raised.
        """
        if not self._close.alive:
            raise VectorEnvError("these environments are closed", fix="Make them again.")
        try:
            for worker, message in zip(self._workers, messages, strict=True):
                worker.send(message)
            answers = [worker.receive() for worker in self._workers]
        except WorkerDied:
            self.close()
            raise
        for answer in answers:
            if isinstance(answer, RemoteError):
                answer.reraise()
        return answers

    def _infos(self, answers: list[dict | None]) -> dict[str, Any]:
        """Infos of all envs; what isn't a tensor (1, ...) of each env as a list, None for the envs that have none."""
        infos = torch_clone_dict(self._info)
        rest = {env: pickle.loads(said) for answer in answers if answer for env, said in answer.items()}
        gathered: dict[tuple[str, ...], Any] = {}
        for path in {path: None for said in rest.values() for path in said}:
            gathered[path] = Row.join([rest.get(env, {}).get(path) for env in range(self.num_envs)])
        if ("reconfigure",) in gathered:
            gathered["reconfigure",] = any(gathered["reconfigure",])
        return {**infos, **nest(gathered)} if gathered else infos

    def _numbers(self, chosen: Any) -> list[int]:
        chosen = np.asarray(chosen.cpu() if isinstance(chosen, torch.Tensor) else chosen)
        envs = np.flatnonzero(chosen) if chosen.dtype == bool and chosen.shape == (self.num_envs,) else chosen
        numbers = envs.tolist()
        if envs.ndim != 1 or len(set(numbers)) < len(numbers) or not set(numbers) <= set(range(self.num_envs)):
            expected = f"different numbers from 0 to {self.num_envs - 1}"
            raise VectorEnvError("no such environments", where="env_idx", expected=expected, found=numbers)
        return numbers

    def _seeds(self, seed: Any, count: int) -> list[int | None]:
        if seed is None:
            return [None] * count
        if np.ndim(seed) == 0:
            return [*following_seeds(int(seed), count, self._seed_range)]
        seeds = [None if one is None else int(one) for one in seed]
        if len(seeds) != count:
            raise VectorEnvError("seeds don't fit", expected=f"{count}, or a single one", found=len(seeds))
        return seeds


def _pickled(order: Order) -> bytes:
    try:
        return pickle.dumps(CloudpickleWrapper(cast("Any", order)))
    except Exception as error:
        raise VectorEnvError("arguments can't be sent to processes", where=order.env_id, found=error) from error
