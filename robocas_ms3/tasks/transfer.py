"""What the tasks have in common: the target has to end up somewhere. Stages, success, instruction."""

from __future__ import annotations

from functools import reduce
from operator import and_
from typing import Any, ClassVar, cast

import numpy as np
import torch
from mani_skill.utils.structs import Articulation

from robocas_ms3.assets.manifest import BODY
from robocas_ms3.core.arrays import as_tensor, count_up, native, none
from robocas_ms3.scenes.config.relations import Relation
from robocas_ms3.scenes.language.instructions import Instruction, choose_instruction, part_name
from robocas_ms3.tasks import terms
from robocas_ms3.tasks.base import RoboCASEnv
from robocas_ms3.tasks.bodies import link_poses
from robocas_ms3.tasks.goals import Goal, InBasket, Moment

_LANGUAGE = 100  # stream of an episode's seed; those of layouts are in scenes/sample.py
STAGES = ("reached_any", "picked_any", "reached_target", "target_grasped", "target_lifted", "target_in_basket")


class TransferEnv(RoboCASEnv):
    """Move the target to the ``GOAL``, which is the basket unless a task says otherwise.

    ``evaluate()`` gives (N,) bools. The stages are sticky over an episode: ``reached_any`` (the gripper touched any
    object), ``picked_any`` (both fingers held any object >= 3 cm above where it stood), ``reached_target``,
    ``target_grasped``, ``target_lifted`` (as ``picked_any``, of the target), and of the goal, ``target_in_basket``.
    ``success`` is not: the target was lifted, now lies in the basket's inner volume at rest, untouched by the gripper,
    and the basket stands (moved <= 0.1 m, tilted <= 20 deg). Nor is ``fail``: the target lies or falls more than 5 cm
    below what it stood on, out of basket and gripper, or the basket has fallen (10 cm lower, or tilted by 60 deg).
    Other goals may do without the lift, and have measures of their own. ``disturbed`` (N,) int counts the objects other
    than the target that are more than 3 cm from where they stood, or have fallen over (30 deg), relative to the door or
    drawer they are on.
    """

    STAGES: ClassVar[tuple[str, ...]] = STAGES
    GOAL: ClassVar[type[Goal]] = InBasket
    goal: Goal

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        shut = self.model.support_motion(opened=False)
        self._support_shut = torch.as_tensor(shut, dtype=torch.float32, device=self.device)
        self._surface = float(self.model.support_pose[2, 3]) + self.model.region.z
        self.goal = self.GOAL(self)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        if not hasattr(self, "_reached"):
            self._reached = torch.zeros(len(self.STAGES), self.num_envs, dtype=torch.bool, device=self.device)
            self._stages = dict(zip(self.STAGES, self._reached, strict=True))  # views
        self._reached[:, env_idx] = False
        self._last: tuple[object, dict[str, torch.Tensor]] | None = None
        if not hasattr(self, "_said"):
            self._said: dict[int, Instruction] = {}
        for env in env_idx.tolist():
            self._said.pop(env, None)

    def instruction(self, env: int = 0, *, name: str = "") -> Instruction:
        """What is asked of an env's robot; with a name, what would be if that object were meant."""
        if name:
            return self._instruct(env, name)
        if env not in self._said:
            self._said[env] = self._instruct(env, self.target_asset(env).asset.name)
        return self._said[env]

    def names(self, env: int = 0) -> set[str]:
        """Names of the objects in an env."""
        present = self.layout(env).present
        return {asset.asset.name for asset, used in zip(self.object_assets[env], present, strict=True) if used}

    def _instruct(self, env: int, name: str) -> Instruction:
        config, layout = self.task_config, self.layout(env)
        return choose_instruction(
            np.random.default_rng([int(self._layout_seeds[env]), _LANGUAGE]),
            config.task,
            config.language.split,
            object=name,
            support=config.support,
            relation=cast("Relation | None", layout.relation or None),
            part=config.opening.part or part_name(config.opening.handle) if config.opening else "",
            others=sorted(self.names(env) - {name}),
            synonyms=config.language.synonyms,
        )

    def state_beside_bodies(self) -> dict:
        """See `RoboCASEnv`. ``task`` holds the ``stages`` reached so far, (N, stages) bool."""
        return {**super().state_beside_bodies(), "task": {"stages": self._reached.T.clone()}}

    def set_state_dict(self, state: dict, env_idx: torch.Tensor | None = None) -> None:
        """Set the state; see `RoboCASEnv`. Where it has no stages, they stay as they are."""
        super().set_state_dict(state, env_idx)
        if "stages" in state.get("task", {}):
            stages = torch.as_tensor(state["task"]["stages"], dtype=torch.bool, device=self.device)
            envs = slice(None) if env_idx is None else env_idx
            self._reached[:, envs] = stages.reshape(-1, len(self.STAGES)).T
        self._last = None

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Stages, success and fail of each env, (N,) bool each; ``disturbed`` (N,) int. Don't write to them."""
        state = self.bodies.read()
        forces = self._gripper_contacts.forces(self.bodies.others)
        found_by = self._known_by(forces)
        if self._last is not None and found_by is not None and self._last[0] == found_by:
            return dict(self._last[1])
        # right after a reset the engine still tells the contacts of before
        forces = forces * native(self.elapsed_steps > 0)[:, None, None, None]
        found = self._evaluated(forces, native(self._objects_in(state)), self._native_basket(state))
        self._last = self._known_by(forces), found
        return dict(found)

    def _known_by(self, forces: Any) -> object:
        """What decides the next evaluation on a CPU while nothing touches the gripper; None: not to be known."""
        others = self.bodies.others
        return None if others is None or forces.any() else (others, native(self._reached).tobytes())

    def _evaluated(self, forces: Any, objects: Any, basket: Any) -> dict[str, torch.Tensor]:
        """`evaluate` from forces (N, 3, K, 3), states (N, K, 13) and the basket's pose (N, 7) or None, all native."""
        slot = native(self.target_slot)
        grasped, touched = self._grasped_by(forces), terms.touched(forces)
        lifted = terms.lifted(objects[..., 2], native(self.start_poses)[..., 2], grasped)
        measures = self._target_measures(touched, objects, basket)
        held = terms.of_target(grasped, slot)
        now = {
            "reached_any": touched.any(1),
            "picked_any": lifted.any(1),
            "reached_target": terms.of_target(touched, slot),
            "target_grasped": held,
            "target_lifted": terms.of_target(lifted, slot),
            f"target_{self.goal.NAME}": measures[self.goal.NAME],
            **self._task_stages(objects, held),
        }
        reached = native(self._reached)
        for row, stage in enumerate(self.STAGES):
            if stage in now:
                reached[row] |= now[stage]
        success = reduce(and_, measures.values())
        if self.goal.LIFTS:
            success = native(self._stages["target_lifted"]) & success
        fail = self._has_failed(measures, objects, basket)
        stages = dict(zip(self.STAGES, self._reached.clone(), strict=True))
        disturbed, touched = self._disturbed(objects[..., :7]), now["reached_target"]
        self._moment = Moment(objects, basket, held, touched, measures[self.goal.NAME], disturbed, forces)
        flags = {"success": as_tensor(success), "fail": as_tensor(fail)}
        return {**stages, **flags, "disturbed": as_tensor(disturbed.sum(1))}

    @property
    def moment(self) -> Moment:
        """What `evaluate` found last; the same object as before where nothing has changed since."""
        return self._moment

    def _has_failed(self, measures: dict[str, Any], objects: Any, basket: Any) -> Any:
        """(N,) bool of ``fail``, native, from `_target_measures`, states (N, K, 13) and the basket's pose."""
        slot = native(self.target_slot)
        height = terms.of_target(objects[..., 2], slot)
        low, lost = height < self._surface - terms.FALLEN, self.goal.lost(basket, measures)
        if lost is None and none(low):  # as nearly always
            return low
        caught = self.goal.catches(terms.of_target(objects[..., :3], slot), basket)
        fell = terms.fell_off(height, self._surface, low & False if caught is None else caught, ~measures["untouched"])
        return fell if lost is None else fell | lost

    def compute_sparse_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """(N,) float32: 1 where the task has succeeded at this moment, else 0."""
        return info["success"].float()

    def task_stages(self) -> dict[str, torch.Tensor]:
        """What a task adds to the stages: (N,) bool each, of this moment."""
        held = terms.of_target(native(self.grasped()), native(self.target_slot))
        found = self._task_stages(native(self.object_states), held)
        return {name: as_tensor(stage) for name, stage in found.items()}

    def _task_stages(self, objects: Any, held: Any) -> dict[str, Any]:
        """`task_stages`, native (`arrays`), from states (N, K, 13) and whether the target is held (N,)."""
        return {}

    def target_measures(self) -> dict[str, torch.Tensor]:
        """What has to hold at the same moment for success, besides the target having been lifted: (N,) bool each."""
        touched = terms.touched(self._gripper_contacts.forces())
        basket = self._native_basket(self.bodies.read())
        found = self._target_measures(touched, native(self.object_states), basket)
        return {name: as_tensor(measure) for name, measure in found.items()}

    def _target_measures(self, touched: Any, objects: Any, basket: Any) -> dict[str, Any]:
        """`target_measures`, native (`arrays`).

        Args:
            touched: (N, K) bool, which objects the gripper touches.
            objects: (N, K, 13) their states.
            basket: (N, 7) its pose in the world; None where there is none.
        """
        slot = native(self.target_slot)
        target = terms.of_target(objects, slot)
        return {
            self.goal.NAME: self.goal.holds(self.target_center(objects), basket),
            "untouched": ~terms.of_target(touched, slot),
            "at_rest": terms.at_rest(target[:, 7:10], target[:, 10:]),
            **self.goal.measures(basket),
        }

    def fallen(self) -> Any:
        """(N, K) bool, native: which other objects lay 5 cm below what they stood on in `moment`, not at the goal.

        The target is carried there, and if it falls, that is ``fail``.
        """
        objects = self._moment.objects
        low = (objects[..., 2] < self._surface - terms.FALLEN) & native(self.present & ~self._is_target)
        if none(low):  # as nearly always
            return low
        return low & ~self.goal.holds(self.centers(objects), self._moment.basket)

    def _disturbed(self, poses: Any) -> Any:
        """(N, K) bool: which objects other than the target no longer stand as they stood, from poses (N, K, 7)."""
        support, undo = self.fixtures.furniture[self.task_config.surface.furniture], None
        if isinstance(support, Articulation) and self.model.support_link:
            links = [support.links_map[name] for name in (BODY, self.model.support_link)]
            body, part = native(link_poses(self.scene, links)).swapaxes(0, 1)
            undo = terms.way_back(body, part, native(self._support_shut))
        moved = terms.disturbed(poses, native(self.start_poses), undo) & native(self.present)
        slots = count_up(moved.shape[1], moved)
        return moved & (slots != native(self.target_slot)[:, None])

    def get_language_instruction(self) -> list[str]:
        """The instruction of each env."""
        return [self.instruction(env).text for env in range(self.num_envs)]
