"""Results of evaluations: a record of the settings, and one line per episode.

::

    run.json            protocol and its hash, policy, versions, backend, packs, machine (`RunRecord`)
    episodes.jsonl      one `Outcome` per line, in any order; an incomplete last line is dropped

Partial results of one evaluation, such as shards, are read (`read_result`) or written (`merge_results`) as one result.
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
from robocas_ms3.core.files import atomic_folder, write_json
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.core.output_folder import FolderKind, OutputFolder, check_replaceable, list_setting_changes
from robocas_ms3.core.strict_model import parse
from robocas_ms3.evaluation.outcomes import Outcome
from robocas_ms3.evaluation.statistics import SuccessRate, success_rate

RUN, OUTCOMES = "run.json", "episodes.jsonl"
_PACKAGES = ("robocas_ms3", "mani_skill", "sapien", "gymnasium", "numpy", "torch")
_NO_RESULT = "invalid evaluation result"


class PolicyRecord(BaseModel):
    """The policy of a result. The policy may add entries (`policy.describe_policy`).

    Attributes:
        name: name of the policy as given by the user.
        spec: specification of the policy, `PolicySpec`.
        server: description by the policy server, if any.
    """

    model_config = ConfigDict(strict=True, extra="allow")

    name: str
    spec: dict[str, Any] = {}
    server: dict[str, Any] | None = None


class MergedFolder(BaseModel):
    """A folder that was merged into a result."""

    model_config = ConfigDict(strict=True)

    folder: str
    episodes: int
    machine: dict[str, Any] | None = None


class RunRecord(BaseModel):
    """Settings of a result: ``run.json``.

    Attributes:
        played_as: tasks that were evaluated in the episodes of another task (`LoadedProtocol.played_as`).
        merged_from: folders of the partial results, if the result was merged.
    """

    model_config = ConfigDict(strict=True, extra="allow")

    protocol: str
    protocol_hash: str
    policy: PolicyRecord
    weld: bool = False
    played_as: dict[str, str] = {}
    backend: str
    versions: dict[str, str]
    pack_hashes: dict[str, str]
    machine: dict[str, Any] | None = None
    merged_from: list[MergedFolder] = []

    @classmethod
    def from_values(cls, values: dict[str, Any], where: object) -> RunRecord:
        """Return the validated record of some values; ``where`` is for error messages."""
        return parse(cls, values, EvaluationError, where=where, about="invalid record of the evaluation")

    def to_dict(self) -> dict[str, Any]:
        """Return the values that were set, for ``run.json``."""
        return self.model_dump(exclude_unset=True)

    def identity(self) -> dict[str, Any]:
        """Return the values that are equal in partial results of one evaluation.

        A policy server is identified by its policy, not by its address.
        """
        policy = self.policy.model_dump(exclude_unset=True)
        if self.policy.server and self.policy.name.startswith(("ws://", "wss://")):
            del policy["name"]
        names = ("protocol", "protocol_hash", "weld", "played_as", "backend", "versions", "pack_hashes")
        return {"policy": policy, **{name: getattr(self, name) for name in names}}

    def settings(self) -> dict[str, Any]:
        """Return the values that must be equal to continue a result."""
        return {**self.identity(), "machine": self.machine}


def _recorded_settings(values: dict[str, Any]) -> dict[str, Any]:
    return parse(RunRecord, values, EvaluationError, where=RUN, about=_NO_RESULT).settings()


OUTPUT = FolderKind("robocas eval", (RUN,), "protocol_hash", upgrade=_recorded_settings)


@dataclass(frozen=True)
class Result:
    """A result in memory.

    Attributes:
        folder: folder of the result, or of the first partial result.
        run: settings of the result; for several partial results, the record of the first with ``merged_from``.
        outcomes: outcomes by episode number, in ascending order.
    """

    folder: Path
    run: RunRecord
    outcomes: dict[int, Outcome]

    def rate(self, name: str = "success", outcomes: Iterable[Outcome] | None = None) -> SuccessRate:
        """Return the success rate of a flag: the episodes in which it held at some step.

        ``outcomes``: at least one outcome; None: all of the result.
        """
        chosen = list(self.outcomes.values() if outcomes is None else outcomes)
        held = [getattr(one, name) if hasattr(one, name) else one.flags.get(name) is not None for one in chosen]
        return success_rate(sum(held), len(held))

    def repeats_scenes(self) -> bool:
        """Return whether episodes share scenes, such as splits do; such episodes must not be pooled."""
        return len({(one.task, one.seed) for one in self.outcomes.values()}) < len(self.outcomes)

    def error_count(self) -> int:
        """Return the number of episodes that an error ended."""
        return sum(bool(one.error) for one in self.outcomes.values())

    def group_by(self, name: str) -> dict[str, list[Outcome]]:
        """Return the outcomes by an attribute such as ``config``, sorted; splits in the order of the protocol."""
        found: dict[str, list[Outcome]] = {}
        for outcome in self.outcomes.values():
            found.setdefault(getattr(outcome, name), []).append(outcome)
        return found if name == "split" else dict(sorted(found.items()))


@contextmanager
def open_result(
    folder: Path, run: RunRecord, *, overwrite: bool = False, retry_errors: bool = False
) -> Iterator[dict[int, Outcome]]:
    """Lock a result folder, start or continue the result, and yield its outcomes by episode number.

    With ``retry_errors`` the outcomes of episodes that an error ended are dropped, so that these episodes run again.

    Raises:
        OutputExistsError: the result has other settings, or the folder holds no result.
        RobocasError: another process writes to the folder, or the folder was removed.
    """
    with OutputFolder(folder, OUTPUT, run.settings(), overwrite=overwrite) as output:
        output.start(output.recorded or run.to_dict())
        outcomes = _outcomes(folder)
        if retry_errors and any(one.error for one in outcomes.values()):
            outcomes = {number: one for number, one in outcomes.items() if not one.error}
            _ledger(folder).rewrite(outcomes.values())
        yield outcomes


def append_outcome(folder: Path, outcome: Outcome) -> None:
    """Append an outcome and flush it to disk."""
    _ledger(folder).append([outcome], sync=True)


def read_result(*folders: Path) -> Result:
    """Read a result, or partial results of one evaluation.

    Partial results may have common episodes if their outcomes are equal.

    Raises:
        EvaluationError: a result is invalid, or the partial results have other settings or contradict each other.
    """
    parts = [_read(folder) for folder in folders]
    first, outcomes = parts[0], dict[int, Outcome]()
    for part in parts:
        expected, found = first.run.identity(), part.run.identity()
        if key := next((key for key in found if expected[key] != found[key]), ""):
            changes = "; ".join(list_setting_changes(expected[key], found[key], key))
            raise EvaluationError(
                f"not a partial result of the same evaluation as {first.folder}: different {key}",
                where=part.folder,
                found=changes,
            )
        for outcome in part.outcomes.values():
            _add(outcomes, outcome, str(part.folder))
    run = first.run
    if len(parts) > 1:
        records = [
            MergedFolder(folder=str(part.folder), episodes=len(part.outcomes), machine=part.run.machine)
            for part in parts
        ]
        run = run.model_copy(update={"merged_from": records})
    return Result(first.folder, run, dict(sorted(outcomes.items())))


def group_partial_results(folders: Iterable[Path]) -> list[list[Path]]:
    """Group folders into partial results of one evaluation: same settings and disjoint episodes."""
    groups: list[tuple[dict[str, Any], set[int], list[Path]]] = []
    for folder in folders:
        part = _read(folder)
        key = part.run.identity()
        for other, episodes, group in groups:
            if other == key and not episodes & part.outcomes.keys():
                group.append(folder)
                episodes.update(part.outcomes)
                break
        else:
            groups.append((key, set(part.outcomes), [folder]))
    return [group for _, _, group in groups]


def merge_results(folders: Sequence[Path], out: Path) -> Result:
    """Merge partial results into one result folder, which is written atomically."""
    result = read_result(*folders)
    check_replaceable(out)
    with atomic_folder(out) as folder:
        write_json(folder / RUN, result.run.to_dict())
        _ledger(folder).rewrite(result.outcomes.values())
    return read_result(out)


def package_versions() -> dict[str, str]:
    """Return the installed versions of the packages that can change a result."""
    return {name: version(name) for name in _PACKAGES}


def _ledger(folder: Path) -> JsonLinesFile[Outcome]:
    return JsonLinesFile(folder / OUTCOMES, Outcome)


def _read(folder: Path) -> Result:
    try:
        record = load_json(folder / RUN)
        run = parse(RunRecord, record, EvaluationError, where=folder / RUN, about=_NO_RESULT)
        return Result(folder, run, dict(sorted(_outcomes(folder).items())))
    except (OSError, ValueError) as error:
        fix = "" if (folder / RUN).exists() else "Pass the --out folder of robocas eval."
        raise EvaluationError(_NO_RESULT, where=folder, found=error, fix=fix) from error


def _outcomes(folder: Path) -> dict[int, Outcome]:
    """Return the outcomes of a result; another process may be writing it."""
    ledger, found = _ledger(folder), dict[int, Outcome]()
    for line in ledger.lines():
        if line.record is not None:
            _add(found, line.record, f"{ledger.path}:{line.number}")
        elif not line.cut_off:
            raise ledger.line_error(line, EvaluationError, "invalid outcome of an episode") from line.problem
    return found


def _add(outcomes: dict[int, Outcome], outcome: Outcome, where: str) -> None:
    """Add an outcome; an existing outcome of the episode must be equal."""
    before = outcomes.setdefault(outcome.episode, outcome).reproducible_values()
    now = outcome.reproducible_values()
    if changes := [change for key in now for change in list_setting_changes(before[key], now[key], key)]:
        what = f"contradicting outcomes of episode {outcome.episode}"
        raise EvaluationError(what, where=where, found="; ".join(changes))
