"""Simulate the candidates of each decision of an episode, each in a forked process, and store their outcomes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
from mani_skill.utils.common import to_numpy

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.core.poses import to_wxyz
from robocas_ms3.demos.branches import ForkedProcessError, run_in_forked_process
from robocas_ms3.demos.candidates.candidates_file import write_candidates
from robocas_ms3.demos.candidates.measure import DISTURBED, SceneMeasures, measure_scene
from robocas_ms3.demos.candidates.proposals import Candidate, propose
from robocas_ms3.demos.candidates.records import DecisionRecord, PathDecision, mark_episode
from robocas_ms3.demos.candidates.schema import DecisionKind, Primitive
from robocas_ms3.demos.failures import EpisodeResult
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.planning.decisions import IrreversibleDecisions
from robocas_ms3.planning.protocol import Array
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.heap import Heap, Move
from robocas_ms3.tasks.occlusion import MAX_HIDDEN_FRACTION, MAX_OBSTACLES
from robocas_ms3.tasks.search import RoboCASSearchEnv

SETTLE_SECONDS = 0.25  # s after a candidate, until its objects are nearly at rest
MIN_PUSH = 0.02  # m, least displacement of an object by a successful push
MAX_DECISIONS = 30  # decisions that are recorded per seed, so that hard seeds do not dominate a dataset
_STREAM = 412  # random stream of the proposals


@dataclass(frozen=True)
class CandidateSettings:
    """Settings of the candidates of each decision.

    Attributes:
        count: number of candidates per decision.
        random_fraction: minimum fraction of random candidates.
        near_miss_fraction: fraction of random candidates with a position error.
        depth: maximum number of further moves that are simulated after a candidate of search, until the target can be
            grasped.
    """

    count: int
    random_fraction: float
    near_miss_fraction: float
    depth: int

    @classmethod
    def from_episode_settings(cls, settings: EpisodeSettings) -> CandidateSettings:
        """Return the settings of the candidates from the settings of an episode."""
        fractions = settings.random_fraction, settings.near_miss_fraction
        return cls(settings.candidates, *fractions, settings.candidate_depth)


@dataclass
class CandidateRecorder:
    """Recorder of the decisions of a seed with the outcomes of their candidates.

    Decisions of undone attempts are recorded too, up to `MAX_DECISIONS` per seed.

    Attributes:
        settings: settings of the candidates.
        env: environment without a recorder, in which candidates are simulated.
        path: path of the file of the episode.
        result: result of the seed, with the decisions of all attempts. Forked processes exchange it.
    """

    settings: CandidateSettings
    env: gym.Env
    path: Path
    result: EpisodeResult
    _decisions: list[PathDecision] = field(default_factory=list)

    def observe(self, arm: Arm) -> None:
        """Record the decisions of an attempt from now on."""
        self._decisions = []

        def on_decision(kind: str, candidates: Sequence[tuple[Any, Callable[[], object]]]) -> None:
            self._record(arm, cast("DecisionKind", kind), candidates)

        arm.on_decision, arm.on_choice = on_decision, self._mark_chosen

    def write(self, env_info: Mapping[str, Any]) -> None:
        """Write the file of a successful episode.

        ``env_info`` is the value of this key in the JSON file of the trajectory.
        """
        mark_episode(self.result.decisions, self._decisions)
        write_candidates(self.path, self.result.decisions, env_info, asdict(self.settings))

    def _mark_chosen(self, index: int) -> None:
        decision = self._decisions[-1]
        if decision.number is not None:
            candidates = self.result.decisions[decision.number].candidates
            if index < len(candidates) and candidates[index]["source"] == "expert":
                decision.chosen = index

    def _record(self, arm: Arm, kind: DecisionKind, options: Sequence[tuple[Any, Callable[[], object]]]) -> None:
        number = len(self.result.decisions)
        if number >= MAX_DECISIONS:
            self._decisions.append(PathDecision(kind, None))
            return
        self._decisions.append(PathDecision(kind, number))
        before = measure_scene(arm)
        record = DecisionRecord(self._describe(arm, kind, before), _read_state(arm))
        settings = self.settings
        own = settings.count - round(settings.random_fraction * settings.count)
        candidates = [_make_expert_candidate(arm, kind, value, run) for value, run in options[: max(1, own)]]
        rng = np.random.default_rng([arm.executor.seed, *arm.decision_path, len(self._decisions), _STREAM])
        candidates += propose(arm, kind, settings.count - len(candidates), rng, settings.near_miss_fraction)
        for candidate in candidates:
            try:
                outcome = run_in_forked_process(lambda one=candidate: self._simulate(arm, one, before))
            except ForkedProcessError as error:
                outcome = _make_outcome(candidate, before, before, PlanningError("branch", str(error)))
            record.candidates.append(outcome)
        self.result.decisions.append(record)

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
            "held_slot": before.held_slot,
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
        planned = arm.planned
        if planned is not None and planned.primitive == candidate.primitive:
            candidate = replace(candidate, start_in_base=planned.start_in_base, end_in_base=planned.end_in_base)
        else:
            failure = failure or PlanningError("decision", "no_candidate")
        after = measure_scene(arm, before) if steps else before
        outcome = _make_outcome(candidate, before, after, failure)
        outcome["feasible"] = planned is not None and planned.primitive == candidate.primitive
        outcome["seconds"] = steps * executor.dt
        outcome["moves_to_grasp"] = self._count_moves(arm, after) if steps else -1
        return outcome

    def _count_moves(self, arm: Arm, after: SceneMeasures) -> int:
        """Return the number of moves, up to ``settings.depth``, until the target can be grasped; -1 if unknown."""
        if after.held_slot == arm.target:
            return 0
        for number in range(self.settings.depth + 1):
            if _can_be_grasped(arm.target, after):
                return number
            if number == self.settings.depth or not isinstance(arm.env, RoboCASSearchEnv):
                break
            try:
                heap = Heap(arm, arm.target)
                arm.choose(heap.candidate_moves(), heap.execute)
            except PlanningError:
                break
            after = measure_scene(arm, after)
        return -1


def _can_be_grasped(target: int, measures: SceneMeasures) -> bool:
    cleared = measures.hidden_fraction[target] <= MAX_HIDDEN_FRACTION and measures.obstacles[target] <= MAX_OBSTACLES
    return bool(cleared and measures.free_grasps[target] > 0)


def _make_expert_candidate(arm: Arm, kind: DecisionKind, value: Any, run: Callable[[], object]) -> Candidate:
    if isinstance(value, Move):
        return Candidate("expert", value.skill, value.slot, run)
    primitive = cast("Primitive", kind)  # every other kind of decision has one primitive
    return Candidate("expert", primitive, -1 if primitive == "pull" else arm.target, run)


def _make_outcome(
    candidate: Candidate, before: SceneMeasures, after: SceneMeasures, failure: PlanningError | None
) -> dict[str, Any]:
    displacement = np.linalg.norm(after.object_in_base[:, :3] - before.object_in_base[:, :3], axis=1)
    others = np.arange(len(displacement)) != candidate.slot
    if failure is None and candidate.primitive == "push" and displacement[candidate.slot] <= MIN_PUSH:
        failure = PlanningError("push", "not_moved")
    if failure is None and (after.fallen & ~before.fallen).any():
        failure = PlanningError("clear", "fell_off_table")
    return {
        "primitive": candidate.primitive,
        "source": candidate.source,
        "slot": candidate.slot,
        "start_in_base": _to_pose(candidate.start_in_base),
        "end_in_base": _to_pose(candidate.end_in_base),
        "chosen": False,
        "feasible": False,
        "failure": "" if failure is None else str(failure),
        "success": failure is None,
        "held": candidate.slot >= 0 and after.held_slot == candidate.slot,
        "seconds": 0.0,
        "object_after_in_base": after.object_in_base,
        "displacement": displacement,
        "fallen": after.fallen,
        "disturbed": int((displacement[others] > DISTURBED).sum()),
        "in_basket": after.in_basket,
        "opening": after.opening,
        "hidden_fraction": after.hidden_fraction,
        "obstacles": after.obstacles,
        "free_grasps": after.free_grasps,
        "moves_to_grasp": -1,
    }


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
