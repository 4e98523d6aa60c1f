"""Simulate the candidates of each decision of an episode, each in a forked process, and store their outcomes."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
from mani_skill.utils.common import to_numpy

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.core.poses import to_wxyz
from robocas_ms3.demos.candidates.candidates_file import write_candidates
from robocas_ms3.demos.candidates.measure import DISTURBED, SceneMeasures, measure_scene
from robocas_ms3.demos.candidates.proposals import Candidate, propose
from robocas_ms3.demos.candidates.records import DecisionRecord, PathDecision, mark_episode
from robocas_ms3.demos.candidates.schema import DecisionKind, Primitive
from robocas_ms3.demos.failures import EpisodeResult
from robocas_ms3.demos.forked_processes import ForkedProcessError, run_in_forked_process
from robocas_ms3.demos.settings import CANDIDATE_OPTIONS, EpisodeSettings
from robocas_ms3.planning.decisions import IrreversibleDecisions
from robocas_ms3.planning.protocol import Array
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.heap import Heap, Move, find_fallen_objects
from robocas_ms3.tasks.occlusion import MAX_HIDDEN_FRACTION, MAX_OBSTACLES
from robocas_ms3.tasks.search import RoboCASSearchEnv

SETTLE_SECONDS = 0.25  # s after a candidate, until its objects are nearly at rest
SETTINGS = (*CANDIDATE_OPTIONS, "planner", "action_noise", "after_policy", "after_steps")
"""Names of the settings in `EpisodeSettings` on which candidates and their outcomes depend."""
MIN_PUSH = 0.02  # m, least displacement of an object by a successful push
MAX_DECISIONS = 30  # decisions that are recorded per seed, so that hard seeds do not dominate a dataset
_STREAM = 415  # random stream of the proposals
_log = logging.getLogger(__name__)


@dataclass
class CandidateRecorder:
    """Recorder of the decisions of a seed with the outcomes of their candidates.

    Decisions of undone attempts are recorded too, up to `MAX_DECISIONS` per seed.

    Attributes:
        settings: settings of the episode, with those of the candidates.
        env: environment without a recorder, in which candidates are simulated.
        path: path of the file of the episode.
        result: result of the seed, with the decisions of all attempts. Forked processes exchange it.
    """

    settings: EpisodeSettings
    env: gym.Env
    path: Path
    result: EpisodeResult
    _decisions: list[PathDecision] = field(default_factory=list)

    def observe(self, arm: Arm) -> None:
        """Record the decisions of an attempt from now on."""
        self._decisions = []

        def on_decision(kind: str, candidates: Sequence[tuple[Any, Callable[[], object]]]) -> None:
            start = sum(os.times()[:4])  # with forked processes
            self._record(arm, cast("DecisionKind", kind), candidates)
            arm.executor.seconds.candidates += sum(os.times()[:4]) - start

        arm.on_decision, arm.on_choice = on_decision, self._mark_chosen

    def write(self, env_info: Mapping[str, Any]) -> None:
        """Write the decisions of the seed to its file.

        ``env_info`` is the value of this key in the JSON file of the trajectory.
        """
        if self.result.success:
            mark_episode(self.result.decisions, self._decisions)
        settings = {name: getattr(self.settings, name) for name in SETTINGS}
        write_candidates(self.path, self.result.decisions, env_info, settings)

    def _mark_chosen(self, option: int) -> None:
        self._decisions[-1].chosen = self._decisions[-1].options.get(option)

    def _record(self, arm: Arm, kind: DecisionKind, options: Sequence[tuple[Any, Callable[[], object]]]) -> None:
        number, settings = len(self.result.decisions), self.settings
        if number >= MAX_DECISIONS or kind not in settings.candidate_decisions:
            self._decisions.append(PathDecision(kind, None))
            return
        path = PathDecision(kind, number)
        self._decisions.append(path)
        before = measure_scene(arm)
        record = DecisionRecord(self._describe(arm, kind, before), _read_state(arm))
        own = max(1, settings.candidates - round(settings.random_fraction * settings.candidates))
        for option, (value, run) in enumerate(options[:own]):
            outcome = self._simulate_forked(arm, _make_expert_candidate(arm, kind, option, value, run), before)
            # a candidate that could not be planned has no parameters
            if outcome is not None and np.isfinite(outcome["start_in_base"]).all():
                path.options[option] = len(record.candidates)
                record.candidates.append(outcome)
        rng = np.random.default_rng([arm.executor.seed, *arm.decision_path, len(self._decisions), _STREAM])
        count = settings.candidates - len(record.candidates)
        for candidate in propose(arm, kind, count, rng, settings.near_miss_fraction):
            outcome = self._simulate_forked(arm, candidate, before)
            if outcome is not None:
                record.candidates.append(outcome)
        self.result.decisions.append(record)

    def _simulate_forked(self, arm: Arm, candidate: Candidate, before: SceneMeasures) -> dict[str, Any] | None:
        """Return the outcome of a candidate; None if its process crashed twice or exceeded its time limit."""
        try:
            return run_in_forked_process(lambda: self._simulate(arm, candidate, before))
        except ForkedProcessError as error:
            _log.warning("seed %d: a %s is left out: its process %s", self.result.seed, candidate.primitive, error)
            return None

    def _describe(self, arm: Arm, kind: DecisionKind, before: SceneMeasures) -> dict[str, Any]:
        env, scene = arm.env, arm.scene
        basket = np.full(7, np.nan) if env.model.basket is None else to_wxyz(scene.basket_in_base)
        assets = [asset.asset for asset in env.object_assets[0]]
        return {
            "seed": arm.executor.seed,
            "decision": len(self.result.decisions),
            "kind": kind,
            "attempt": len(self.result.failures),
            "in_episode": False,
            "moves_left": -1,
            "step": len(arm.executor.actions),
            "instruction": env.instruction().text,
            "target_slot": arm.target,
            "object_id": [asset.id for asset in assets],
            "object_name": [asset.name for asset in assets],
            "present": env.present[0].cpu().numpy(),
            "object_in_base": before.object_in_base,
            "basket_in_base": basket,
            "tcp_in_base": to_wxyz(scene.tcp_in_base),
            "qpos": scene.arm_qpos,
            "gripper_width": float(env.agent.gripper_width[0]),
            "held_slot": int(np.flatnonzero(before.held)[0]) if before.held.any() else -1,
            "fallen": before.fallen,
            "opening": before.opening,
            "hidden_fraction": before.hidden_fraction,
            "obstacles": before.obstacles,
            "free_grasps": before.free_grasps,
        }

    def _simulate(self, arm: Arm, candidate: Candidate, before: SceneMeasures) -> dict[str, Any]:
        """Run a candidate and return its outcome; this process cannot continue the episode."""
        executor = arm.executor
        executor.env, executor.check_open_loop = self.env, lambda: None
        arm.decisions = IrreversibleDecisions(lambda: len(executor.actions))
        arm.on_decision = arm.on_choice = lambda *_: None
        arm.planned, first, failure = None, len(executor.actions), None
        try:
            candidate.run()
        except PlanningError as error:
            failure = error
        steps = len(executor.actions) - first
        if steps:
            executor.move_gripper(executor.gripper, arm.qpos, seconds=SETTLE_SECONDS)
        after = measure_scene(arm, before) if steps else before
        planned = arm.planned
        if planned is not None and candidate.source == "expert":
            end = planned.end_in_base if candidate.primitive == "push" else None
            candidate = replace(candidate, start_in_base=planned.start_in_base, end_in_base=end)
        complete = planned is not None and planned.primitive == candidate.primitive
        return {
            **_make_outcome(candidate, before, after, failure),
            "feasible": planned is not None,
            "final_in_base": _to_pose(planned.end_in_base if planned is not None and complete else None),
            "seconds": steps * executor.dt,
            "moves_to_grasp": self._count_moves(arm, after) if steps and candidate.primitive != "release" else -1,
        }

    def _count_moves(self, arm: Arm, after: SceneMeasures) -> int:
        """Return the number of moves until the target can be grasped; -1 if it is unknown.

        At most ``settings.candidate_depth`` further moves are simulated.
        """
        if after.held[arm.target]:
            return 0
        for number in range(self.settings.candidate_depth + 1):
            if _can_be_grasped(arm.target, after):
                return number
            if number == self.settings.candidate_depth or not isinstance(arm.env, RoboCASSearchEnv):
                break
            try:
                heap = Heap(arm, arm.target, find_fallen_objects(arm) - {arm.target})
                arm.choose(heap.candidate_moves(), heap.execute)
            except PlanningError:
                break
            after = measure_scene(arm, after)
        return -1


def _can_be_grasped(target: int, measures: SceneMeasures) -> bool:
    cleared = measures.hidden_fraction[target] <= MAX_HIDDEN_FRACTION and measures.obstacles[target] <= MAX_OBSTACLES
    return bool(cleared and measures.free_grasps[target] > 0)


def _make_expert_candidate(
    arm: Arm, kind: DecisionKind, option: int, value: Any, run: Callable[[], object]
) -> Candidate:
    if isinstance(value, Move):
        return Candidate("expert", value.skill, value.slot, run, option=option)
    primitive = cast("Primitive", kind)  # every other kind of decision has one primitive
    return Candidate("expert", primitive, -1 if primitive == "pull" else arm.target, run, option=option)


def _make_outcome(
    candidate: Candidate, before: SceneMeasures, after: SceneMeasures, failure: PlanningError | None
) -> dict[str, Any]:
    displacement = np.linalg.norm(after.object_in_base[:, :3] - before.object_in_base[:, :3], axis=1)
    others = np.arange(len(displacement)) != candidate.slot
    failure = _find_failure(candidate, before, after, failure)
    return {
        "primitive": candidate.primitive,
        "source": candidate.source,
        "slot": candidate.slot,
        "start_in_base": _to_pose(candidate.start_in_base),
        "end_in_base": _to_pose(candidate.end_in_base),
        "chosen": False,
        "failure": "" if failure is None else str(failure),
        "success": failure is None,
        "held": candidate.slot >= 0 and bool(after.held[candidate.slot]),
        "object_after_in_base": after.object_in_base,
        "displacement": displacement,
        "fallen": after.fallen & ~before.fallen,
        "disturbed": int((displacement[others] > DISTURBED).sum()),
        "in_basket": after.in_basket,
        "opening": after.opening,
        "hidden_fraction": after.hidden_fraction,
        "obstacles": after.obstacles,
        "free_grasps": after.free_grasps,
    }


def _find_failure(
    candidate: Candidate, before: SceneMeasures, after: SceneMeasures, failure: PlanningError | None
) -> PlanningError | None:
    """Return the failure of a candidate by its measured outcome; None if it reached the goal of its primitive.

    ``failure`` is the error of the skill, which may be stricter: the same rule holds for all sources.
    """
    slot = candidate.slot
    if (after.fallen & ~before.fallen).any():
        return PlanningError("clear", "fell_off_table")
    if candidate.primitive == "grasp":
        return None if after.held[slot] else failure or PlanningError("grasp", "missed")
    if candidate.primitive == "push":
        moved = np.linalg.norm(after.object_in_base[slot, :3] - before.object_in_base[slot, :3]) > MIN_PUSH
        return None if moved else failure or PlanningError("push", "not_moved")
    if candidate.primitive == "lift" and failure is not None and failure.stage == "clear":
        return None  # it was placed, at the edge of the surface
    return failure


def _to_pose(pose: Array | None) -> Array:
    return np.full(7, np.nan) if pose is None else to_wxyz(pose)


def _read_state(arm: Arm) -> dict[str, dict[str, Any]]:
    """Return the state of the simulator without the targets of the controllers."""
    state: dict[str, Any] = arm.env.get_state_dict()
    return {
        kind: {name: to_numpy(value)[0].copy() for name, value in values.items()}
        for kind, values in state.items()
        if kind != "controller"
    }
