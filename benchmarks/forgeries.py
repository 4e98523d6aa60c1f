"""Forged results for `tampering.py`: changes of a copy of a result, and the check that must find each."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from robocas_ms3.evaluation.protocols.bundled_protocols import bundled_protocols
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.results.outcomes import Checkpoints
from robocas_ms3.evaluation.results.result_files import OUTCOMES, RUN, read_result
from robocas_ms3.evaluation.results.stored_episodes import (
    find_actions_file,
    find_checkpoints_file,
    hash_actions,
    write_actions,
    write_checkpoints,
)
from robocas_ms3.evaluation.rollouts.rollout import count_checkpoint_steps

EXPERT, NOOP, PAPER, WELDED = "expert", "noop", "paper", "welded"  # results that are changed
PICK, OTHER_PICK, SEARCH = 0, 1, 5  # episodes of smoke; the first two are episodes of pick in paper-v1 too
_SCENE = ("episode", "seed", "config", "task", "split", "p_vis")  # values that the protocol fixes
_STAGES = (
    *("furniture_opened", "reached_any", "obstacles_cleared", "reached_target", "target_grasped", "picked_any"),
    *("target_lifted", "target_in_basket", "success_v0", "success"),
)
_EXTRA_STEPS = 50  # more than the protocol allows


class ResultCopy:
    """Copy of a result, whose files are changed.

    Args:
        source: folder of the result.
        folder: folder of the copy, which is replaced.
        failed: folder of a result whose policy fails in `PICK`.
    """

    def __init__(self, source: Path, folder: Path, failed: Path) -> None:
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(source, folder)
        self.folder, self.failed = folder, failed

    def read_lines(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in (self.folder / OUTCOMES).read_text().splitlines()]

    def write_lines(self, lines: list[dict[str, Any]]) -> None:
        (self.folder / OUTCOMES).write_text("".join(json.dumps(line) + "\n" for line in lines))

    def read_outcome(self, episode: int) -> dict[str, Any]:
        return next(line for line in self.read_lines() if line["episode"] == episode)

    def change(self, episode: int, **values: Any) -> None:
        self.write_lines([line | (values if line["episode"] == episode else {}) for line in self.read_lines()])

    def change_measures(self, episode: int, **values: float) -> None:
        self.change(episode, measures=self.read_outcome(episode)["measures"] | values)

    def read_run(self) -> dict[str, Any]:
        return json.loads((self.folder / RUN).read_text())

    def change_run(self, **values: Any) -> None:
        (self.folder / RUN).write_text(json.dumps(self.read_run() | values))

    def change_policy(self, spec: dict[str, Any], **values: Any) -> None:
        policy = self.read_run()["policy"]
        self.change_run(policy=policy | values | {"spec": policy["spec"] | spec})

    def read_actions(self, episode: int) -> np.ndarray:
        return read_result(self.folder).read_actions(episode).copy()

    def read_checkpoints(self, episode: int) -> Checkpoints:
        return read_result(self.folder).read_checkpoints(episode)

    def store_actions(self, episode: int, actions: np.ndarray) -> None:
        actions = np.asarray(actions, np.float32)
        write_actions(self.folder, episode, actions)
        self.change(episode, actions_hash=hash_actions(actions))

    def store_checkpoints(self, episode: int, steps: np.ndarray, states: np.ndarray) -> None:
        checkpoints = Checkpoints(np.asarray(steps, np.int32), np.asarray(states, np.float32))
        write_checkpoints(self.folder, episode, checkpoints)

    def change_length(self, episode: int, steps: int) -> None:
        """Cut actions and checkpoints of an episode after a number of steps, or repeat the last ones up to it."""
        before, found, actions = self.read_outcome(episode), self.read_checkpoints(episode), self.read_actions(episode)
        period = int(found.steps[0])
        self.store_actions(episode, actions[np.minimum(np.arange(steps), before["steps"] - 1)])
        ends = np.append(np.arange(period, steps, period), steps)
        rows = np.minimum(np.searchsorted(found.steps, ends), len(found.steps) - 1)
        self.store_checkpoints(episode, ends, found.states[rows])
        self.change(episode, steps=steps, seconds=round(before["seconds"] / before["steps"] * steps, 4))


class MeasuredEpisode(NamedTuple):
    """Everything that a result has of an episode."""

    outcome: dict[str, Any]
    actions: np.ndarray
    checkpoints: Checkpoints

    @classmethod
    def read(cls, copy: ResultCopy, episode: int) -> MeasuredEpisode:
        return cls(copy.read_outcome(episode), copy.read_actions(episode), copy.read_checkpoints(episode))

    def write(self, copy: ResultCopy, episode: int, scene: Collection[str] = _SCENE) -> None:
        """Replace an episode of a result by this one, except its values ``scene``."""
        copy.change(episode, **{name: value for name, value in self.outcome.items() if name not in scene})
        write_actions(copy.folder, episode, self.actions)
        write_checkpoints(copy.folder, episode, self.checkpoints)


@dataclass(frozen=True)
class Forgery:
    """Change of a result.

    Attributes:
        source: result that is changed.
        found_by: check that must find the change.
        change: changes a copy of the result.
        is_consistent: whether the changed values contradict neither each other nor the stored files, so that only the
            protocol, the installed packages or a replay can contradict them.
    """

    source: str
    found_by: str
    change: Callable[[ResultCopy], None]
    is_consistent: bool = True


def claim_success(copy: ResultCopy, episode: int = PICK) -> None:
    """Claim that a failed episode succeeded after its last step, with all stages, times, measures and moved objects."""
    outcome = copy.read_outcome(episode)
    steps, needed = outcome["steps"], (outcome["retrieval"] or {}).get("needed", [])
    stages = [name for name in _STAGES if name in outcome["flags"]]
    flags = outcome["flags"] | {name: steps * place // len(stages) for place, name in enumerate(stages, 1)}
    times = {name: step and round(step / steps * outcome["seconds"], 4) for name, step in flags.items()}
    changes = {"success": True, "success_at_end": True, "success_v0": True, "failure_stage": ""}
    if outcome["retrieval"]:
        step = flags["obstacles_cleared"]
        moved = [{"object": name, "step": step, "needed": True, "in_order": True} for name in needed]
        changes["retrieval"] = outcome["retrieval"] | {"moved": moved, "left": 0, "score": 1.0}
    copy.change(episode, flags=flags, flag_seconds=times, **changes)
    measures = {"path_length": 1.5, "contact_impulse": 300.0, "disturbed_most": float(len(needed))}
    copy.change_measures(episode, **measures)


def claim_success_alone(copy: ResultCopy) -> None:
    copy.change(PICK, success=True)


def claim_only_the_last_stage(copy: ResultCopy) -> None:
    outcome = copy.read_outcome(PICK)
    copy.change(PICK, success=True, failure_stage="", flags=outcome["flags"] | {"success": outcome["steps"]})


def claim_all_successes(copy: ResultCopy) -> None:
    for line in copy.read_lines():
        claim_success(copy, line["episode"])


def claim_all_successes_with_old_orders(copy: ResultCopy) -> None:
    for line in copy.read_lines():
        claim_success(copy, line["episode"])
        copy.change(line["episode"], retrieval=line["retrieval"])


def claim_an_earlier_success(copy: ResultCopy) -> None:
    """Cut a successful episode before its end, and move its success to the new end."""
    before = copy.read_outcome(PICK)
    steps = before["steps"] - 5
    copy.change_length(PICK, steps)
    seconds = copy.read_outcome(PICK)["seconds"]
    flags = {name: None if step is None else min(step, steps) for name, step in before["flags"].items()}
    times = {name: None if time is None else min(time, seconds) for name, time in before["flag_seconds"].items()}
    copy.change(PICK, flags=flags, flag_seconds=times)


def claim_an_earlier_stage(copy: ResultCopy) -> None:
    outcome = copy.read_outcome(PICK)
    times = outcome["flag_seconds"] | {"reached_any": round(outcome["seconds"] / outcome["steps"], 4)}
    copy.change(PICK, flags=outcome["flags"] | {"reached_any": 1}, flag_seconds=times)


def halve_a_measure(name: str) -> Callable[[ResultCopy], None]:
    def forge(copy: ResultCopy) -> None:
        for line in copy.read_lines():
            copy.change_measures(line["episode"], **{name: line["measures"][name] / 2})

    return forge


def claim_a_perfect_order(copy: ResultCopy) -> None:
    """Claim that only needed objects were moved, from the top down."""
    order = copy.read_outcome(SEARCH)["retrieval"]
    moved = [move for move in order["moved"] if move["needed"] and move["in_order"]]
    copy.change(SEARCH, retrieval=order | {"moved": moved, "score": 1.0})
    copy.change_measures(SEARCH, disturbed_most=float(len(moved)), fallen=0.0)


def exchange_episodes(copy: ResultCopy) -> None:
    """Exchange everything that was measured in two episodes of the same task."""
    first, second = MeasuredEpisode.read(copy, PICK), MeasuredEpisode.read(copy, OTHER_PICK)
    first.write(copy, OTHER_PICK)
    second.write(copy, PICK)


def duplicate_an_episode(copy: ResultCopy) -> None:
    MeasuredEpisode.read(copy, PICK).write(copy, OTHER_PICK)


def use_an_episode_of_another_seed(copy: ResultCopy) -> None:
    MeasuredEpisode.read(copy, OTHER_PICK).write(copy, PICK, scene=("episode",))


def add_an_episode(copy: ResultCopy) -> None:
    """Add an episode that the protocol does not have."""
    measured, lines = MeasuredEpisode.read(copy, PICK), copy.read_lines()
    copy.write_lines([*lines, lines[0] | {"episode": len(lines)}])
    measured.write(copy, len(lines))


def leave_out_an_episode(copy: ResultCopy) -> None:
    copy.write_lines([line for line in copy.read_lines() if line["episode"] != PICK])
    find_actions_file(copy.folder, PICK).unlink()
    find_checkpoints_file(copy.folder, PICK).unlink()


def repeat_an_episode(copy: ResultCopy) -> None:
    lines = copy.read_lines()
    copy.write_lines([*lines, lines[0]])


def add_a_second_outcome(copy: ResultCopy) -> None:
    line = copy.read_outcome(PICK)
    claim_success(copy)
    copy.write_lines([*copy.read_lines(), line])


def use_another_protocol(copy: ResultCopy) -> None:
    """Claim episodes of paper-v1 as those of paper-words-v1, with its hash, seeds and configurations."""
    protocol = load_protocol(bundled_protocols()["paper-words-v1"])
    for line in copy.read_lines():
        scene = vars(protocol.episodes[line["episode"]])
        copy.change(**{name: scene[name] for name in _SCENE})
    copy.change_run(protocol=protocol.rules.name, protocol_hash=protocol.hash)


def use_actions_of_noop(copy: ResultCopy) -> None:
    """Keep the outcome, and replace the actions by those of a policy that fails."""
    actions = read_result(copy.failed).read_actions(PICK)
    copy.store_actions(PICK, actions[: copy.read_outcome(PICK)["steps"]])


def scale_actions(copy: ResultCopy) -> None:
    copy.store_actions(PICK, copy.read_actions(PICK) * 0.9)


def shift_one_action(copy: ResultCopy) -> None:
    actions = copy.read_actions(PICK)
    actions[len(actions) // 2, :3] += 0.02
    copy.store_actions(PICK, actions)


def change_actions_without_hash(copy: ResultCopy) -> None:
    write_actions(copy.folder, PICK, copy.read_actions(PICK) * np.float32(0.9))


def store_a_nan(copy: ResultCopy) -> None:
    actions = copy.read_actions(PICK)
    actions[3, 0] = np.nan
    copy.store_actions(PICK, actions)


def delete_actions(copy: ResultCopy) -> None:
    find_actions_file(copy.folder, PICK).unlink()


def omit_the_hash(copy: ResultCopy) -> None:
    copy.change(PICK, actions_hash="")


def move_an_object_in_the_states(copy: ResultCopy) -> None:
    steps, states = copy.read_checkpoints(PICK)
    states = states.copy()
    states[-1, 0] += 0.1
    copy.store_checkpoints(PICK, steps, states)


def leave_out_states(copy: ResultCopy) -> None:
    steps, states = copy.read_checkpoints(PICK)
    copy.store_checkpoints(PICK, steps[1:], states[1:])


def delete_states(copy: ResultCopy) -> None:
    shutil.rmtree(copy.folder / "checkpoints")


def claim_a_late_success(copy: ResultCopy) -> None:
    """Let a failed episode go on longer than the protocol allows, and succeed then."""
    copy.change_length(PICK, copy.read_outcome(PICK)["steps"] + _EXTRA_STEPS)
    claim_success(copy)


def change_the_rate(factor: float) -> Callable[[ResultCopy], None]:
    """Return a change of the rate, with all times, and with interpolated states at the checkpoints of the rate."""

    def forge(copy: ResultCopy) -> None:
        rate = copy.read_run()["policy"]["spec"]["rate_hz"] * factor
        period = count_checkpoint_steps(1 / rate)
        for line in copy.read_lines():
            number, steps, found = line["episode"], line["steps"], copy.read_checkpoints(line["episode"])
            times = {name: time and round(time / factor, 4) for name, time in line["flag_seconds"].items()}
            copy.change(number, seconds=round(line["seconds"] / factor, 4), flag_seconds=times)
            ends = np.append(np.arange(period, steps, period), steps)
            states = np.stack([np.interp(ends, found.steps, column) for column in found.states.T], axis=1)
            copy.store_checkpoints(number, ends, states)
        copy.change_policy({"rate_hz": rate})

    return forge


def double_the_rate_alone(copy: ResultCopy) -> None:
    copy.change_policy({"rate_hz": copy.read_run()["policy"]["spec"]["rate_hz"] * 2})


def add_an_error(copy: ResultCopy) -> None:
    copy.change(PICK, error="the worker crashed")


def claim_welds(copy: ResultCopy) -> None:
    for line in copy.read_lines():
        copy.change_measures(line["episode"], welds=1.0)
    copy.change_run(weld=True)


def conceal_welds(copy: ResultCopy) -> None:
    for line in copy.read_lines():
        measures = {name: value for name, value in line["measures"].items() if name != "welds"}
        copy.change(line["episode"], measures=measures)
    copy.change_run(weld=False)


def claim_gpu_physics(copy: ResultCopy) -> None:
    delete_states(copy)  # as on a GPU
    copy.change_run(backend="gpu")


def increment_version(text: str) -> str:
    """Return a version with the next minor number: 2.13.0+cpu -> 2.14.0+cpu."""
    major, minor, rest = text.split(".", 2)
    return f"{major}.{int(minor) + 1}.{rest}"


def change_version(package: str) -> Callable[[ResultCopy], None]:
    def forge(copy: ResultCopy) -> None:
        versions = copy.read_run()["versions"]
        copy.change_run(versions=versions | {package: increment_version(versions[package])})

    return forge


def claim_another_policy(copy: ResultCopy) -> None:
    """Claim that a policy without privileged state chose the actions."""
    spec = {"simulation_state": False, "track": "end-to-end", "cameras": {"base_camera": [128, 96]}, "language": "text"}
    copy.change_policy(spec, **{"name": "mine", "class": "mine:Policy", "parameters": 10**6})


def _change_run(**values: Any) -> Callable[[ResultCopy], None]:
    return lambda copy: copy.change_run(**values)


FORGERIES: dict[str, Forgery] = {
    "success alone": Forgery(NOOP, "verify", claim_success_alone, False),
    "success without the stages before it": Forgery(NOOP, "verify", claim_only_the_last_stage, False),
    "success with all stages": Forgery(NOOP, "audit", claim_success),
    "success in all episodes": Forgery(NOOP, "audit", claim_all_successes),
    "success in all episodes, old retrieval orders": Forgery(
        NOOP, "verify", claim_all_successes_with_old_orders, False
    ),
    "earlier success, with cut actions and states": Forgery(EXPERT, "audit", claim_an_earlier_success),
    "earlier stage": Forgery(EXPERT, "audit", claim_an_earlier_stage),
    "shorter paths": Forgery(EXPERT, "audit", halve_a_measure("path_length")),
    "smaller contact impulses": Forgery(EXPERT, "audit", halve_a_measure("contact_impulse")),
    "perfect retrieval order": Forgery(EXPERT, "audit", claim_a_perfect_order),
    "exchanged episodes": Forgery(EXPERT, "audit", exchange_episodes),
    "duplicated episode": Forgery(EXPERT, "audit", duplicate_an_episode),
    "episode of another seed": Forgery(EXPERT, "verify", use_an_episode_of_another_seed),
    "additional episode": Forgery(EXPERT, "verify", add_an_episode),
    "missing episode": Forgery(EXPERT, "verify", leave_out_an_episode),
    "second outcome of an episode": Forgery(NOOP, "read", add_a_second_outcome, False),
    "repeated line of an episode": Forgery(EXPERT, "none", repeat_an_episode, False),
    "actions of another policy": Forgery(EXPERT, "audit", use_actions_of_noop),
    "scaled actions": Forgery(EXPERT, "audit", scale_actions),
    "one shifted action": Forgery(EXPERT, "audit", shift_one_action),
    "changed actions, old hash": Forgery(EXPERT, "verify", change_actions_without_hash, False),
    "NaN in the actions": Forgery(EXPERT, "verify", store_a_nan, False),
    "deleted actions": Forgery(EXPERT, "verify", delete_actions, False),
    "no hash of the actions": Forgery(EXPERT, "verify", omit_the_hash, False),
    "changed state": Forgery(EXPERT, "audit", move_an_object_in_the_states),
    "missing state": Forgery(EXPERT, "audit", leave_out_states),
    "deleted states": Forgery(EXPERT, "none", delete_states, False),
    "more steps than allowed": Forgery(NOOP, "verify", claim_a_late_success),
    "half the rate, with all times": Forgery(EXPERT, "audit", change_the_rate(0.5)),
    "twice the rate, with all times": Forgery(EXPERT, "audit", change_the_rate(2)),
    "twice the rate, old times": Forgery(EXPERT, "verify", double_the_rate_alone, False),
    "motions from another pose": Forgery(EXPERT, "audit", lambda copy: copy.change_policy({"reference": "target"})),
    "error in a successful episode": Forgery(EXPERT, "read", add_an_error, False),
    "another protocol, with its seeds": Forgery(PAPER, "audit", use_another_protocol),
    "another hash of the protocol": Forgery(EXPERT, "verify", _change_run(protocol_hash="ef" * 32), False),
    "another object pack": Forgery(EXPERT, "verify", _change_run(pack_hashes={"builtin": "ef" * 32}), False),
    "weld where the protocol has none": Forgery(EXPERT, "verify", claim_welds),
    "claimed weld": Forgery(PAPER, "audit", claim_welds),
    "concealed weld": Forgery(WELDED, "audit", conceal_welds),
    "weld alone": Forgery(PAPER, "verify", _change_run(weld=True), False),
    "action noise": Forgery(EXPERT, "audit", _change_run(action_noise=[5.0, 2.0])),
    "another version of sapien": Forgery(EXPERT, "audit", change_version("sapien")),
    "another version of torch": Forgery(EXPERT, "audit", change_version("torch")),
    "no versions": Forgery(EXPERT, "audit", _change_run(versions={}), False),
    "GPU physics": Forgery(EXPERT, "audit", claim_gpu_physics),
    "another policy": Forgery(EXPERT, "none", claim_another_policy),
}
"""Forgeries by name."""
