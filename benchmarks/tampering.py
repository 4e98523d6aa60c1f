"""Change a result in many ways, and list which check finds each change; print JSON.

python benchmarks/tampering.py --work tampering > tampering.json

The script evaluates `scripted-ee-delta` and `noop` on the protocol smoke. Then it changes every value of run.json, of
an outcome of pick and of a retrieval order of search (``fields``). It also forges results consistently, with hashes and
related values (``forgeries``). Each changed copy goes through the checks of `robocas eval verify` and
`robocas eval audit`, which replays three episodes. The exit status is 1 if a forgery is not found by the check that is
expected for it.

JSON keys:
  found            number of changes by the check that finds them
  fields, forgeries
    change         changed value, or name of the forgery
    found_by       read: the file is refused; verify; audit; none: no check
    message        first message
"""

from __future__ import annotations

import json
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.text import one_line
from robocas_ms3.evaluation.audit.run import find_audit_obstacle, run_audit
from robocas_ms3.evaluation.policies import open_policy
from robocas_ms3.evaluation.results.outcomes import Checkpoints
from robocas_ms3.evaluation.results.result_files import OUTCOMES, RUN, load_protocol_of, read_result
from robocas_ms3.evaluation.results.stored_episodes import hash_actions, write_actions, write_checkpoints
from robocas_ms3.evaluation.results.verify import find_violations
from robocas_ms3.evaluation.rollouts.session import EvaluationSession
from robocas_ms3.evaluation.settings import EvaluationSettings

PROTOCOL = "smoke"
PICK, OTHER_PICK, SEARCH = 0, 1, 4  # episodes of smoke
REPLAYED = {PICK, OTHER_PICK, SEARCH}
Forgery = Callable[["ResultCopy"], None]


@dataclass
class Benchmark:
    work: Path
    """Folder of the results; those of an earlier run are used again."""
    fields: bool = True
    """Whether to change every single value too."""


class ResultCopy:
    """Copy of a result, whose files are changed."""

    def __init__(self, source: Path, folder: Path, other: Path) -> None:
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(source, folder)
        self.folder, self.other = folder, other

    def read_lines(self, folder: Path | None = None) -> list[dict[str, Any]]:
        return [json.loads(line) for line in ((folder or self.folder) / OUTCOMES).read_text().splitlines()]

    def write_lines(self, lines: list[dict[str, Any]]) -> None:
        (self.folder / OUTCOMES).write_text("".join(json.dumps(line) + "\n" for line in lines))

    def outcome(self, episode: int) -> dict[str, Any]:
        return next(line for line in self.read_lines() if line["episode"] == episode)

    def change(self, episode: int, **values: Any) -> None:
        lines = self.read_lines()
        self.write_lines([line | (values if line["episode"] == episode else {}) for line in lines])

    def change_run(self, **values: Any) -> None:
        path = self.folder / RUN
        path.write_text(json.dumps(json.loads(path.read_text()) | values))

    def actions(self, episode: int) -> np.ndarray:
        return read_result(self.folder).read_actions(episode).copy()

    def store_actions(self, episode: int, actions: np.ndarray) -> None:
        actions = np.asarray(actions, np.float32)
        write_actions(self.folder, episode, actions)
        self.change(episode, actions_hash=hash_actions(actions))

    def keep_steps(self, episode: int, steps: int) -> None:
        """Cut the actions and checkpoints of an episode after a number of steps."""
        result = read_result(self.folder)
        actions, found = result.read_actions(episode)[:steps], result.read_checkpoints(episode)
        self.store_actions(episode, actions)
        kept = found.steps <= steps
        ends = np.append(found.steps[kept], steps) if steps not in found.steps else found.steps[kept]
        states = found.states[np.searchsorted(found.steps, ends)]
        write_checkpoints(self.folder, episode, Checkpoints(ends.astype(np.int32), states))
        seconds = round(self.outcome(episode)["seconds"] * steps / self.outcome(episode)["steps"], 4)
        self.change(episode, steps=steps, seconds=seconds)


def claim_success(copy: ResultCopy, episode: int = PICK) -> None:
    """Claim that a failed episode succeeded after its last step, with all stages before it."""
    outcome = copy.outcome(episode)
    steps, seconds = outcome["steps"], outcome["seconds"]
    flags = {name: steps if name != "fail" else None for name in outcome["flags"]}
    times = {name: seconds if name != "fail" else None for name in outcome["flags"]}
    changes = {"success": True, "success_at_end": True, "success_v0": True, "failure_stage": ""}
    copy.change(episode, flags=flags, flag_seconds=times, **changes)


