"""The instruction of each env's episode."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch

from robocas_ms3.scenes.language.instructions import Instruction, InstructionSlots, choose_instruction, part_name
from robocas_ms3.scenes.relations import Relation

_LANGUAGE = 100  # stream of an episode's seed; those of layouts are in scenes/sample.py


class Instructions:
    """Instructions by env, made when they are asked for.

    Args:
        env: the `base.RoboCASEnv`.
    """

    def __init__(self, env: Any) -> None:
        self._env = env
        self._made: dict[int, Instruction] = {}

    def reset(self, envs: torch.Tensor) -> None:
        """Forget the instructions of some envs (E,)."""
        for env in envs.tolist():
            self._made.pop(env, None)

    def of(self, env: int) -> Instruction:
        """Return the instruction of an env."""
        if env not in self._made:
            self._made[env] = self.choose(env, self._env.target_asset(env).asset.name)
        return self._made[env]

    def names(self, env: int) -> set[str]:
        """Return the names of the objects in an env."""
        present = self._env.layout(env).present
        return {asset.asset.name for asset, used in zip(self._env.object_assets[env], present, strict=True) if used}

    def choose(self, env: int, name: str) -> Instruction:
        """Return the instruction that an env would have if its target had this name."""
        config, layout = self._env.task_config, self._env.layout(env)
        slots = InstructionSlots(
            config.task,
            object=name,
            support=config.support,
            relation=cast("Relation | None", layout.relation or None),
            part=config.opening.part or part_name(config.opening.handle) if config.opening else "",
        )
        rng = np.random.default_rng([int(self._env.seeds.layout_seeds[env]), _LANGUAGE])
        others, language = sorted(self.names(env) - {name}), config.language
        return choose_instruction(rng, slots, language.split, others=others, synonyms=language.synonyms)
