"""What the benchmark's tasks have in common: the target has to end up in the basket. Stages, success, instruction."""

from __future__ import annotations

from typing import Any, ClassVar, cast

import numpy as np
import sapien
import torch
from mani_skill.utils.structs import Articulation, Pose

from robocas_ms3.assets.manifest import BODY
from robocas_ms3.config.relations import Relation
from robocas_ms3.language.instructions import Instruction, choose_instruction, part_name
from robocas_ms3.tasks import terms
from robocas_ms3.tasks.base import RoboCASEnv
from robocas_ms3.tasks.bodies import link_poses
from robocas_ms3.tasks.remembered import Remembered

_LANGUAGE = 100  # stream of an episode's seed; those of layouts are in scenes/sample.py
STAGES = ("reached_any", "picked_any", "reached_target", "target_grasped", "target_lifted", "target_in_basket")


class TransferEnv(RoboCASEnv):
    """Move the target to the basket.

    ``evaluate()`` gives (N,) bools. The stages are sticky over an episode: ``reached_any`` (the gripper touched any
    object), ``picked_any`` (both fingers held any object >= 3 cm above where it stood), ``reached_target``,
    ``target_grasped``, ``target_lifted`` (as ``picked_any``, of the target), ``target_in_basket``. ``success`` is not:
    the target was lifted, now lies in the basket's inner volume at rest, untouched by the gripper, and the basket
    stands (moved <= 0.1 m, tilted <= 20 deg). ``disturbed`` (N,) int counts the objects other than the target that are
    more than 3 cm from where they stood, or have fallen over (30 deg), relative to the door or drawer they are on.
    """

    STAGES: ClassVar[tuple[str, ...]] = STAGES

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        if not hasattr(self, "_reached"):
            self._reached = torch.zeros(len(self.STAGES), self.num_envs, dtype=torch.bool, device=self.device)
            self._stages = dict(zip(self.STAGES, self._reached, strict=True))  # views
        self._reached[:, env_idx] = False
        # most of the time nothing moves; what is remembered holds for an episode, as where it began counts too
        self._measured, self._undo = Remembered(self._measure), Remembered(self._undo_of)
        self._count_disturbed = Remembered(self._disturbed_of)
        said = {env: self._instruct(env) for env in env_idx.tolist()}
        kept = getattr(self, "instructions", [])
        self.instructions = [said[env] if env in said else kept[env] for env in range(self.num_envs)]

    def _instruct(self, env: int) -> Instruction:
        config, layout = self.task_config, self.layouts[env]
        assert layout is not None  # the reset gave it one
        name = self.target_asset(env).asset.name
        names = {asset.asset.name for asset, used in zip(self.object_assets[env], layout.present, strict=True) if used}
        return choose_instruction(
            np.random.default_rng([int(self._layout_seeds[env]), _LANGUAGE]),
            config.task,
            config.language.split,
            object=name,
            support=config.support,
            relation=cast("Relation | None", layout.relation or None),
            part=config.opening.part or part_name(config.opening.handle) if config.opening else "",
            others=sorted(names - {name}),
            synonyms=config.language.synonyms,
        )

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Stages and success of each env, (N,) bool each; ``disturbed`` (N,) int."""
        # right after a reset the engine still tells the contacts of before
        forces = self.gripper_forces() * (self.elapsed_steps > 0)[:, None, None, None]
        grasped, objects = self.grasped(forces), self.object_states
        self.target_held = terms.of_target(grasped, self.target_slot)
        now, holds = self._measured(forces, grasped, objects, self.basket_pose)
        now = {**now, **self.task_stages()}
        self._reached |= torch.stack([now.get(stage, reached) for stage, reached in self._stages.items()])
        stages = dict(zip(self.STAGES, self._reached.clone(), strict=True))
        success = self._stages["target_lifted"] & holds
        return {**stages, "success": success, "disturbed": self._disturbed(objects[..., :7])}

    def _measure(
        self, forces: torch.Tensor, grasped: torch.Tensor, objects: torch.Tensor, basket: torch.Tensor
    ) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """The stages all tasks share, as of this moment, and whether all of `target_measures` hold: (N,) bool each."""
        touched = terms.touched(forces)
        lifted = terms.lifted(objects[..., 2], self.start_poses[..., 2], grasped)
        measures = self.target_measures(touched, objects, basket)
        now = {
            "reached_any": touched.any(dim=1),
            "picked_any": lifted.any(dim=1),
            "reached_target": terms.of_target(touched, self.target_slot),
            "target_grasped": terms.of_target(grasped, self.target_slot),
            "target_lifted": terms.of_target(lifted, self.target_slot),
            "target_in_basket": measures["in_basket"],
        }
        return now, torch.stack(list(measures.values())).all(dim=0)

    def compute_sparse_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """(N,) float32: 1 where the task has succeeded at this moment, else 0."""
        return info["success"].float()

    def task_stages(self) -> dict[str, torch.Tensor]:
        """What a task adds to the stages: (N,) bool each, of this moment; ``target_held`` (N,) is known then."""
        return {}

    def target_measures(
        self,
        touched: torch.Tensor | None = None,
        objects: torch.Tensor | None = None,
        basket: torch.Tensor | None = None,
    ) -> dict[str, torch.Tensor]:
        """What has to hold at the same moment for success, besides the target having been lifted: (N,) bool each.

        Args:
            touched: (N, K) bool, which objects the gripper touches, if that is known already.
            objects: (N, K, 13) their states, likewise.
            basket: (N, 7) its pose, likewise.
        """
        touched = terms.touched(self.gripper_forces()) if touched is None else touched
        objects = self.object_states if objects is None else objects
        basket = self.basket_pose if basket is None else basket
        start, slot = self.basket_at_start, self.target_slot
        target, center = terms.of_target(objects, slot), terms.of_target(self._centers_of_mass, slot)
        return {
            "in_basket": self.in_basket(target[:, :7], center, basket),
            "untouched": ~terms.of_target(touched, slot),
            "at_rest": terms.at_rest(target[:, 7:10], target[:, 10:]),
            "basket_stands": terms.stands(basket[:, :3], basket[:, 3:], start[:, :3], start[:, 3:]),
        }

    def in_basket(self, poses: torch.Tensor, centers_of_mass: torch.Tensor, basket: torch.Tensor) -> torch.Tensor:
        """(N,) or (N, K) bool: whose centre of mass is in the basket's inner volume.

        Args:
            poses: (N, 7) or (N, K, 7) of objects in the world.
            centers_of_mass: (N, 3) or (N, K, 3) in their frames.
            basket: (N, 7) pose in the world.
        """
        centers = poses[..., :3] + terms.rotate(poses[..., 3:], centers_of_mass)
        return terms.inside_box(centers, basket[:, :3], basket[:, 3:], self._basket_low, self._basket_high)

    def _disturbed(self, poses: torch.Tensor) -> torch.Tensor:
        """(N,) how many objects other than the target no longer stand as they stood, from poses (N, K, 7)."""
        support = self.fixtures.furniture[self.task_config.surface.furniture]
        if isinstance(support, Articulation) and self.model.support_link:
            links = [support.links_map[name] for name in (BODY, self.model.support_link)]
            return self._count_disturbed(poses, self._undo(link_poses(self.scene, links))).clone()
        return self._count_disturbed(poses).clone()

    def _disturbed_of(self, poses: torch.Tensor, undo: torch.Tensor | None = None) -> torch.Tensor:
        moved = terms.disturbed(poses, self.start_poses, undo) & self.present
        slots = torch.arange(moved.shape[1], device=self.device)
        return (moved & (slots != self.target_slot[:, None])).sum(dim=1)

    def _undo_of(self, links: torch.Tensor) -> torch.Tensor:
        """(N, 7) motion that brings the part that objects stand on back, from the poses of body and part (N, 2, 7)."""
        before = Pose.create(sapien.Pose(self.model.support_motion(opened=False)), device=self.device)
        return (Pose.create(links[:, 0]) * before * Pose.create(links[:, 1]).inv()).raw_pose

    def get_language_instruction(self) -> list[str]:
        """The instruction of each env."""
        return [said.text for said in self.instructions]
