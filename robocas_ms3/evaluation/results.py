"""What came of an evaluation: a line an episode, appended as it ends, and what it was measured with beside it.

::

    run.json            protocol and its hash, policy, versions, backend, packs, machine
    episodes.jsonl      an `Outcome` a line, in any order; a line that a kill left half-written is dropped

Parts of a result, such as shards, are read as one (`read`) or written as one (`merge`).
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

from robocas_ms3.errors import EvaluationError
from robocas_ms3.evaluation import retrieval
from robocas_ms3.evaluation.protocol import Episode
from robocas_ms3.evaluation.rollout import Played
from robocas_ms3.evaluation.statistics import Share, share
from robocas_ms3.files import make_folder, replacing_folder, write_json

RUN, OUTCOMES = "run.json", "episodes.jsonl"
_PACKAGES = ("robocas_ms3", "mani_skill", "sapien", "gymnasium", "numpy", "torch")
_SAME = {  # of parts of one result, and what each is
    "protocol": str,
    "protocol_hash": str,
    "policy": dict,
    "weld": bool,
    "backend": str,
    "versions": dict,
    "pack_hashes": dict,
}
_BEFORE = {"weld": False}  # of results that were written before there was one
# evaluation_v0.md and the paper's table: reach, pick, recognise, clear
STAGES = {"RA": "reached_any", "PA": "picked_any", "RR": "reached_target", "CO": "obstacles_cleared"}
_ORDER = ("furniture_opened", "reached_any", "obstacles_cleared", "reached_target", "target_grasped", "target_lifted")


@dataclass(frozen=True)
class Outcome:
    """What came of an episode.

    Attributes:
        episode: its number in the protocol.
        task: short name.
        config: name of its configuration.
        seed: of its scene.
        split: of the protocol.
        success: the task had succeeded at some moment.
        success_at_end: it had at the last one.
        success_v0: upstream's rule held at the last one.
        steps: policy steps.
        seconds: of the scene.
        failure_stage: see `failure_stage`; empty: it succeeded.
        error: why.
        flags: by stage or rule, the policy step after which it first held.
        flag_seconds: the same in s of the scene.
        measures: ``path_length`` m, ``contact_impulse`` N s, ``disturbed_most``, ``fallen``; ``welds`` with the weld.
        inference_ms: clock time of the policy a step.
        p_vis: share of the target that is seen from above.
        retrieval: search: what was moved before the target, see `retrieval.outcome`.
    """

    episode: int
    task: str
    config: str
    seed: int
    split: str
    success: bool
    success_at_end: bool
    success_v0: bool
    steps: int
    seconds: float
    failure_stage: str
    error: str = ""
    flags: dict[str, int | None] = field(default_factory=dict)
    flag_seconds: dict[str, float | None] = field(default_factory=dict)
    measures: dict[str, float] = field(default_factory=dict)
    inference_ms: float = 0.0
    p_vis: float | None = None
    retrieval: dict[str, Any] | None = None

    @classmethod
    def of(cls, played: Played, episode: Episode, objects: Sequence[str]) -> Outcome:
        """What is kept of an episode that was played, with objects of these ids."""
        flags, held_at, order = played.flags, played.flags.get("target_grasped"), None
        if played.retrieval is not None:
            cleared = flags.get("obstacles_cleared") is not None
            order = retrieval.outcome(played.retrieval, objects, held_at, cleared=cleared)
        return cls(
            episode=episode.episode,
            task=episode.task,
            config=episode.config,
            seed=episode.seed,
            split=episode.split,
            success=flags.get("success") is not None,
            success_at_end=played.at_end.get("success", False),
            success_v0=played.at_end.get("success_v0", False),
            steps=played.steps,
            seconds=round(played.seconds, 4),
            failure_stage=failure_stage(flags, played.error),
            error=played.error,
            flags=flags,
            flag_seconds=played.flag_seconds,
            measures=played.measures,
            inference_ms=round(1000 * played.inference_seconds / max(played.steps, 1), 3),
            p_vis=episode.p_vis,
            retrieval=order,
        )

    def without_clock(self) -> dict[str, Any]:
        """All but what a clock said: the same for the same seed and policy."""
        return {name: value for name, value in asdict(self).items() if name != "inference_ms"}


def failure_stage(flags: dict[str, int | None], error: str = "") -> str:
    """The stage an episode did not come to, next after the furthest that it did come to.

    A target that is pulled out of its heap was reached though its obstacles were never cleared, so stages that were
    left out on the way do not count. ``placed``: it was lifted; ``error``: the episode was broken off; empty: success.
    """
    if error:
        return "error"
    if flags.get("success") is not None:
        return ""
    stages = [stage for stage in _ORDER if stage in flags]
    came = [number for number, stage in enumerate(stages) if flags[stage] is not None]
    following = came[-1] + 1 if came else 0
    return stages[following] if following < len(stages) else "placed"


@dataclass(frozen=True)
class Result:
    """A folder that was written, or several that are parts of one result.

    Attributes:
        folder: where it is; of several, the first one.
        run: of ``run.json``; of several, the first one's, with ``parts``: what each is of.
        outcomes: by episode's number, in its order.
    """

    folder: Path
    run: dict[str, Any]
    outcomes: dict[int, Outcome]

    def rate(self, what: str = "success", outcomes: Iterable[Outcome] | None = None) -> Share:
        """How many episodes a flag ever held in, of all or some (one at least), with its interval."""
        chosen = list(self.outcomes.values() if outcomes is None else outcomes)
        held = [getattr(one, what) if hasattr(one, what) else one.flags.get(what) is not None for one in chosen]
        return share(sum(held), len(held))

    def repeats(self) -> bool:
        """Whether a scene may be there several times, in several splits: then its episodes must not be pooled."""
        return len({(one.task, one.seed) for one in self.outcomes.values()}) < len(self.outcomes)

    def by(self, name: str) -> dict[str, list[Outcome]]:
        """Its outcomes by one of their attributes, such as ``config``; sorted, but splits as the protocol has them."""
        found: dict[str, list[Outcome]] = {}
        for outcome in self.outcomes.values():
            found.setdefault(getattr(outcome, name), []).append(outcome)
        return found if name == "split" else dict(sorted(found.items()))


def begin(folder: Path, run: dict[str, Any], *, resume: bool) -> dict[int, Outcome]:
    """Begin a result, or go on with it.

    Returns:
        What is there already.

    Raises:
        EvaluationError: it was measured with something else.
    """
    make_folder(folder)
    path = folder / RUN
    if not path.is_file():
        write_json(path, run)
        return {}
    before = {**_BEFORE, **json.loads(path.read_text(encoding="utf-8"))}
    if not resume and (folder / OUTCOMES).is_file():
        raise EvaluationError(
            "there is a result already", where=folder, fix="Pass --resume to go on, or another --out."
        )
    for key, value in run.items():
        if before.get(key) != value:
            raise EvaluationError(
                f"can't go on with another {key}", where=folder, expected=before.get(key), found=value
            )
    return _mended(folder / OUTCOMES)


def append(folder: Path, outcome: Outcome) -> None:
    """Add an episode; on the disk when this returns."""
    with (folder / OUTCOMES).open("a", encoding="utf-8") as file:
        file.write(json.dumps(asdict(outcome)) + "\n")
        file.flush()
        os.fsync(file.fileno())


def read(*folders: Path) -> Result:
    """Read a result, or parts of one, in which an episode may be more than once if the outcome is the same.

    Raises:
        EvaluationError: there is none, the parts were measured with different things, or they disagree.
    """
    parts = [_read(folder) for folder in folders]
    first = parts[0]
    outcomes: dict[int, Outcome] = {}
    for part in parts:
        for key in _SAME:
            if part.run.get(key) != first.run.get(key):
                expected, found = _differing(first.run.get(key), part.run.get(key))
                raise EvaluationError(
                    f"no part of one result with {first.folder}: another {key}",
                    where=part.folder,
                    expected=expected,
                    found=found,
                )
        for outcome in part.outcomes.values():
            _add(outcomes, outcome, str(part.folder))
    said = [
        {"folder": str(part.folder), "episodes": len(part.outcomes), "machine": part.run.get("machine")}
        for part in parts
    ]
    run = first.run if len(parts) == 1 else {**first.run, "parts": said}
    return Result(first.folder, run, dict(sorted(outcomes.items())))


def parts_of(folders: Iterable[Path]) -> list[list[Path]]:
    """Folders that `read` takes together: measured with the same, and of other episodes than those before."""
    found: list[tuple[list[Any], set[int], list[Path]]] = []
    for folder in folders:
        part = _read(folder)
        key = [part.run[name] for name in _SAME]
        for other, episodes, group in found:
            if other == key and not episodes & part.outcomes.keys():
                group.append(folder)
                episodes.update(part.outcomes)
                break
        else:
            found.append((key, set(part.outcomes), [folder]))
    return [group for _, _, group in found]


def merge(folders: Sequence[Path], out: Path) -> Result:
    """Write parts of a result as one, into a folder that appears whole.

    Raises:
        EvaluationError: see `read`; or something is there already.
    """
    result = read(*folders)
    if out.exists():
        raise EvaluationError("there is something already", where=out, fix="Choose another --out.")
    with replacing_folder(out) as folder:
        write_json(folder / RUN, result.run)
        lines = [json.dumps(asdict(outcome)) + "\n" for outcome in result.outcomes.values()]
        (folder / OUTCOMES).write_text("".join(lines), encoding="utf-8")
    return read(out)


def versions() -> dict[str, str]:
    """Of the packages that a score hangs on."""
    return {name: version(name) for name in _PACKAGES}


def _mended(path: Path) -> dict[int, Outcome]:
    """The outcomes of a file that a kill may have cut in the middle of its last line, which goes."""
    if not path.is_file():
        return {}
    content = path.read_bytes()
    whole = content[: content.rfind(b"\n") + 1]
    if whole != content:
        with path.open("r+b") as file:
            file.truncate(len(whole))
    return _outcomes(path)


def _read(folder: Path) -> Result:
    try:
        run = json.loads((folder / RUN).read_text(encoding="utf-8"))
        outcomes = dict(sorted(_outcomes(folder / OUTCOMES).items()))
    except (OSError, ValueError) as error:
        raise EvaluationError("no result of an evaluation", where=folder, found=error) from error
    run = {**_BEFORE, **run} if isinstance(run, dict) else {}
    missing = [key for key, kind in _SAME.items() if not isinstance(run.get(key), kind)]
    if not missing and not isinstance(run["policy"].get("name"), str):
        missing = ["policy.name"]
    if missing:
        raise EvaluationError("no result of an evaluation", where=folder / RUN, expected=", ".join(missing))
    return Result(folder, run, outcomes)


def _outcomes(path: Path) -> dict[int, Outcome]:
    if not path.is_file():
        return {}
    known = {one.name for one in fields(Outcome)}
    found: dict[int, Outcome] = {}
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(keepends=True), start=1):
        if not line.endswith("\n"):
            break  # of a run that is at it, or was killed
        try:
            data = json.loads(line)
            outcome = Outcome(**{name: value for name, value in data.items() if name in known})
        except (ValueError, TypeError, AttributeError) as error:
            raise EvaluationError("no outcome of an episode", where=f"{path}:{number}", found=error) from error
        _add(found, outcome, f"{path}:{number}")
    return found


def _add(outcomes: dict[int, Outcome], outcome: Outcome, where: str) -> None:
    """Add an episode, which may be there already if the same came of it."""
    before = outcomes.setdefault(outcome.episode, outcome)
    one, other = before.without_clock(), outcome.without_clock()
    if one != other:
        expected, found = _differing(one, other)
        what = f"two outcomes of episode {outcome.episode} disagree"
        raise EvaluationError(what, where=where, expected=expected, found=found)


def _differing(one: Any, other: Any) -> tuple[Any, Any]:
    """What of two values differs: of dictionaries only the entries that do."""
    if not (isinstance(one, dict) and isinstance(other, dict)):
        return one, other
    both = {key: _differing(one.get(key), other.get(key)) for key in {**one, **other} if one.get(key) != other.get(key)}
    return {key: a for key, (a, _) in both.items()}, {key: b for key, (_, b) in both.items()}
