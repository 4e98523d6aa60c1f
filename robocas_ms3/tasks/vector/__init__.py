"""Vector environments: several environments in worker processes on a CPU, or in one batch on a GPU."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import VectorEnv
from mani_skill.envs.utils.system.backend import CPU_SIM_BACKENDS
from mani_skill.utils.registration import REGISTERED_ENVS
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv
from numpy.typing import NDArray

from robocas_ms3.core.errors import VectorEnvError
from robocas_ms3.core.workers import NO_LIMITS, Limits
from robocas_ms3.robots.camera_models import CameraModel
from robocas_ms3.scenes.task_specs import TASKS
from robocas_ms3.tasks.vector.process_env import ProcessEnv

Backend = Literal["auto", "processes", "gpu"]
_VECTOR_OPTIONS = ("auto_reset", "ignore_terminations", "record_metrics")

__all__ = ["Backend", "ProcessEnv", "RoboCASVectorEnv", "choose_backend", "make_vec"]


def make_vec(
    env_id: str,
    num_envs: int = 1,
    *,
    backend: Backend = "auto",
    workers: int | None = None,
    arrays: Literal["torch", "numpy"] = "torch",
    wrappers: Sequence[Callable[[gym.Env], gym.Env]] = (),
    limits: Limits = NO_LIMITS,
    **kwargs: Any,
) -> VectorEnv:
    """Make a `RoboCASVectorEnv` of N environments, in worker processes or in one batch on a GPU.

    In worker processes, an env behaves exactly like an environment of ``gym.make``: it depends on its seeds and actions
    only, not on ``num_envs`` or ``workers``. With ``reconfiguration_freq=0``, env i keeps the objects of seed 2022 + i.
    The processes end when the vector environment is closed or deleted, and when this process ends.

    Args:
        env_id: gymnasium id, such as ``RoboCASPick-v1``; ``module:Id-v1`` imports the module first.
        num_envs: N.
        backend: ``processes`` (on the CPU), ``gpu`` (one batch), or ``auto``: a GPU if there is one.
        workers: number of processes; default: one per env, at most one per core. 0: no processes, the envs run in this
            process, one after the other and without limits.
        arrays: type of the results, ``torch`` or ``numpy``.
        wrappers: functions that wrap each env, or the batch on a GPU; the first function makes the innermost wrapper.
        limits: time and memory limits of a process per step or reset; a process that exceeds them is killed.
        kwargs: ``auto_reset``, ``ignore_terminations`` and ``record_metrics`` of `RoboCASVectorEnv`; other arguments
            are passed to ``gym.make``, such as ``obs_mode``, ``control_mode``, ``config``, ``max_episode_steps``.

    Raises:
        VectorEnvError: an argument is invalid, or there is no GPU for this backend.
        VectorEnvCrashError: a worker process crashed.
        Exception: any error that ``gym.make`` raises.
    """
    for name, value, least in (("num_envs", num_envs, 1), ("workers", 1 if workers is None else workers, 0)):
        if not isinstance(value, int) or value < least:
            expected = f"an integer of at least {least}"
            raise VectorEnvError("invalid number", where=name, expected=expected, found=repr(value))
    if arrays not in ("torch", "numpy"):
        raise VectorEnvError("invalid value", where="arrays", expected='"torch" or "numpy"', found=repr(arrays))
    _check_id(env_id)
    options = {name: kwargs.pop(name) for name in _VECTOR_OPTIONS if name in kwargs}
    if choose_backend(backend, kwargs.get("sim_backend", "auto")) == "gpu":
        env = gym.make(env_id, num_envs=num_envs, **{"sim_backend": "physx_cuda", **kwargs})
        for wrap in wrappers:
            env = wrap(env)
    else:
        workers = min(num_envs, len(os.sched_getaffinity(0)) if workers is None else workers)
        env = ProcessEnv(env_id, num_envs, workers, kwargs, wrappers, limits)
    return RoboCASVectorEnv(env, arrays, **options)


def choose_backend(backend: str, sim_backend: str = "auto") -> Literal["processes", "gpu"]:
    """Return the backend on which a vector environment will run.

    Args:
        backend: requested backend; ``auto``: a GPU if there is one and ``sim_backend`` names no CPU.
        sim_backend: argument of ManiSkill: ``auto``, or the device on which PhysX runs.

    Raises:
        VectorEnvError: the backend is unknown or contradicts ``sim_backend``, or there is no GPU for it.
    """
    if backend not in get_args(Backend):
        expected = f"one of {', '.join(get_args(Backend))}"
        raise VectorEnvError("no such backend", where="make_vec", expected=expected, found=repr(backend))
    on_cpu = sim_backend in CPU_SIM_BACKENDS
    if (backend == "gpu" and on_cpu) or (backend == "processes" and sim_backend != "auto" and not on_cpu):
        found = f"backend={backend!r} and sim_backend={sim_backend!r}"
        fix = "Remove one of the arguments. With processes, PhysX runs on the CPU; with gpu, on the GPU."
        raise VectorEnvError("backend and sim_backend contradict each other", where="make_vec", found=found, fix=fix)
    if backend == "processes" or on_cpu:
        return "processes"
    if torch.cuda.is_available():
        return "gpu"
    if backend == "auto" and sim_backend == "auto":
        return "processes"
    fix = 'Pass backend="processes" to use the CPU.'
    what = "this backend needs a GPU"
    raise VectorEnvError(what, where="make_vec", expected="a CUDA device", found="none", fix=fix)


class RoboCASVectorEnv(ManiSkillVectorEnv):
    """Vector environment of ManiSkill around a batched environment: a batch on a GPU, or a `ProcessEnv`.

    In a step in which an episode ends, ``info`` has the last observation and info of the episode in ``final_obs`` and
    ``final_info``, and flags (N,) in ``_final_obs`` and ``_final_info``. These are the names of gymnasium's
    ``AutoresetMode.SAME_STEP``. ``info["episode"]`` and ``info["final_info"]["episode"]`` have ``return``,
    ``episode_len``, ``reward`` (mean per step), ``success_once`` and ``success_at_end``.
    ``reset(seed=..., options={"env_idx": ...})`` resets some envs.

    Args:
        env: the batched environment.
        arrays: type of observations, rewards, flags and infos, ``torch`` or ``numpy``.
        auto_reset: whether an env is reset in the step in which its episode ends; default: True.
        ignore_terminations: whether an episode continues after success or failure until the time limit; default: False.
        record_metrics: whether infos have the entry ``episode``; default: True.
    """

    def __init__(self, env: gym.Env, arrays: Literal["torch", "numpy"] = "torch", **options: bool) -> None:
        super().__init__(env, **{"record_metrics": True, **options})
        self._in_numpy = arrays == "numpy"

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        found = super().reset(**kwargs)
        return _as_numpy(found) if self._in_numpy else found

    def step(self, actions: Any) -> tuple[Any, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:  # pyright: ignore[reportIncompatibleMethodOverride]
        obs, reward, terminated, truncated, info = super().step(actions)
        if "final_observation" in info:  # ManiSkill's name
            info["final_obs"] = info.pop("final_observation")
            info["_final_obs"] = info.pop("_final_observation")
        at_end = info.get("final_info", info)
        if self.record_metrics and "success" in at_end:  # ManiSkill adds it with ``ignore_terminations`` only
            at_end["episode"]["success_at_end"] = at_end["success"].clone()
        found: Any = obs, reward, terminated, truncated, info
        return _as_numpy(found) if self._in_numpy else found

    def render_images(self, envs: NDArray[np.integer]) -> dict[str, dict[str, Any]]:
        """Render the present state of E envs; return camera -> kind, such as ``rgb`` -> (E, H, W, C).

        The envs need an ``obs_mode`` with images. A batch on a GPU renders all envs.
        """
        if isinstance(self._env, ProcessEnv):
            found = self._env.render_images(envs)
        else:
            index = torch.as_tensor(envs, device=self.device)
            rendered = self._env.get_wrapper_attr("render_images")()
            found = {camera: {kind: of[index] for kind, of in kinds.items()} for camera, kinds in rendered.items()}
        return _as_numpy(found) if self._in_numpy else found

    def camera_models(self) -> list[dict[str, CameraModel]]:
        """Return the intrinsics and poses of the cameras of each env, by name (`SceneEnv.camera_models`)."""
        found = self.call("camera_models")
        return [models for of in found for models in of] if isinstance(self._env, ProcessEnv) else found

    def call(self, name: str, *args: Any, **kwargs: Any) -> Any:
        """Call a method or read an attribute of each env (processes) or of the batch (GPU).

        Processes return a tuple with one value per env.
        """
        if isinstance(self._env, ProcessEnv):
            return self._env.call(name, *args, **kwargs)
        found = self._env.get_wrapper_attr(name)  # ManiSkill's method checks the outermost wrapper only
        return found(*args, **kwargs) if callable(found) else found

    def call_each(self, name: str, args: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
        """Call a method of some envs, by index, with their own arguments; return the results by index.

        Only with processes.
        """
        assert isinstance(self._env, ProcessEnv)
        return self._env.call_each(name, args)


def _as_numpy(nested: Any) -> Any:
    if isinstance(nested, torch.Tensor):
        return nested.cpu().numpy()
    if isinstance(nested, dict):
        return {name: _as_numpy(value) for name, value in nested.items()}
    return type(nested)(map(_as_numpy, nested)) if type(nested) in (tuple, list) else nested


def _check_id(env_id: str) -> None:
    ours = sorted(task.env_id for task in TASKS.values())
    expected = f"a gymnasium id such as {', '.join(ours)}"
    try:
        known = gym.spec(env_id).id in {*ours, *REGISTERED_ENVS}
    except (gym.error.Error, ModuleNotFoundError) as error:
        raise VectorEnvError("no such environment", where=env_id, expected=expected, found=error) from error
    if not known:
        raise VectorEnvError("not a ManiSkill environment", where=env_id, expected=expected)
