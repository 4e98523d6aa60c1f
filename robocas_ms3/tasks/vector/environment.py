"""The vector environments that `make_vec` gives."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import torch
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv

from robocas_ms3.tasks.vector.processes import ProcessEnv


class RoboCASVectorEnv(ManiSkillVectorEnv):
    """ManiSkill's vector environment, over one batched environment: on a GPU, or a `ProcessEnv`.

    The last observations and infos of episodes are named as gymnasium's ``AutoresetMode.SAME_STEP`` names them:
    ``final_obs`` and ``final_info``, with the flags ``_final_obs`` and ``_final_info``.

    ``info["episode"]`` and ``info["final_info"]["episode"]`` have ``success_at_end`` whether or not terminations are
    ignored; ManiSkill's have it only if they are.
    """

    def step(self, actions: Any) -> tuple[Any, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Step every env; see ``ManiSkillVectorEnv``."""
        obs, reward, terminated, truncated, info = super().step(actions)
        if "final_observation" in info:  # ManiSkill's name
            info["final_obs"] = info.pop("final_observation")
            info["_final_obs"] = info.pop("_final_observation")
        at_end = info.get("final_info", info)
        if self.record_metrics and "success" in at_end:
            at_end["episode"]["success_at_end"] = at_end["success"].clone()
        return obs, reward, terminated, truncated, info  # pyright: ignore[reportReturnType]

    def call(self, name: str, *args: Any, **kwargs: Any) -> Any:
        """What a method gives, or an attribute: in processes a tuple of each env's, on a GPU the whole batch's."""
        if isinstance(self._env, ProcessEnv):
            return self._env.call(name, *args, **kwargs)
        found = self._env.get_wrapper_attr(name)  # ManiSkill's own does not look behind the outermost wrapper
        return found(*args, **kwargs) if callable(found) else found


class NumpyVectorEnv(gym.vector.VectorWrapper):
    """A vector environment whose tensors are NumPy arrays."""

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset; see the environment."""
        return _as_numpy(self.env.reset(seed=seed, options=options))

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step every env; see the environment."""
        return _as_numpy(self.env.step(actions))


def _as_numpy(nested: Any) -> Any:
    if isinstance(nested, torch.Tensor):
        return nested.cpu().numpy()
    if isinstance(nested, dict):
        return {name: _as_numpy(value) for name, value in nested.items()}
    return type(nested)(map(_as_numpy, nested)) if type(nested) in (tuple, list) else nested
