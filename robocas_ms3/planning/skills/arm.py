"""Context of the skills, `Arm`: environment, planner, motion executor and decisions; basic motions."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

import numpy as np

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.planning.decisions import FIRST_FEASIBLE, MAX_CONTINUED_CANDIDATES, Decisions, SearchLimits
from robocas_ms3.planning.executor import CLOSED, OPEN, MotionExecutor
from robocas_ms3.planning.kinematics import InverseKinematics
from robocas_ms3.planning.protocol import Array, Planner, Trajectory
from robocas_ms3.planning.scene import PlanningScene
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.scenes.grasp_checks import Approach
from robocas_ms3.scenes.language.templates import make_subgoal
from robocas_ms3.tasks.base import RoboCASEnv

T = TypeVar("T")
Plan = TypeVar("Plan")
GRIPPER_SECONDS = 0.5  # s; in a dataset at 5 Hz the command may start 0.2 s later
# m to furniture and basket, if such a path exists, against position errors: on straight lines, while carrying
CLEARANCE, CARRY_CLEARANCE = 0.012, 0.024
RISE, MAX_RISES = 0.04, 4  # m per step, number of steps
RECOVERY_RISE = 0.10  # m
RETREAT_DISTANCES = (0.25, 0.15, 0.10, 0.06)  # m against the approach axis; the first free one is used
MAX_TOP_APPROACH_Z = -0.7  # z component of the approach axis below which a grasp counts as from above


@dataclass(frozen=True)
class PlannedPrimitive:
    """Motion primitive of a skill whose motions have been planned.

    Attributes:
        primitive: ``grasp``, ``push``, ``lift`` (lift and place elsewhere), ``release`` or ``pull``.
        slot: slot of the object; -1 for a pull.
        start_in_base: (4x4) TCP pose of the grasp or of the release, or at the start of the push.
        end_in_base: (4x4) TCP pose at the end of the push or pull, or at the placement; None for grasp and release.
    """

    primitive: str
    slot: int
    start_in_base: Array
    end_in_base: Array | None = None


def _ignore(*_: object) -> None:
    pass


@dataclass
class Arm:
    """Context of one attempt: the arm with its planner, motion executor and decisions.

    Poses are in the arm's base frame.

    Attributes:
        planner: motion planner.
        inverse_kinematics: inverse kinematics of the arm for batches of poses.
        executor: motion executor, which steps the environment.
        decisions: search that runs the candidates of `choose`.
        decision_path: number of the attempt, followed by the index of the chosen candidate of each decision.
        on_decision: function that is called before a decision, with its kind (``move``, ``grasp``, ``release`` or
            ``pull``) and each candidate with a function that runs it. It must not change the scene.
        on_choice: function that is called with the index of the chosen candidate of the last decision.
        planned: primitive of the last skill.
        search_limits: limits of all decisions; None: each skill has its own.
        scene: poses and obstacles of the environment.
        rng: random generator, seeded from ``decision_path``, so that results do not depend on rejected candidates.
        qpos: (7,) last commanded configuration, rad; initially the actual configuration.
    """

    planner: Planner
    inverse_kinematics: InverseKinematics
    executor: MotionExecutor
    decisions: Decisions
    decision_path: tuple[int, ...] = (0,)
    on_decision: Callable[[str, Sequence[tuple[object, Callable[[], object]]]], None] = _ignore
    on_choice: Callable[[int], None] = _ignore
    planned: PlannedPrimitive | None = None
    search_limits: SearchLimits | None = None
    rng: np.random.Generator = field(init=False)
    qpos: Array = field(init=False)

    def __post_init__(self) -> None:
        self.scene = PlanningScene(self.env)
        self.qpos = self.scene.arm_qpos
        self.clear_attached()
        self.follow_path(self.decision_path)
        with self.planning_time():  # fill the caches before the first fork
            self.scene.sample_surfaces()
            for clearance in (CARRY_CLEARANCE, CLEARANCE, 0.0):
                self.planner.set_scene(self.scene.obstacles(clearance=clearance))

    def follow_path(self, decision_path: tuple[int, ...]) -> None:
        """Set the decision path, and seed the random generators from it."""
        self.decision_path = decision_path
        entropy = np.random.SeedSequence([self.executor.seed, *decision_path])
        self.planner.seed(int(entropy.generate_state(1)[0]))
        self.rng = np.random.default_rng(entropy)

    def choose(
        self,
        candidates: Iterable[T],
        run_candidate: Callable[[T], float],
        limits: SearchLimits = FIRST_FEASIBLE,
        *,
        kind: str = "",
    ) -> T:
        """Choose a candidate with `Decisions.choose`; each candidate has its own random seed.

        If ``kind`` is given, ``on_decision`` and ``on_choice`` are called before and after.
        """
        decision_path, limits = self.decision_path, self.search_limits or limits

        def run_numbered(numbered: tuple[int, T]) -> float:
            index, candidate = numbered
            self.follow_path((*decision_path, index))
            return run_candidate(candidate)

        if not kind:
            return self.decisions.choose(enumerate(candidates), run_numbered, limits)[1]
        numbered = list(enumerate(candidates))
        self.on_decision(kind, [(one[1], partial(run_numbered, one)) for one in numbered])
        index, chosen = self.decisions.choose(numbered, run_numbered, limits)
        self.on_choice(index)
        return chosen

    def run_first_candidate(self, kind: str, run: Callable[[], T], *others: Callable[[], object]) -> T:
        """Call ``run``, the first candidate of a decision of a kind; ``others`` are not called."""
        self.on_decision(kind, [(None, one) for one in (run, *others)])
        result = run()
        self.on_choice(0)
        return result

    def add_backtracking_point(self) -> None:
        """Make a decision whose candidates differ only in their random seed.

        After a later failure, the search returns to this state.
        """
        self.choose(range(MAX_CONTINUED_CANDIDATES), lambda _: 0.0)

    @property
    def env(self) -> RoboCASEnv:
        """Environment with ``num_envs`` = 1."""
        return self.executor.base_env

    @property
    def robot(self) -> RobotDescription:
        return self.env.agent.description

    @property
    def target(self) -> int:
        """Slot of the target object."""
        return int(self.env.target_slot[0])

    @property
    def approach(self) -> Approach:
        return self.env.task_config.target.approach

    def start_subgoal(self, goal_type: str) -> None:
        """Start a sub-goal of a type, e.g. ``transfer object``, with the text for the target of the episode."""
        words = self.env.target_asset().asset.name, self.env.task_config.support
        self.executor.start_subgoal(**make_subgoal(goal_type, *words))

    def planning_time(self):
        """Return a context manager that counts the CPU time of its block as planning."""
        return self.executor.seconds.measure("planning")

    def follow(self, *motions: Trajectory, until: str | None = None) -> bool:
        """Execute motions one after the other until the flag ``until`` of ``info`` is set.

        Returns whether the flag is set after the last step, or True without ``until``.
        """
        reached = True
        for motion in motions:
            reached = self.executor.follow(motion, until=until)
            self.qpos = motion.qpos[-1]
        return reached

    def open_gripper(self) -> None:
        self.executor.move_gripper(OPEN, self.qpos, seconds=GRIPPER_SECONDS)

    def close_gripper(self) -> None:
        self.executor.move_gripper(CLOSED, self.qpos, seconds=GRIPPER_SECONDS)

    def clear_attached(self) -> None:
        """Detach the held object in the planner, and plan with open fingers."""
        self.planner.attach(None)
        self.planner.finger_width = self.robot.open_width

    def is_holding(self, slot: int) -> bool:
        """Return whether both fingers press on the object in a slot."""
        return bool(self.env.is_object_grasped()[0, slot])

    def plan_first_line(
        self, start: Array, goals: Iterable[Array], *, stage: str, check_collisions: bool = True
    ) -> Trajectory:
        """Plan a straight line of the TCP to the first feasible pose (4x4) of ``goals``.

        Raises:
            PlanningError: no pose is feasible; the error of the last pose, or reason ``no_goals``.
        """
        return plan_first_feasible(
            goals,
            lambda goal: self.planner.plan_straight(start, goal, stage=stage, check_collisions=check_collisions),
            PlanningError(stage, "no_goals"),
        )

    def plan_home(self, start: Array) -> Trajectory:
        return self.planner.plan_to_qpos(start, [np.array(self.robot.arm_rest)], stage="home")

    def rise_until_free(self, *, exclude: int | Collection[int] = ()) -> None:
        """Rise in steps of ``RISE`` until the arm and the held object are collision-free.

        Args:
            exclude: slot of the held object, which is no obstacle.

        Raises:
            PlanningError: reason ``in_contact`` after ``MAX_RISES`` steps, or a reason of the planner.
        """
        for rises in range(MAX_RISES + 1):
            with self.planning_time():
                self.planner.set_scene(self.scene.obstacles(exclude=exclude))
                if not self.planner.find_collisions(self.qpos, self.planner.finger_width):
                    return
                if rises == MAX_RISES:
                    raise PlanningError("rise", "in_contact")
                motion = self.plan_rise(self.planner.tcp(self.qpos), RISE, stage="rise")
            self.follow(motion)

    def plan_rise(self, tcp_in_base: Array, height: float, *, stage: str) -> Trajectory:
        """Plan a straight line up by ``height`` m, or up and towards the robot if straight up is out of reach.

        Obstacles are ignored. ``tcp_in_base`` (4x4) is the present pose of the TCP.
        """
        up = shift_up(tcp_in_base, height)
        inward = up.copy()
        inward[:2, 3] *= 1 - height / np.linalg.norm(up[:2, 3])
        return self.plan_first_line(self.qpos, [up, inward], stage=stage, check_collisions=False)


def plan_first_feasible(candidates: Iterable[T], plan: Callable[[T], Plan], failure: PlanningError) -> Plan:
    """Return ``plan(candidate)`` of the first candidate for which planning succeeds.

    Raises:
        PlanningError: planning fails for all candidates; the error of the last one, or ``failure`` without candidates.
    """
    for candidate in candidates:
        try:
            return plan(candidate)
        except PlanningError as error:
            failure = error
    raise failure


def shift_up(tcp_in_base: Array, height: float) -> Array:
    """Return poses (..., 4, 4) shifted up by ``height`` m."""
    result = tcp_in_base.copy()
    result[..., 2, 3] += height
    return result


def shift_back(tcp_in_base: Array, distance: float) -> Array:
    """Return TCP poses (..., 4, 4) shifted by ``distance`` m against their approach axis."""
    result = tcp_in_base.copy()
    result[..., :3, 3] -= distance * tcp_in_base[..., :3, 2]
    return result


def plan_retreat(arm: Arm, start: Array, goals: list[Array]) -> Trajectory:
    """Plan a straight line to the first feasible TCP pose (4x4) of ``goals``, through obstacles.

    The line starts at the configuration ``start`` (7,).

    Only self-collisions are checked, since the gripper touches an object at the start.
    """
    return arm.plan_first_line(start, goals, stage="retreat", check_collisions=False)


def plan_free_retreat(arm: Arm, goals: list[Array]) -> Trajectory:
    """Plan a straight collision-free line to the first feasible TCP pose (4x4) of ``goals``.

    If all lines collide, the target is no obstacle.
    """
    try:
        return arm.plan_first_line(arm.qpos, goals, stage="retreat")
    except PlanningError:
        arm.planner.set_scene(arm.scene.obstacles(exclude=arm.target))
        return arm.plan_first_line(arm.qpos, goals, stage="retreat")


def recover(arm: Arm) -> None:
    """Open the gripper and retreat after a failed attempt that stays in the recording.

    After an approach from above the arm rises, and obstacles are ignored. After a horizontal approach, as into a shelf
    or to a handle, the arm moves straight back on a line that may touch only the target.

    Raises:
        PlanningError: no retreat is possible.
    """
    arm.clear_attached()
    arm.open_gripper()
    with arm.planning_time():
        tcp = arm.planner.tcp(arm.qpos)
        arm.planner.set_scene(arm.scene.obstacles())
        if arm.approach == "top" and tcp[2, 2] < MAX_TOP_APPROACH_Z:
            motion = arm.plan_rise(arm.scene.tcp_in_base, RECOVERY_RISE, stage="recover")
        else:
            motion = plan_free_retreat(arm, [shift_back(tcp, distance) for distance in RETREAT_DISTANCES])
    arm.follow(motion)
