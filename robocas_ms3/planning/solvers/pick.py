"""Scripted policy of pick: choose a grasp, approach, close, lift, carry above the basket, let go, step back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from robocas_ms3.errors import PlanningFailed
from robocas_ms3.language.templates import subgoal
from robocas_ms3.planning.drops import overhangs, sample_drops
from robocas_ms3.planning.executor import CLOSED, OPEN, Executor
from robocas_ms3.planning.protocol import Array, AttachedBody, Planner, Trajectory
from robocas_ms3.planning.reachability import Reachability
from robocas_ms3.planning.scene import PlanningScene, inverse
from robocas_ms3.robots.constants import ARM_REST
from robocas_ms3.scenes.grasping import MAX_WIDTH, filter_grasps, rank_grasps
from robocas_ms3.scenes.placement import transform
from robocas_ms3.tasks.base import RoboCASEnv


@dataclass(frozen=True)
class PickSettings:
    """Numbers of the policy; metres and seconds. Distances are upstream's."""

    pregrasp_distance: float = 0.10
    lift_height: float = 0.10
    retreat_height: float = 0.05
    close_seconds: float = 0.45
    open_seconds: float = 0.30
    grasps_planned: int = 12
    drops_sampled: int = 192
    drops_planned: int = 10


@dataclass(frozen=True)
class GraspPlan:
    """Motions from where the arm is to a lifted grasp."""

    reach: Trajectory
    approach: Trajectory
    lift: Trajectory


