"""What came of an evaluation: a line an episode, appended as it ends, and what it was measured with beside it.

::

    run.json            protocol and its hash, policy, versions, backend, packs, machine
    episodes.jsonl      an `Outcome` a line, in any order; a line that a kill left half-written is dropped
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

from robocas_ms3.errors import EvaluationError
from robocas_ms3.evaluation.rollout import Played
from robocas_ms3.evaluation.statistics import Share, share
from robocas_ms3.files import make_folder, write_json

RUN, OUTCOMES = "run.json", "episodes.jsonl"
_PACKAGES = ("robocas_ms3", "mani_skill", "sapien", "gymnasium", "numpy", "torch")
# evaluation_v0.md and the paper's table: reach, pick, recognise, clear
STAGES = {"RA": "reached_any", "PA": "picked_any", "RR": "reached_target", "CO": "obstacles_cleared"}
_ORDER = ("reached_any", "furniture_opened", "obstacles_cleared", "reached_target", "target_grasped", "target_lifted")


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
        failure_stage: the first stage it did not come to; empty: it succeeded. ``error``: it was broken off.
        error: why.
        flags: by stage or rule, the policy step after which it first held.
        flag_seconds: the same in s of the scene.
        measures: ``path_length`` m, ``contact_impulse`` N s, ``disturbed_most``, ``fallen``.
        inference_ms: clock time of the policy a step.
        p_vis: share of the target that is seen from above.
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

    @classmethod
    def of(cls, played: Played, *, config: str, split: str, p_vis: float | None) -> Outcome:
        """What is kept of an episode that was played."""
        flags, start = played.flags, played.start
        success = flags.get("success") is not None
        left = [stage for stage in _ORDER if stage in flags and flags[stage] is None]
        failed = "error" if played.error else "" if success else (left[0] if left else "placed")
        return cls(
            episode=start.episode,
            task=start.task,
            config=config,
            seed=start.seed,
            split=split,
            success=success,
            success_at_end=played.at_end.get("success", False),
            success_v0=played.at_end.get("success_v0", False),
            steps=played.steps,
            seconds=round(played.seconds, 4),
            failure_stage=failed,
            error=played.error,
            flags=flags,
            flag_seconds=played.flag_seconds,
            measures=played.measures,
            inference_ms=round(1000 * played.inference_seconds / max(played.steps, 1), 3),
            p_vis=p_vis,
        )

    def without_clock(self) -> dict[str, Any]:
        """All but what a clock said: the same for the same seed and policy."""
        return {name: value for name, value in asdict(self).items() if name != "inference_ms"}


@dataclass(frozen=True)
class Result:
    """A folder that was written.

    Attributes:
        folder: where it is.
        run: of ``run.json``.
        outcomes: by episode's number, in its order.
    """

    folder: Path
    run: dict[str, Any]
    outcomes: dict[int, Outcome]

    def rate(self, what: str = "success", outcomes: Iterable[Outcome] | None = None) -> Share:
        """How many episodes a flag ever held in, of all or some, with its interval."""
        chosen = list(self.outcomes.values() if outcomes is None else outcomes)
        held = [getattr(one, what) if hasattr(one, what) else one.flags.get(what) is not None for one in chosen]
        return share(sum(held), len(held))


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
    before = json.loads(path.read_text(encoding="utf-8"))
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


def read(folder: Path) -> Result:
    """Read a result.

    Raises:
        EvaluationError: there is none.
    """
    try:
        run = json.loads((folder / RUN).read_text(encoding="utf-8"))
        return Result(folder, run, dict(sorted(_outcomes(folder / OUTCOMES).items())))
    except (OSError, ValueError) as error:
        raise EvaluationError("no result of an evaluation", where=folder, found=error) from error


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
        found[outcome.episode] = outcome
    return found
