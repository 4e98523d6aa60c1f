"""Lets ``gymnasium.make_vec`` find `make_vec`."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium as gym

from robocas_ms3.tasks.vector import make_vec


class _OfSingleEnvs(list):
    """Wrappers for ``gym.make`` alone.

    ``gym.make_vec`` refuses specs with wrappers, and ManiSkill's have one, the time limit, of which `make_vec` takes
    care itself. It looks at a deep copy of the spec, ``gym.make`` at the spec itself.
    """

    def __deepcopy__(self, memo: dict[int, Any]) -> list:
        return []


def register_make_vec(env_id: str) -> None:
    """Make ``gym.make_vec(env_id, ...)`` the same as ``make_vec(env_id, ...)``."""
    spec = gym.spec(env_id)
    spec.vector_entry_point = partial(make_vec, env_id)
    spec.additional_wrappers = _OfSingleEnvs(spec.additional_wrappers)  # pyright: ignore[reportAttributeAccessIssue]