class PickSolver:
    """Picks the target of one environment.

    Args:
        env: the environment under its wrappers, control mode ``pd_joint_pos``, one env.
        planner: motion planner in the arm's base frame.
        reachability: batched inverse kinematics of the same arm.
        settings: numbers of the policy.
    """

    def __init__(
        self, env: RoboCASEnv, planner: Planner, reachability: Reachability, settings: PickSettings | None = None
    ) -> None:
        self.env, self.planner, self.reachability = env, planner, reachability
        self.settings = settings or PickSettings()

    def attempt(self, executor: Executor, rng: np.random.Generator) -> None:
        """Try once, from wherever the episode stands; returns when the task has succeeded.

        Raises:
            PlanningFailed: with the stage that could not be done.
        """
        scene = PlanningScene(self.env)
        slot = int(self.env.target_slot[0])
        words = self.env.target_asset().asset.name, self.env.task_config.support
        self._let_go()
        executor.label(**subgoal("move and grasp", *words))
        end = self._grasp(executor, scene, slot, rng)
        executor.label(**subgoal("transfer object", *words))
        end = self._carry(executor, scene, slot, end, rng)
        self._release(executor, scene, slot, end)

    def recover(self, executor: Executor) -> None:
        """After a failed attempt that stays in the record: open the gripper and back out of whatever is there."""
        scene = PlanningScene(self.env)
        self._let_go()
        qpos = scene.arm_qpos
        executor.move_gripper(OPEN, qpos, seconds=self.settings.open_seconds)
        with executor.seconds.spent_on("planning"):
            self.planner.set_scene(scene.obstacles_in_base())
            goal = raised(scene.tcp_in_base, 0.10)
            back = self.planner.plan_straight(qpos, goal, stage="recover", check_collisions=False)
        executor.follow(back)

    # ------------------------------------------------------------------ grasp

    def _grasp(self, executor: Executor, scene: PlanningScene, slot: int, rng: np.random.Generator) -> Array:
        with executor.seconds.spent_on("planning"):
            plan = self._plan_grasp(scene, slot, rng)
        executor.follow(plan.reach)
        executor.follow(plan.approach)
        executor.move_gripper(CLOSED, plan.approach.qpos[-1], seconds=self.settings.close_seconds)
        if not self._holds(slot):
            raise PlanningFailed("grasp", "missed")
        executor.follow(plan.lift)
        if not self._holds(slot):
            raise PlanningFailed("lift", "slipped")
        return plan.lift.qpos[-1]

    def _plan_grasp(self, scene: PlanningScene, slot: int, rng: np.random.Generator) -> GraspPlan:
        start = scene.arm_qpos
        everything, others = scene.obstacles_in_base(), scene.obstacles_in_base(without=slot)
        failure = PlanningFailed("grasp_sampling", "no_feasible_grasp")
        for tcp_in_base in self._grasp_candidates(scene, slot, others, start, rng):
            try:
                # in and out of the target's surroundings, where the target itself is no obstacle ...
                self.planner.set_scene(others)
                entries = self._entries(start, tcp_in_base)
                # ... and there with the target as one
                self.planner.set_scene(everything)
                reach = self.planner.plan_to_qpos(start, [entry[0] for entry in entries], stage="reach")
            except PlanningFailed as error:
                failure = error
                continue
            chosen = min(entries, key=lambda entry: float(np.abs(entry[0] - reach.qpos[-1]).max()))
            return GraspPlan(reach, chosen[1], chosen[2])
        raise failure

    def _grasp_candidates(
        self, scene: PlanningScene, slot: int, others: Array, start: Array, rng: np.random.Generator
    ) -> Iterator[Array]:
        notes = self.env.object_assets[0][slot].annotations
        base, object_in_base = scene.arm_base_in_world, scene.object_in_base(slot)
        kept = filter_grasps(
            base @ object_in_base @ notes.grasps_tcp_in_object,
            notes.grasp_widths,
            arm_base_in_world=base,
            object_center_in_world=(base @ object_in_base)[:3, 3],
            scene_points_in_world=transform(base, others),
            qualities=1.1 - notes.grasp_qualities,  # upstream's scale: more is better
        )
        tcp_in_base = inverse(base) @ kept.tcp_in_world
        if not len(tcp_in_base):
            raise PlanningFailed("grasp_sampling", "all_filtered")
        pregrasp = tcp_in_base.copy()
        pregrasp[:, :3, 3] -= self.settings.pregrasp_distance * pregrasp[:, :3, 2]
        solved, qpos = self.reachability.reachable(tcp_in_base, start)
        solved_before, _ = self.reachability.reachable(pregrasp, start)
        reachable = solved & solved_before
        if not reachable.any():
            raise PlanningFailed("grasp_sampling", "unreachable")
        center = object_in_base[:3, 3]
        order = rank_grasps(
            tcp_in_base[reachable],
            kept.qualities[reachable],
            object_center=center,
            qpos=qpos[reachable],
            near=start,
            rng=rng,
        )
        for index in order[: self.settings.grasps_planned]:
            yield tcp_in_base[reachable][index]

    def _entries(self, near: Array, tcp_in_base: Array) -> list[tuple[Array, Trajectory, Trajectory]]:
        """Pre-grasp configurations from which straight approach and lift are free, nearest first."""
        pregrasp = tcp_in_base.copy()
        pregrasp[:3, 3] -= self.settings.pregrasp_distance * pregrasp[:3, 2]
        failure = PlanningFailed("approach", "no_ik")
        entries = []
        for qpos in self.planner.ik(pregrasp, near)[:4]:
            try:
                approach = self.planner.plan_straight(qpos, tcp_in_base, stage="approach")
                lift = self._first_line(approach.qpos[-1], self._ways_up(tcp_in_base), stage="lift")
            except PlanningFailed as error:
                failure = error
                continue
            entries.append((qpos, approach, lift))
        if not entries:
            raise failure
        return entries

    def _ways_up(self, tcp_in_base: Array) -> list[Array]:
        """Where to lift to: straight up, or between that and back the way the gripper came in."""
        up, back = np.array([0, 0, 1.0]), -tcp_in_base[:3, 2]
        goals = []
        for share in (0.0, 0.5, 1.0):
            direction = (1 - share) * up + share * back
            if direction[2] > 0.2:
                goals.append(tcp_in_base.copy())
                goals[-1][:3, 3] += self.settings.lift_height / direction[2] * direction
        return goals

    def _first_line(self, start: Array, goals: list[Array], *, stage: str, check_collisions: bool = True) -> Trajectory:
        """Plan a straight line to the first of several poses that one leads to."""
        failure = PlanningFailed(stage, "no_goal")
        for goal in goals:
            try:
                return self.planner.plan_straight(start, goal, stage=stage, check_collisions=check_collisions)
            except PlanningFailed as error:
                failure = error
        raise failure

    # ------------------------------------------------------------------ carry and release

    def _carry(
        self, executor: Executor, scene: PlanningScene, slot: int, start: Array, rng: np.random.Generator
    ) -> Array:
        with executor.seconds.spent_on("planning"):
            trajectory = self._plan_carry(scene, slot, start, rng)
        executor.follow(trajectory)
        if not self._holds(slot):
            raise PlanningFailed("transfer", "dropped")
        return trajectory.qpos[-1]

    def _plan_carry(self, scene: PlanningScene, slot: int, start: Array, rng: np.random.Generator) -> Trajectory:
        asset = self.env.object_assets[0][slot]
        object_in_tcp = inverse(scene.tcp_in_base) @ scene.object_in_base(slot)
        vertices = np.concatenate(asset.hulls)
        vertices_in_tcp = transform(object_in_tcp, vertices)
        inner = self.env.furniture_pack.furniture[self.env.task_config.basket.asset].asset.inner
        assert inner is not None  # the environment saw to it
        drops = sample_drops(
            rng,
            count=self.settings.drops_sampled,
            container_in_base=scene.basket_in_base,
            inner_low=np.array(inner.min),
            inner_high=np.array(inner.max),
            vertices_in_tcp=vertices_in_tcp,
            center_in_tcp=transform(object_in_tcp, np.array([asset.asset.center_of_mass]))[0],
        )
        solved, qpos = self.reachability.reachable(drops, start)
        if not solved.any():
            raise PlanningFailed("transfer", "unreachable")
        drops, qpos = drops[solved], qpos[solved]
        # first those in which the object fits through the opening, then those that are near
        overhang = overhangs(drops, scene.basket_in_base, np.array(inner.min), np.array(inner.max), vertices_in_tcp)
        order = np.lexsort((np.abs(qpos - start).max(axis=1), np.ceil(overhang / 0.02)))
        self.planner.set_scene(scene.obstacles_in_base(without=slot))
        self.planner.attach(AttachedBody(vertices, object_in_tcp))
        self.planner.finger_width = float(self.env.agent.gripper_width[0])
        failure = PlanningFailed("transfer", "no_plan")
        for index in order[: self.settings.drops_planned]:
            try:
                carry = self.planner.plan_to_pose(start, drops[index], stage="transfer")
                self._plan_retreat(carry.qpos[-1], drops[index])  # no way up from there: no place to let go
                return carry
            except PlanningFailed as error:
                failure = error
        raise failure

    def _plan_retreat(self, start: Array, tcp_in_base: Array) -> Trajectory:
        height = self.settings.retreat_height
        back = tcp_in_base.copy()
        back[:3, 3] -= height * tcp_in_base[:3, 2]
        goals = [raised(tcp_in_base, height), back, raised(back, height / 2), raised(tcp_in_base, height / 2)]
        return self._first_line(start, goals, stage="retreat", check_collisions=False)

    def _release(self, executor: Executor, scene: PlanningScene, slot: int, end: Array) -> None:
        executor.move_gripper(OPEN, end, seconds=self.settings.open_seconds)
        with executor.seconds.spent_on("planning"):
            self._let_go()
            self.planner.set_scene(scene.obstacles_in_base(without=slot))
            retreat = self._plan_retreat(end, self.planner.tcp(end))
            home = self.planner.plan_to_qpos(retreat.qpos[-1], [np.array(ARM_REST)], stage="home")
        executor.follow(retreat)
        # The object settles while the arm goes home; the demonstration ends as soon as it lies still.
        if not executor.follow(home, until="success"):
            raise PlanningFailed("release", self._why_not(executor))

    def _let_go(self) -> None:
        self.planner.attach(None)
        self.planner.finger_width = MAX_WIDTH

    def _holds(self, slot: int) -> bool:
        return bool(self.env.grasped()[0, slot])

    def _why_not(self, executor: Executor) -> str:
        measures = self.env.target_measures()
        for reason in ("in_basket", "untouched", "at_rest", "basket_stands"):
            if not bool(measures[reason][0]):
                return f"not_{reason}"
        return "unstable"


def raised(tcp_in_base: Array, height: float) -> Array:
    """A pose moved straight up by ``height`` metres (the arm's base stands upright)."""
    result = tcp_in_base.copy()
    result[2, 3] += height
    return result
