"""The output folder of a plan: `plan.json`, and the files of its work units.

`units/PART/BLOCK/SEED/` has the episode of a seed and `outcome.json`. Its files are written into a temporary folder,
which is renamed when they are complete. So a unit may be done twice, even at the same time: the first folder of a seed
is kept, and another one has the same content. `seeds.jsonl` has the outcomes of a complete unit, a line each.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError

from robocas_ms3.core.checks import MAX_SEED
from robocas_ms3.core.documents import JSON_LIMIT, DocumentError, load_json, read_bytes
from robocas_ms3.core.errors import PlanError
from robocas_ms3.core.files import flush_to_disk, make_folder
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.core.output_folder import FolderKind, OutputFolder
from robocas_ms3.core.strict_model import parse, validate_json
from robocas_ms3.datasets.schema import episode_folder
from robocas_ms3.demos.recordings.trajectory_json import versions
from robocas_ms3.plans.plan import Plan
from robocas_ms3.robots.cameras import STANDARD_CAMERA_NAMES

PLAN, REPORT, UNITS = "plan.json", "report.json", "units"
LAYOUTS, DEMOS, DATASETS, STATISTICS = "layouts", "demos", "datasets", "statistics"
OUTCOME, OUTCOMES = "outcome.json", "seeds.jsonl"
FREE = frozenset({"description", "limits"})
"""Keys of a plan that may change between runs: no episode depends on them."""
Count = Annotated[int, Field(ge=0, le=10**15)]
Seconds = Annotated[float, Field(ge=0, le=1e12)]


@dataclass(frozen=True)
class Outcome:
    """Outcome of a seed."""

    seed: Annotated[int, Field(ge=0, le=MAX_SEED)]
    success: bool  # whether there is an episode
    steps: Count = 0  # control steps of the episode
    failures: list[str] = field(default_factory=list)  # "stage: reason" of each attempt that failed
    crashes: list[str] = field(default_factory=list)  # of each process that died, or was killed for a limit
    record_seconds: Seconds = 0.0  # CPU time, of the processes that made the episode
    render_seconds: Seconds = 0.0
    size: Count = 0  # bytes of the files, without `outcome.json`
    end_time: Seconds = 0.0  # end of the seed since 1970, by the clock of the machine


_OUTCOME: TypeAdapter[Outcome] = TypeAdapter(Outcome)


@dataclass(frozen=True)
class SeedFiles:
    """Files of one seed of a part, in a folder."""

    part: int
    seed: int
    folder: Path

    @property
    def layout(self) -> Path:
        return self.folder / "layout.npy"

    @property
    def recording(self) -> Path:
        """File of its recorded episode; a JSON file is next to it."""
        return self.folder / "recording.h5"

    @property
    def episode(self) -> Path:
        """Folder of its rendered episode."""
        return self.folder / episode_folder(0)

    def size(self) -> int:
        """Return the bytes of all files but the outcome."""
        return sum(path.stat().st_size for path in self.folder.rglob("*") if path.is_file() and path.name != OUTCOME)

    def outcome(self) -> Outcome | None:
        """Read the outcome; None: the seed is not done, or its file is damaged."""
        with suppress(OSError, DocumentError, ValidationError):
            return validate_json(_OUTCOME, read_bytes(self.folder / OUTCOME, JSON_LIMIT))

    def write(self, outcome: Outcome) -> None:
        (self.folder / OUTCOME).write_bytes(_OUTCOME.dump_json(outcome))

    @contextmanager
    def temporary(self) -> Iterator[SeedFiles]:
        """Yield files in a temporary folder; on success it is renamed to this folder, unless that exists already."""
        tmp = make_folder(self.folder.with_name(f".{self.folder.name}.{secrets.token_hex(8)}.tmp"))
        try:
            yield SeedFiles(self.part, self.seed, tmp)
            flush_to_disk(tmp)  # a folder that survives a power cut has complete files
            if self.folder.is_dir() and self.outcome() is None:
                shutil.rmtree(self.folder)  # a disk error has damaged it
            try:
                tmp.rename(self.folder)
            except OSError:
                if self.outcome() is None:
                    raise
        finally:
            shutil.rmtree(tmp, ignore_errors=True)


@dataclass(frozen=True, order=True)
class WorkUnit:
    """A work unit: a block of a part's seeds."""

    part: int
    block: int

    def seeds(self, plan: Plan) -> range:
        size = plan.block_of(self.part)
        first = plan.parts[self.part].seed + self.block * size
        return range(first, first + size)


