"""RoboCASPick-v1: grasp the named object among scattered ones and drop it into the basket."""

from __future__ import annotations

import torch
from mani_skill.utils.registration import register_env

from robocas_ms3.language.templates import pick_instruction
from robocas_ms3.tasks import terms
from robocas_ms3.tasks.base import RoboCASEnv
from robocas_ms3.tasks.spec import PICK

STAGES = ("reached_any", "picked_any", "reached_target", "target_grasped", "target_lifted", "target_in_basket")


@register_env(PICK.env_id, max_episode_steps=PICK.max_episode_steps)
class RoboCASPickEnv(RoboCASEnv):
    """Pick: the instruction names one of the objects on the support; it has to end up in the basket.

    ``evaluate()`` gives (N,) bools. The stages are sticky over an episode: ``reached_any`` (the gripper touched any
    object), ``picked_any`` (both fingers held any object >= 3 cm above where it stood), ``reached_target``,
    ``target_grasped``, ``target_lifted`` (as ``picked_any``, of the target), ``target_in_basket``. ``success`` is not:
    the target was lifted, now lies in the basket's inner volume at rest, untouched by the gripper, and the basket
    stands (moved <= 0.1 m, tilted <= 20 deg).
    """

    SPEC = PICK

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        if not hasattr(self, "_stages") or len(self._stages["reached_any"]) != self.num_envs:
            self._stages = {s: torch.zeros(self.num_envs, dtype=torch.bool, device=self.device) for s in STAGES}
        for flags in self._stages.values():
            flags[env_idx] = False

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Stages and success of each env, (N,) bool each."""
        forces = self.gripper_forces()
        grasped = self.grasped(forces)
        touched = terms.touched(forces)
        lifted = terms.lifted(self.object_poses[..., 2], self._rest_height, grasped)
        measures = self.target_measures(touched)
        now = {
            "reached_any": touched.any(dim=1),
            "picked_any": lifted.any(dim=1),
            "reached_target": terms.of_target(touched, self.target_slot),
            "target_grasped": terms.of_target(grasped, self.target_slot),
            "target_lifted": terms.of_target(lifted, self.target_slot),
            "target_in_basket": measures["in_basket"],
        }
        for stage, flags in now.items():
            self._stages[stage] |= flags
        success = self._stages["target_lifted"] & torch.stack(list(measures.values())).all(dim=0)
        return {**{stage: flags.clone() for stage, flags in self._stages.items()}, "success": success}

    def target_measures(self, touched: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """What has to hold at the same moment for success, besides the target having been lifted: (N,) bool each.

        Args:
            touched: (N, K) bool, which objects the gripper touches, if that is known already.
        """
        if touched is None:
            touched = terms.touched(self.gripper_forces())
        basket, start, slot = self.fixtures.basket.pose, self.basket_at_start, self.target_slot
        pose = terms.of_target(self.object_poses, slot)
        center = pose[:, :3] + terms.rotate(pose[:, 3:], terms.of_target(self._centers_of_mass, slot))
        linear = torch.stack([actor.linear_velocity for actor in self.objects], dim=1)
        angular = torch.stack([actor.angular_velocity for actor in self.objects], dim=1)
        return {
            "in_basket": terms.inside_box(center, basket.p, basket.q, self._basket_low, self._basket_high),
            "untouched": ~terms.of_target(touched, slot),
            "at_rest": terms.at_rest(terms.of_target(linear, slot), terms.of_target(angular, slot)),
            "basket_stands": terms.stands(basket.p, basket.q, start.p, start.q),
        }

    def get_language_instruction(self) -> list[str]:
        """The instruction of each env."""
        names = [self.target_asset(env).asset.name for env in range(self.num_envs)]
        return [pick_instruction(name, self.task_config.support) for name in names]
