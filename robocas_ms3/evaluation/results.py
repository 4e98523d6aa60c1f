"""What came of an evaluation: a line an episode, appended as it ends, and what it was measured with beside it.

::

    run.json            protocol and its hash, policy, versions, backend, packs, machine
    episodes.jsonl      an `Outcome` a line, in any order; a line that a kill left half-written is dropped

Parts of a result, such as shards, are read as one (`read`) or written as one (`merge`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.files import json_text, replacing_folder, write_json
from robocas_ms3.core.ledger import Ledger
from robocas_ms3.core.outputs import FolderKind, OutputFolder, check_replaceable
from robocas_ms3.core.strict import parse, parse_json
from robocas_ms3.evaluation.outcomes import Outcome
from robocas_ms3.evaluation.statistics import Share, share

RUN, OUTCOMES = "run.json", "episodes.jsonl"
_PACKAGES = ("robocas_ms3", "mani_skill", "sapien", "gymnasium", "numpy", "torch")
_NO_RESULT = "no result of an evaluation"


class PolicyRecord(BaseModel):
    """What a result says about its policy. A policy adds entries of its own (`policy.describe`).

    Attributes:
        name: as the user gave it.
        wants: the policy's specification, `PolicySpec`.
        server: description of a policy that is behind a server.
    """

    model_config = ConfigDict(strict=True, extra="allow")

    name: str
    wants: dict[str, Any] = {}
    server: dict[str, Any] | None = None

    def entries(self) -> dict[str, Any]:
        """Return its values in the form of the file."""
        return self.model_dump(exclude_unset=True)

    def identity(self) -> dict[str, Any]:
        """Return what tells it from another policy: of one behind a server, the description instead of the address."""
        known = self.server and self.name.startswith(("ws://", "wss://"))
        return {key: value for key, value in self.entries().items() if key != "name" or not known}


class PartRecord(BaseModel):
    """One of the folders that were merged into a result."""

    model_config = ConfigDict(strict=True)

    folder: str
    episodes: int
    machine: dict[str, Any] | None = None


class RunRecord(BaseModel):
    """``run.json``: what a result was measured with."""

    model_config = ConfigDict(strict=True, extra="allow")

    protocol: str
    protocol_hash: str
    policy: PolicyRecord
    weld: bool = False
    backend: str
    versions: dict[str, str]
    pack_hashes: dict[str, str]
    machine: dict[str, Any] | None = None
    parts: list[PartRecord] = []

    def entries(self) -> dict[str, Any]:
        """Return its values in the form of the file."""
        return self.model_dump(exclude_unset=True)

    def identity(self) -> dict[str, Any]:
        """Return the values that have to match in the parts of one result, and to continue it."""
        names = ("protocol", "protocol_hash", "weld", "backend", "versions", "pack_hashes")
        return {"policy": self.policy.identity(), **{name: getattr(self, name) for name in names}}


@dataclass(frozen=True)
class Result:
    """A folder that was written, or several that are parts of one result.

    Attributes:
        folder: where it is; of several, the first one.
        run: what it was measured with; of several, the first one's, with their ``parts``.
        outcomes: by episode's number, in its order.
    """

    folder: Path
    run: RunRecord
    outcomes: dict[int, Outcome]

    def rate(self, what: str = "success", outcomes: Iterable[Outcome] | None = None) -> Share:
        """How many episodes a flag ever held in, of all or some (one at least), with its interval."""
        chosen = list(self.outcomes.values() if outcomes is None else outcomes)
        held = [getattr(one, what) if hasattr(one, what) else one.flags.get(what) is not None for one in chosen]
        return share(sum(held), len(held))

    def repeats(self) -> bool:
        """Whether a scene may be there several times, in several splits: then its episodes must not be pooled."""
        return len({(one.task, one.seed) for one in self.outcomes.values()}) < len(self.outcomes)

    def broken_off(self) -> int:
        """How many episodes an error ended."""
        return sum(bool(one.error) for one in self.outcomes.values())

    def by(self, name: str) -> dict[str, list[Outcome]]:
        """Its outcomes by one of their attributes, such as ``config``; sorted, but splits as the protocol has them."""
        found: dict[str, list[Outcome]] = {}
        for outcome in self.outcomes.values():
            found.setdefault(getattr(outcome, name), []).append(outcome)
        return found if name == "split" else dict(sorted(found.items()))


@contextmanager
def open_result(
    folder: Path, run: RunRecord, *, overwrite: bool = False, retry_errors: bool = False
) -> Iterator[dict[int, Outcome]]:
    """Lock the folder of a result, and start it or continue it.

    Args:
        folder: of the result.
        run: what it is measured with.
        overwrite: start again.
        retry_errors: drop episodes that an error broke off, so that they are played again.

    Yields:
        The outcomes that exist, by number of the episode.

    Raises:
        OutputExistsError: it was measured with something else, or the folder is not of an evaluation.
        RobocasError: another process writes there; or somebody removed the folder.
    """
    with OutputFolder(folder, OUTPUT, _settings_of(run), overwrite=overwrite) as output:
        output.start(output.recorded or run.entries())
        outcomes = _outcomes(folder)
        if retry_errors and any(one.error for one in outcomes.values()):
            outcomes = {number: one for number, one in outcomes.items() if not one.error}
            _ledger(folder).rewrite(outcomes.values())
        yield outcomes


def run_record(values: dict[str, Any], where: object) -> RunRecord:
    """Return the record of an evaluation.

    Args:
        values: of the record.
        where: for error messages.

    Raises:
        EvaluationError: a value is missing or wrong, or could not be read back, such as NaN.
    """
    text = json_text(values, where, error=EvaluationError)
    return parse_json(RunRecord, text, EvaluationError, where=where, about="this evaluation can't be recorded")


def append(folder: Path, outcome: Outcome) -> None:
    """Add an episode; on the disk when this returns."""
    _ledger(folder).append([outcome], sync=True)


def read(*folders: Path) -> Result:
    """Read a result, or parts of one, in which an episode may be more than once if the outcome is the same.

    Raises:
        EvaluationError: there is none, the parts were measured with different things, or they disagree.
    """
    parts = [_read(folder) for folder in folders]
    first = parts[0]
    outcomes: dict[int, Outcome] = {}
    for part in parts:
        expected, found = _differing(first.run.identity(), part.run.identity())
        if expected != found:
            key = next(iter(found))
            raise EvaluationError(
                f"no part of one result with {first.folder}: another {key}",
                where=part.folder,
                expected=expected[key],
                found=found[key],
            )
        for outcome in part.outcomes.values():
            _add(outcomes, outcome, str(part.folder))
    run = first.run
    if len(parts) > 1:
        records = [
            PartRecord(folder=str(part.folder), episodes=len(part.outcomes), machine=part.run.machine) for part in parts
        ]
        run = run.model_copy(update={"parts": records})
    return Result(first.folder, run, dict(sorted(outcomes.items())))


def parts_of(folders: Iterable[Path]) -> list[list[Path]]:
    """Folders that `read` takes together: measured with the same, and of other episodes than those before."""
    found: list[tuple[dict[str, Any], set[int], list[Path]]] = []
    for folder in folders:
        part = _read(folder)
        key = part.run.identity()
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
        EvaluationError: see `read`.
        OutputExistsError: ``out`` exists.
    """
    result = read(*folders)
    check_replaceable(out)
    with replacing_folder(out) as folder:
        write_json(folder / RUN, result.run.entries())
        _ledger(folder).rewrite(result.outcomes.values())
    return read(out)


