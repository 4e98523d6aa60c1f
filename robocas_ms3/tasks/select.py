"""RoboCASSelect-v1: grasp one of several identical objects, named by where it stands, and drop it into the basket."""

from __future__ import annotations

import torch
from mani_skill.utils.registration import register_env

from robocas_ms3.tasks import terms
from robocas_ms3.tasks.spec import SELECT
from robocas_ms3.tasks.transfer import TransferEnv


@register_env(SELECT.env_id, max_episode_steps=SELECT.max_episode_steps)
class RoboCASSelectEnv(TransferEnv):
    """Select: "the nearest soap", "the second soda can from the left", seen from the robot. The others are wrong.

    The relation is clear: what it compares differs from every other such object by at least 3 cm. Success asks for the
    named one alone: none of the others may lie in the basket too.
    """

    SPEC = SELECT

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        names = [[asset.asset.name for asset in row] for row in self.object_assets]
        self._kinds = torch.tensor([[row.index(name) for name in row] for row in names], device=self.device)

    def target_measures(
        self,
        touched: torch.Tensor | None = None,
        objects: torch.Tensor | None = None,
        basket: torch.Tensor | None = None,
    ) -> dict[str, torch.Tensor]:
        """As of `TransferEnv`, and ``others_out``: no other object of the target's name is in the basket."""
        objects = self.object_states if objects is None else objects
        basket = self.basket_pose if basket is None else basket
        inside = self.in_basket(objects[..., :7], self._centers_of_mass, basket)
        others_in = terms.another_of_its_kind(inside, self._kinds, self.target_slot)
        return {**super().target_measures(touched, objects, basket), "others_out": ~others_in}
