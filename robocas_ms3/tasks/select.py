"""RoboCASSelect-v1: pick one of several identical objects, named by its position."""

from __future__ import annotations

import torch

from robocas_ms3.core.arrays import as_tensor, to_native
from robocas_ms3.scenes.task_specs import SELECT
from robocas_ms3.tasks import terms
from robocas_ms3.tasks.base import RoboCASEnv


class RoboCASSelectEnv(RoboCASEnv):
    """Pick one of several identical objects by a relation, such as "the nearest soap".

    Relations are defined from the robot's point of view.

    In the compared distance, the target differs by at least 3 cm from every other object with its name. For success, no
    other object with its name may be in the basket.
    """

    SPEC = SELECT

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        names = [[asset.asset.name for asset in row] for row in self.object_assets]
        self._kinds = torch.tensor([[row.index(name) for name in row] for row in names], device=self.device)

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Return the result of `RoboCASEnv.evaluate`; ``success`` has the additional condition ``others_out``."""
        found = super().evaluate()
        return {**found, "success": found["success"] & self._is_no_other_in_basket()}

    def success_conditions(self) -> dict[str, torch.Tensor]:
        """Return the success conditions with ``others_out``: no other object of the name is in the basket."""
        return {**super().success_conditions(), "others_out": self._is_no_other_in_basket()}

    def _is_no_other_in_basket(self) -> torch.Tensor:
        """Return (N,) bool, whether no other object with the target's name is in the basket."""
        inside = self.goal.is_at_goal(
            self.success_check.centers_of_mass(to_native(self.object_states)), to_native(self.basket_pose)
        )
        others_in = terms.has_other_of_kind(inside, to_native(self._kinds), to_native(self.target_slot))
        return as_tensor(~others_in)