def _settings_of(record: dict[str, Any]) -> dict[str, Any]:
    """Return what must not change of the content of `plan.json`."""
    plan = record["plan"]
    if isinstance(plan, dict):
        plan = {key: value for key, value in plan.items() if key not in FREE}
        images = plan.get("images")
        if isinstance(images, dict) and images.get("cameras") is None:  # of an older version
            plan["images"] = {**images, "cameras": list(STANDARD_CAMERA_NAMES)}
    return {**record, "plan": plan}


_KIND = FolderKind("robocas plan run", (PLAN,), "plan", upgrade=_settings_of)


@dataclass(frozen=True)
class PlanFolder:
    """The output folder of a plan."""

    plan: Plan
    path: Path

    def record(self) -> dict[str, Any]:
        """Return the content of ``plan.json``: the plan, and the versions that it is started with."""
        return {"plan": self.plan.model_dump(mode="json"), "versions": versions()}

    def open(self, *, overwrite: bool = False, shared: bool = False) -> OutputFolder:
        """Return the folder to be entered, which checks that it was started with this plan and these versions."""
        return OutputFolder(self.path, _KIND, _settings_of(self.record()), overwrite=overwrite, shared=shared)

    def unit_folder(self, unit: WorkUnit) -> Path:
        return self.path / UNITS / self.plan.name_of(unit.part) / f"{unit.block:05d}"

    def files(self, unit: WorkUnit, seed: int) -> SeedFiles:
        return SeedFiles(unit.part, seed, self.unit_folder(unit) / f"{seed:010d}")

    def started_units(self) -> list[WorkUnit]:
        """Return the units that have a folder, in order."""
        units: list[WorkUnit] = []
        for part in range(len(self.plan.parts)):
            with suppress(FileNotFoundError):  # listing asks an NFS server; whether a file exists may not
                names = os.listdir(self.path / UNITS / self.plan.name_of(part))
                units += sorted(WorkUnit(part, int(name)) for name in names if name.isascii() and name.isdecimal())
        return units

    def outcomes(self, unit: WorkUnit) -> list[Outcome] | None:
        """Read the outcomes of all seeds of a unit, in order; None: it is not complete."""
        found: dict[int, Outcome] = {}
        with suppress(OSError, DocumentError):
            found = {outcome.seed: outcome for outcome in self._outcome_lines(unit).read()}
        seeds = unit.seeds(self.plan)
        return [found[seed] for seed in seeds] if found.keys() >= set(seeds) else None

    def partial_outcomes(self, unit: WorkUnit) -> list[Outcome]:
        """Read the outcomes of the seeds that are done of a unit that is not complete."""
        found = (self.files(unit, seed).outcome() for seed in unit.seeds(self.plan))
        return [outcome for outcome in found if outcome is not None]

    def complete(self, unit: WorkUnit) -> None:
        """Write ``seeds.jsonl`` of a unit, once all seeds are done."""
        outcomes = self.partial_outcomes(unit)
        if len(outcomes) == len(unit.seeds(self.plan)):
            self._outcome_lines(unit).rewrite(outcomes)

    def forget(self, unit: WorkUnit, seeds: Collection[int]) -> None:
        """Delete some seeds of a unit, which are then done again."""
        self._outcome_lines(unit).path.unlink(missing_ok=True)
        for seed in seeds:
            shutil.rmtree(self.files(unit, seed).folder, ignore_errors=True)

    def _outcome_lines(self, unit: WorkUnit) -> JsonLinesFile[Outcome]:
        return JsonLinesFile(self.unit_folder(unit) / OUTCOMES, Outcome)


def read_plan(out: Path) -> PlanFolder:
    """Read the plan that a folder was started with; raise PlanError if there is none."""
    path = out / PLAN
    try:
        record = load_json(path)
    except (OSError, DocumentError) as error:
        found = error.strerror if isinstance(error, OSError) else error
        raise PlanError("no plan was started here", where=path, found=found) from error
    plan = record.get("plan") if isinstance(record, dict) else None
    return PlanFolder(parse(Plan, plan, PlanError, where=path, about="not a valid plan"), out)
