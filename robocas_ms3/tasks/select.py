"""RoboCASSelect-v1: grasp one of several identical objects, named by where it stands, and drop it into the basket."""

from __future__ import annotations

from typing import Any

import torch

from robocas_ms3.core.arrays import native
from robocas_ms3.scenes.task_specs import SELECT
from robocas_ms3.tasks import terms
from robocas_ms3.tasks.learning import LearningEnv


class RoboCASSelectEnv(LearningEnv):
    """Select: "the nearest soap", "the second soda can from the left", seen from the robot. The others are wrong.

    The relation is clear: what it compares differs from every other such object by at least 3 cm. Success asks for the
    named one alone: none of the others may lie in the basket too.
    """

    SPEC = SELECT

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        names = [[asset.asset.name for asset in row] for row in self.object_assets]
        self._kinds = torch.tensor([[row.index(name) for name in row] for row in names], device=self.device)

    def _target_measures(self, touched: Any, objects: Any, basket: Any) -> dict[str, Any]:
        """As of `TransferEnv`, and ``others_out``: no other object of the target's name is in the basket."""
        inside = self.goal.holds(self.centers(objects), basket)
        others_in = terms.another_of_its_kind(inside, native(self._kinds), native(self.target_slot))
        return {**super()._target_measures(touched, objects, basket), "others_out": ~others_in}