def claim_success_alone(copy: ResultCopy) -> None:
    copy.change(PICK, success=True)


def claim_only_the_last_stage(copy: ResultCopy) -> None:
    outcome = copy.outcome(PICK)
    copy.change(PICK, success=True, failure_stage="", flags=outcome["flags"] | {"success": outcome["steps"]})


def claim_all_successes(copy: ResultCopy) -> None:
    for line in copy.read_lines():
        claim_success(copy, line["episode"])


def claim_an_earlier_success(copy: ResultCopy) -> None:
    """Cut a successful episode before its end, and move its success to the new end."""
    before = copy.outcome(PICK)
    steps = before["steps"] - 5
    copy.keep_steps(PICK, steps)
    seconds = copy.outcome(PICK)["seconds"]
    flags = {name: None if step is None else min(step, steps) for name, step in before["flags"].items()}
    times = {name: None if time is None else min(time, seconds) for name, time in before["flag_seconds"].items()}
    copy.change(PICK, flags=flags, flag_seconds=times)


def change_measure(name: str, value: float) -> Forgery:
    def forge(copy: ResultCopy) -> None:
        copy.change(PICK, measures=copy.outcome(PICK)["measures"] | {name: value})

    return forge


def claim_an_earlier_stage(copy: ResultCopy) -> None:
    outcome = copy.outcome(PICK)
    times = outcome["flag_seconds"] | {"reached_any": round(outcome["seconds"] / outcome["steps"], 4)}
    copy.change(PICK, flags=outcome["flags"] | {"reached_any": 1}, flag_seconds=times)


def exchange_episodes(copy: ResultCopy) -> None:
    """Exchange everything that was measured in two episodes of the same task."""
    first, second = copy.outcome(PICK), copy.outcome(OTHER_PICK)
    own = ("episode", "seed", "config", "task", "split", "p_vis")
    result = read_result(copy.folder)
    stored = [(result.read_actions(number), result.read_checkpoints(number)) for number in (OTHER_PICK, PICK)]
    copy.change(PICK, **{name: value for name, value in second.items() if name not in own})
    copy.change(OTHER_PICK, **{name: value for name, value in first.items() if name not in own})
    for number, (actions, checkpoints) in zip((PICK, OTHER_PICK), stored, strict=True):
        write_actions(copy.folder, number, actions)
        write_checkpoints(copy.folder, number, checkpoints)


def repeat_an_episode(copy: ResultCopy) -> None:
    lines = copy.read_lines()
    copy.write_lines([*lines, lines[0]])


def leave_out_an_episode(copy: ResultCopy) -> None:
    copy.write_lines(copy.read_lines()[1:])


def use_another_seed(copy: ResultCopy) -> None:
    copy.change(PICK, seed=copy.outcome(OTHER_PICK)["seed"])


def use_actions_of_noop(copy: ResultCopy) -> None:
    """Keep the outcome, and replace the actions by those of a policy that fails."""
    actions = read_result(copy.other).read_actions(PICK)
    copy.store_actions(PICK, actions[: copy.outcome(PICK)["steps"]])


def scale_actions(copy: ResultCopy) -> None:
    copy.store_actions(PICK, copy.actions(PICK) * 0.9)


