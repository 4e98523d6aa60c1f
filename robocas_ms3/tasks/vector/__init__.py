"""Several environments at once, as a vector environment: in processes on a CPU, batched on a GPU."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any, Literal

import gymnasium as gym
from gymnasium.vector import VectorEnv
from mani_skill.utils.registration import REGISTERED_ENVS

from robocas_ms3.core.errors import VectorEnvError
from robocas_ms3.core.workers import NO_LIMITS, Limits
from robocas_ms3.scenes.task_specs import TASKS
from robocas_ms3.tasks.vector.backend import Backend, choose_backend
from robocas_ms3.tasks.vector.environment import NumpyVectorEnv, RoboCASVectorEnv
from robocas_ms3.tasks.vector.processes import ProcessEnv

__all__ = ["NumpyVectorEnv", "ProcessEnv", "RoboCASVectorEnv", "make_vec"]


def make_vec(
    env_id: str,
    num_envs: int = 1,
    *,
    backend: Backend = "auto",
    workers: int | None = None,
    arrays: Literal["torch", "numpy"] = "torch",
    auto_reset: bool = True,
    ignore_terminations: bool = False,
    record_metrics: bool = True,
    wrappers: Sequence[Callable[[gym.Env], gym.Env]] = (),
    limits: Limits = NO_LIMITS,
    **kwargs: Any,
) -> VectorEnv:
    """Several environments as one vector environment, with ManiSkill's conventions.

    Observations, rewards and infos are tensors (N, ...) or dictionaries of them. An env that ends is reset in the same
    step; its last observation and info are rows of ``info["final_obs"]`` and ``info["final_info"]``, where
    ``info["_final_info"]`` (N,) says so. ``final_info["episode"]`` has ``return``, ``episode_len``, ``reward``,
    ``success_once``, ``success_at_end``. ``reset(seed=..., options={"env_idx": ...})`` resets some envs.

    In processes, what an env does follows from its seeds and actions alone, not from ``num_envs`` or ``workers``, and
    is what ``gym.make`` gives; with ``reconfiguration_freq=0`` env i keeps the objects of seed 2022 + i. Close it, or
    let it be collected: its processes end with it, and with this one.

    Args:
        env_id: gymnasium's, such as ``RoboCASPick-v1``; ``module:Id-v1`` imports the module first.
        num_envs: N.
        backend: ``processes`` on the CPU, ``gpu`` in one batch, or ``auto``: the GPU where there is one.
        workers: how many processes; default and at most one an env, by default no more than cores.
        arrays: what comes back: tensors, or NumPy arrays.
        auto_reset: whether envs that end are reset.
        ignore_terminations: whether an env goes on after success, until its time is up.
        record_metrics: whether infos have ``episode``.
        wrappers: put around each env, the first one first; on a GPU around the batch.
        limits: of what a process may take for a step or a reset of its envs; it dies where it takes more.
        kwargs: for ``gym.make``, such as ``obs_mode``, ``control_mode``, ``config``, ``max_episode_steps``.

    Raises:
        VectorEnvError: there is no such environment or backend, or no GPU for it.
        WorkerDied: a process died.
        Exception: whatever making an environment raises.
    """
    _check_count("num_envs", num_envs)
    if workers is not None:
        _check_count("workers", workers)
    if arrays not in ("torch", "numpy"):
        raise VectorEnvError("no such arrays", where="make_vec", expected='"torch" or "numpy"', found=repr(arrays))
    _check_id(env_id)
    if choose_backend(backend, kwargs.get("sim_backend", "auto")) == "gpu":
        env = gym.make(env_id, num_envs=num_envs, **{"sim_backend": "physx_cuda", **kwargs})
        for wrap in wrappers:
            env = wrap(env)
    else:
        workers = min(num_envs, workers or len(os.sched_getaffinity(0)))
        env = ProcessEnv(env_id, num_envs, workers, kwargs, wrappers, limits)
    vector = RoboCASVectorEnv(
        env, auto_reset=auto_reset, ignore_terminations=ignore_terminations, record_metrics=record_metrics
    )
    return vector if arrays == "torch" else NumpyVectorEnv(vector)


def _check_count(name: str, value: Any) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise VectorEnvError("is no number of them", where=name, expected="a whole number from 1 on", found=repr(value))


def _check_id(env_id: str) -> None:
    try:
        known = gym.spec(env_id).id in {*_ours(), *REGISTERED_ENVS}
    except (gym.error.Error, ModuleNotFoundError) as error:
        raise VectorEnvError("no such environment", where=env_id, expected=_one(), found=error) from error
    if not known:
        raise VectorEnvError("no environment of ManiSkill's kind", where=env_id, expected=_one())


def _one() -> str:
    return f"one such as {', '.join(sorted(_ours()))}"


def _ours() -> set[str]:
    return {task.env_id for task in TASKS.values()}
