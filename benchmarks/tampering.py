"""Change a result in many ways, and list which check finds each change; print JSON.

python benchmarks/tampering.py --work tampering > tampering.json

The script evaluates `scripted-ee-delta` and `noop` on the protocol smoke, and two episodes of `scripted-ee-delta` on
paper-v1, without and with the weld. Then it forges results (``forgeries``, from forgeries.py), and changes every value
of run.json, of an outcome of pick and of a retrieval order of search (``fields``). Each changed copy goes through the
checks of `robocas eval verify` and `robocas eval audit`, which replays up to three episodes. The script also changes
every value of run.json of a trained policy, the entry leaderboard/keyframe/paper-v1, without replays
(``trained_fields``). The exit status is 1 if a forgery is not found by the check that is expected for it.

JSON keys:
  found            number of changes by the check that finds them
  consistent       number of forgeries found by verify or audit whose values contradict neither each other nor the files
  fields, trained_fields, forgeries
    change         changed value, or name of the forgery
    found_by       read: the file is refused; verify; audit; none: no check
    message        first message
"""

from __future__ import annotations

import json
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import tyro
from forgeries import EXPERT, FORGERIES, NOOP, OTHER_PICK, PAPER, PICK, SEARCH, WELDED, ResultCopy, increment_version

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.text import one_line
from robocas_ms3.evaluation.audit.obstacles import find_audit_obstacle
from robocas_ms3.evaluation.audit.run import AuditSettings, run_audit
from robocas_ms3.evaluation.policies import open_policy
from robocas_ms3.evaluation.results.result_files import OUTCOMES, RUN, load_protocol_of, read_result
from robocas_ms3.evaluation.results.verify import find_violations
from robocas_ms3.evaluation.rollouts.session import EvaluationSession
from robocas_ms3.evaluation.settings import EvaluationSettings

TRAINED = Path(__file__).resolve().parents[1] / "leaderboard" / "keyframe" / "paper-v1"
REPLAYED = {PICK, OTHER_PICK, SEARCH}
_TRAINED_EPISODES = 4
OTHER_VALUES = {
    "backend": ("gpu", "processes"),
    "calibration": ("true", "nominal"),
    "convention": ("delta_axis_angle", "robocas"),
    "language": ("text", "none"),
    "protocol": ("ms3-v1", "paper-v1"),
    "rate_hz": (10, 5),
    "reference": ("target", "tcp"),
    "track": ("end-to-end", "modular"),
    "cameras": ({"base_camera": [128, 96]}, {}),
}
"""Valid values of settings that accept only some, by key: a change takes the first that differs."""


class Source(NamedTuple):
    """Evaluation whose result is changed: settings, and whether the result has all episodes of the protocol."""

    policy: str
    protocol: str
    tasks: tuple[str, ...] = ()
    episodes: int | None = None
    weld: bool = False

    @property
    def is_complete(self) -> bool:
        return self.episodes is None


SOURCES = {
    EXPERT: Source("scripted-ee-delta", "smoke"),
    NOOP: Source("noop", "smoke", episodes=1),
    PAPER: Source("scripted-ee-delta", "paper-v1", ("pick",), episodes=2),
    WELDED: Source("scripted-ee-delta", "paper-v1", ("pick",), episodes=2, weld=True),
}


@dataclass
class Benchmark:
    work: Path
    """Folder of the results; those of an earlier run are used again."""
    fields: bool = True
    """Whether to change every single value too."""


@dataclass(frozen=True)
class CheckedChange:
    """Change of a result, and the check that found it: an entry of the JSON output."""

    change: str
    found_by: str
    message: str


def main(cfg: Benchmark) -> None:
    """Run the benchmark."""
    folders = {name: evaluate(source, cfg.work / name) for name, source in SOURCES.items()}
    outcomes = read_result(folders[EXPERT]).outcomes
    if not (outcomes[PICK].success and outcomes[SEARCH].retrieval):
        raise SystemExit("error: the forgeries need a success in pick, and a retrieval order in search")

    def check_change(source: str, name: str, change: Callable[[ResultCopy], None]) -> CheckedChange:
        copy = ResultCopy(folders[source], cfg.work / "changed", folders[NOOP])
        change(copy)
        is_complete = SOURCES[source].is_complete
        found = find_problem(copy.folder, is_complete=is_complete) or find_difference(copy.folder, cfg.work / "audit")
        checked = CheckedChange(name, *found or ("none", ""))
        print(name, checked.found_by, checked.message[:80], sep=": ", file=sys.stderr)
        return checked

    for name in SOURCES:
        unchanged = check_change(name, f"unchanged result {name}", lambda copy: None)
        if unchanged.found_by != "none":
            raise SystemExit(f"error: {unchanged}")
    changed = {"forgeries": [check_change(forgery.source, name, forgery.change) for name, forgery in FORGERIES.items()]}
    if cfg.fields:
        changed["fields"] = [check_change(EXPERT, *change) for change in list_field_changes(folders[EXPERT])]
        changed["trained_fields"] = check_trained_fields(cfg.work)
    found = {kind: Counter(one.found_by for one in changes) for kind, changes in changed.items()}
    expected = {"verify", "audit"}
    consistent = sum(one.is_consistent and one.found_by in expected for one in FORGERIES.values())
    listed = {kind: [vars(one) for one in changes] for kind, changes in changed.items()}
    print(json.dumps({"found": found, "consistent": consistent, **listed}, indent=1))
    wrong = [one for one in changed["forgeries"] if one.found_by != FORGERIES[one.change].found_by]
    if wrong:
        raise SystemExit(f"error: not found by the expected check: {wrong}")