def shift_one_action(copy: ResultCopy) -> None:
    actions = copy.actions(PICK)
    actions[len(actions) // 2, :3] += 0.02
    copy.store_actions(PICK, actions)


def change_actions_without_hash(copy: ResultCopy) -> None:
    write_actions(copy.folder, PICK, copy.actions(PICK) * np.float32(0.9))


def store_a_nan(copy: ResultCopy) -> None:
    actions = copy.actions(PICK)
    actions[3, 0] = np.nan
    copy.store_actions(PICK, actions)


def delete_actions(copy: ResultCopy) -> None:
    (copy.folder / "actions" / f"{PICK:06d}.npz").unlink()


def omit_the_hash(copy: ResultCopy) -> None:
    copy.change(PICK, actions_hash="")


def move_an_object_in_the_states(copy: ResultCopy) -> None:
    steps, states = read_result(copy.folder).read_checkpoints(PICK)
    states = states.copy()
    states[-1, 0] += 0.1
    write_checkpoints(copy.folder, PICK, Checkpoints(steps, states))


def leave_out_states(copy: ResultCopy) -> None:
    steps, states = read_result(copy.folder).read_checkpoints(PICK)
    write_checkpoints(copy.folder, PICK, Checkpoints(steps[1:], states[1:]))


def add_steps(copy: ResultCopy) -> None:
    """Let an episode end later than the protocol allows."""
    outcome, more = copy.outcome(PICK), 900
    copy.store_actions(PICK, np.concatenate([copy.actions(PICK), np.zeros((more, 7), np.float32)]))
    steps = outcome["steps"] + more
    copy.change(PICK, steps=steps, seconds=round(outcome["seconds"] / outcome["steps"] * steps, 4))


def halve_the_rate(copy: ResultCopy) -> None:
    policy = json.loads((copy.folder / RUN).read_text())["policy"]
    policy["spec"]["rate_hz"] = policy["spec"]["rate_hz"] / 2
    copy.change_run(policy=policy)


def add_an_error(copy: ResultCopy) -> None:
    copy.change(PICK, error="the worker crashed")


def claim_no_fallen_objects(copy: ResultCopy) -> None:
    outcome = copy.outcome(SEARCH)
    measures = outcome["measures"] | {"fallen": 0.0, "disturbed_most": 0.0}
    copy.change(SEARCH, measures=measures, retrieval={"moved": [], "needed": [], "left": 0, "score": 1.0})


FORGERIES: dict[str, tuple[str, str, Forgery]] = {
    "success alone": ("noop", "verify", claim_success_alone),
    "success without the stages before it": ("noop", "verify", claim_only_the_last_stage),
    "success with all stages": ("noop", "audit", claim_success),
    "success in all episodes": ("noop", "verify", claim_all_successes),
    "earlier success, with cut actions and states": ("scripted-ee-delta", "audit", claim_an_earlier_success),
    "earlier stage": ("scripted-ee-delta", "audit", claim_an_earlier_stage),
    "shorter path": ("scripted-ee-delta", "audit", change_measure("path_length", 0.5)),
    "smaller contact impulse": ("scripted-ee-delta", "audit", change_measure("contact_impulse", 0.01)),
    "no disturbed objects in search, perfect order": ("scripted-ee-delta", "audit", claim_no_fallen_objects),
    "exchanged episodes": ("scripted-ee-delta", "audit", exchange_episodes),
    "repeated episode": ("scripted-ee-delta", "none", repeat_an_episode),
    "missing episode": ("scripted-ee-delta", "verify", leave_out_an_episode),
    "another seed": ("scripted-ee-delta", "verify", use_another_seed),
    "actions of another policy": ("scripted-ee-delta", "audit", use_actions_of_noop),
    "scaled actions": ("scripted-ee-delta", "audit", scale_actions),
    "one shifted action": ("scripted-ee-delta", "audit", shift_one_action),
    "changed actions, old hash": ("scripted-ee-delta", "verify", change_actions_without_hash),
    "NaN in the actions": ("scripted-ee-delta", "verify", store_a_nan),
    "deleted actions": ("scripted-ee-delta", "verify", delete_actions),
    "no hash of the actions": ("scripted-ee-delta", "verify", omit_the_hash),
    "changed state": ("scripted-ee-delta", "audit", move_an_object_in_the_states),
    "missing states": ("scripted-ee-delta", "audit", leave_out_states),
    "more steps than allowed": ("scripted-ee-delta", "verify", add_steps),
    "half the rate": ("scripted-ee-delta", "verify", halve_the_rate),
    "error in a successful episode": ("scripted-ee-delta", "read", add_an_error),
    "another protocol": ("scripted-ee-delta", "verify", lambda copy: copy.change_run(protocol_hash="ef" * 32)),
    "another object pack": (
        "scripted-ee-delta",
        "verify",
        lambda copy: copy.change_run(pack_hashes={"builtin": "ef" * 32}),
    ),
    "weld": ("scripted-ee-delta", "verify", lambda copy: copy.change_run(weld=True)),
    "action noise": ("scripted-ee-delta", "audit", lambda copy: copy.change_run(action_noise=[5.0, 2.0])),
    "other versions": ("scripted-ee-delta", "audit", lambda copy: copy.change_run(versions={"sapien": "2.0"})),
    "GPU physics": ("scripted-ee-delta", "audit", lambda copy: copy.change_run(backend="gpu")),
}
"""Changed result, check that must find the forgery, and the change, by name of the forgery."""


def main(cfg: Benchmark) -> None:
    """Run the benchmark."""
    sources = {policy: evaluate(policy, cfg.work / policy) for policy in ("scripted-ee-delta", "noop")}
    true_result, failed_result = sources.values()
    if not (read_result(true_result).outcomes[PICK].success and read_result(true_result).outcomes[SEARCH].retrieval):
        raise SystemExit("error: the forgeries need a success in pick, and a retrieval order in search")

    def check_change(source: Path, name: str, change: Forgery) -> dict[str, str]:
        copy = ResultCopy(source, cfg.work / "changed", failed_result)
        change(copy)
        found_by, message = check_result(copy.folder, cfg.work / "audit")
        print(name, found_by, sep=": ", file=sys.stderr)
        return {"change": name, "found_by": found_by, "message": message}

    for policy, source in sources.items():
        unchanged = check_change(source, f"unchanged result of {policy}", lambda copy: None)
        if unchanged["found_by"] != "none":
            raise SystemExit(f"error: {unchanged}")
    changes = list_field_changes(true_result) if cfg.fields else ()
    fields = [check_change(true_result, name, change) for name, change in changes]
    forgeries = [check_change(sources[policy], name, forge) for name, (policy, _, forge) in FORGERIES.items()]
    found = {
        kind: Counter(change["found_by"] for change in changes)
        for kind, changes in (("fields", fields), ("forgeries", forgeries))
    }
    print(json.dumps({"found": found, "fields": fields, "forgeries": forgeries}, indent=1))
    wrong = [one for one in forgeries if one["found_by"] != FORGERIES[one["change"]][1]]
    if wrong:
        raise SystemExit(f"error: not found by the expected check: {json.dumps(wrong)}")


def evaluate(policy: str, out: Path) -> Path:
    """Evaluate a policy on the protocol; return the folder of the result."""
    with open_policy(policy) as opened:
        settings = EvaluationSettings((), policy, PROTOCOL, out, envs=1, backend="processes")
        for outcome in EvaluationSession(opened, settings).run():
            print(policy, outcome.episode, outcome.task, outcome.success, file=sys.stderr)
    return out


def check_result(folder: Path, audit: Path) -> tuple[str, str]:
    """Return the check that finds something in a result, and its first message; ``none`` and an empty message: none."""
    try:
        result = read_result(folder)
        protocol = load_protocol_of(result)
        if violations := find_violations(result, protocol):
            return "verify", violations[0]
        if obstacle := find_audit_obstacle(result):
            return "audit", obstacle
        audited = run_audit(result, protocol, audit, stored=REPLAYED, envs=1, overwrite=True)
        differences = [f"episode {one.episode}: {text}" for one in audited for text in one.differences]
    except RobocasError as error:
        return "read", one_line(error)
    return ("audit", differences[0]) if differences else ("none", "")


def list_field_changes(source: Path) -> Iterator[tuple[str, Forgery]]:
    """Yield a name and a function for the change of each value in ``run.json`` and in two outcomes."""
    run = json.loads((source / RUN).read_text())
    for path in list_values(run):

        def change_run(copy: ResultCopy, path: tuple[Any, ...] = path) -> None:
            values = json.loads((copy.folder / RUN).read_text())
            change_value(values, path)
            (copy.folder / RUN).write_text(json.dumps(values))

        yield f"run.json {'.'.join(map(str, path))}", change_run
    lines = [json.loads(line) for line in (source / OUTCOMES).read_text().splitlines()]
    for episode, only in ((PICK, ""), (SEARCH, "retrieval")):
        number = next(place for place, line in enumerate(lines) if line["episode"] == episode)
        for path in list_values(lines[number]):
            if only and path[0] != only:
                continue

            def change_outcome(copy: ResultCopy, number: int = number, path: tuple[Any, ...] = path) -> None:
                changed = copy.read_lines()
                change_value(changed[number], path)
                copy.write_lines(changed)

            yield f"episodes.jsonl {lines[number]['task']} {'.'.join(map(str, path))}", change_outcome


def list_values(values: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the keys of each value that is neither a list nor an object, and of each empty one."""
    items = values.items() if isinstance(values, dict) else enumerate(values) if isinstance(values, list) else ()
    found = list(items)
    if not found:
        yield path
    for key, value in found:
        yield from list_values(value, (*path, key))


def change_value(values: Any, path: tuple[Any, ...]) -> None:
    """Change the value with these keys to another value, where possible of the same type."""
    for key in path[:-1]:
        values = values[key]
    value = values[path[-1]]
    if isinstance(value, bool):
        values[path[-1]] = not value
    elif isinstance(value, int):
        values[path[-1]] = value + 1
    elif isinstance(value, float):
        values[path[-1]] = value + 0.25
    elif isinstance(value, str):
        values[path[-1]] = f"{value}x"
    elif value is None:
        values[path[-1]] = 1
    else:
        values[path[-1]] = ["x"] if isinstance(value, list) else {"x": "x"}


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