def versions() -> dict[str, str]:
    """Of the packages that a score hangs on."""
    return {name: version(name) for name in _PACKAGES}


def _settings_of(run: RunRecord) -> dict[str, Any]:
    """Return what has to match to continue a result."""
    return {**run.identity(), "machine": run.machine}


def _recorded_settings(values: dict[str, Any]) -> dict[str, Any]:
    return _settings_of(parse(RunRecord, values, EvaluationError, where=RUN, about=_NO_RESULT))


OUTPUT = FolderKind("robocas eval", (RUN,), "protocol_hash", upgrade=_recorded_settings)


def _ledger(folder: Path) -> Ledger[Outcome]:
    return Ledger(folder / OUTCOMES, Outcome)


def _read(folder: Path) -> Result:
    run = _read_run(folder)
    try:
        outcomes = dict(sorted(_outcomes(folder).items()))
    except (OSError, ValueError) as error:
        raise EvaluationError(_NO_RESULT, where=folder, found=error) from error
    return Result(folder, run, outcomes)


def _read_run(folder: Path) -> RunRecord:
    try:
        run = load_json(folder / RUN)
    except (OSError, ValueError) as error:
        raise EvaluationError(_NO_RESULT, where=folder, found=error) from error
    return parse(RunRecord, run, EvaluationError, where=folder / RUN, about=_NO_RESULT)


def _outcomes(folder: Path) -> dict[int, Outcome]:
    """Those of a run that may be at it, or was killed."""
    ledger, found = _ledger(folder), dict[int, Outcome]()
    for line in ledger.lines():
        if line.record is not None:
            _add(found, line.record, f"{ledger.path}:{line.number}")
        elif not line.cut_off:
            raise ledger.refusal(line, EvaluationError, "no outcome of an episode") from line.problem
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