def evaluate(source: Source, out: Path) -> Path:
    """Evaluate a policy on a protocol; return the folder of the result."""
    with open_policy(source.policy) as opened:
        settings = EvaluationSettings(
            source.tasks,
            source.policy,
            source.protocol,
            out,
            weld=source.weld,
            episodes=source.episodes,
            envs=1,
            backend="processes",
        )
        for outcome in EvaluationSession(opened, settings).run():
            print(out.name, outcome.episode, outcome.task, outcome.success, file=sys.stderr)
    return out


def find_problem(folder: Path, *, is_complete: bool, stores_actions: bool = True) -> tuple[str, str] | None:
    """Return the check without a replay that finds something in a result, and its first message.

    ``stores_actions``: whether the stored actions are checked.
    """
    try:
        result = read_result(folder)
        stored = None if stores_actions else ()
        violations = find_violations(result, load_protocol_of(result), is_complete=is_complete, stored=stored)
    except RobocasError as error:
        return "read", one_line(error)
    return ("verify", violations[0]) if violations else None


def find_difference(folder: Path, audit: Path) -> tuple[str, str] | None:
    """Return ``audit`` and its first message; None: the replayed episodes have no difference."""
    result = read_result(folder)
    if obstacle := find_audit_obstacle(result):
        return "audit", obstacle
    try:
        settings = AuditSettings(stored_episodes=REPLAYED, jobs=0, overwrite=True)
        for one in run_audit(result, load_protocol_of(result), audit, settings):
            if one.differences:
                return "audit", f"episode {one.episode}: {one.differences[0]}"
    except RobocasError as error:
        return "audit", one_line(error)
    return None


def check_trained_fields(work: Path) -> list[CheckedChange]:
    """Change each value of run.json of a trained policy; read and verify the result, without a replay."""
    source, checked = work / "trained", []
    source.mkdir(parents=True, exist_ok=True)
    run = json.loads((TRAINED / RUN).read_text())
    run["policy"]["spec"].setdefault("calibration", "nominal")  # the default
    (source / RUN).write_text(json.dumps(run))
    lines = (TRAINED / OUTCOMES).read_text().splitlines(keepends=True)
    (source / OUTCOMES).write_text("".join(lines[:_TRAINED_EPISODES]))
    for name, change in [("unchanged result", lambda copy: None), *list_run_changes(source)]:
        copy = ResultCopy(source, work / "changed", source)
        change(copy)
        found = find_problem(copy.folder, is_complete=False, stores_actions=False)
        checked.append(CheckedChange(name, *found or ("none", "")))
    unchanged, *others = checked
    if unchanged.found_by != "none":
        raise SystemExit(f"error: {unchanged}")
    return others


def list_field_changes(source: Path) -> Iterator[tuple[str, Callable[[ResultCopy], None]]]:
    """Yield a name and a function for the change of each value in ``run.json`` and in two outcomes."""
    yield from list_run_changes(source)
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


def list_run_changes(source: Path) -> Iterator[tuple[str, Callable[[ResultCopy], None]]]:
    """Yield a name and a function for the change of each value in ``run.json``."""
    for path in list_values(json.loads((source / RUN).read_text())):

        def change_run(copy: ResultCopy, path: tuple[Any, ...] = path) -> None:
            run = copy.read_run()
            change_value(run, path)
            copy.change_run(**run)

        yield f"run.json {'.'.join(map(str, path))}", change_run


def list_values(values: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the keys of each value that is neither a list nor an object, and of each empty one."""
    items = values.items() if isinstance(values, dict) else enumerate(values) if isinstance(values, list) else ()
    found = list(items)
    if not found:
        yield path
    for key, value in found:
        yield from list_values(value, (*path, key))


def change_value(values: Any, path: tuple[Any, ...]) -> None:
    """Change the value with these keys to another value, where possible a valid one of the same type."""
    for key in path[:-1]:
        values = values[key]
    value = values[path[-1]]
    if path[-1] in OTHER_VALUES:
        values[path[-1]] = next(other for other in OTHER_VALUES[path[-1]] if other != value)
    elif isinstance(value, bool):
        values[path[-1]] = not value
    elif isinstance(value, int):
        values[path[-1]] = value + 1
    elif isinstance(value, float):
        values[path[-1]] = value + 0.25
    elif isinstance(value, str):
        values[path[-1]] = change_text(value)
    elif value is None:
        values[path[-1]] = 1
    else:
        values[path[-1]] = ["x"] if isinstance(value, list) else {"x": "x"}


def change_text(text: str) -> str:
    """Return another text: another version of a version, another hash of a hash."""
    if re.fullmatch(r"\d+\.\d+\.\S+", text):
        return increment_version(text)
    if re.fullmatch("[0-9a-f]{64}", text):
        return ("1" if text[0] == "0" else "0") + text[1:]
    return f"{text}x"


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
