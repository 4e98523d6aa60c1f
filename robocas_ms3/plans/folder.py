"""The output folder of a plan: `plan.json`, and the files of its work units.

`units/PART/BLOCK/SEED/` has the episode of a seed and `outcome.json`. Its files are written to a temporary folder,
which is renamed when they are complete. So two workers may run the same work unit, even at the same time: the first
folder of a seed is kept, and a second one would have the same content. `seeds.jsonl` has the outcomes of a complete
work unit, one per line.
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
from robocas_ms3.demos.recordings.trajectory_json import package_versions
from robocas_ms3.plans.plan import Plan
from robocas_ms3.robots.cameras import STANDARD_CAMERA_NAMES

PLAN, REPORT, UNITS = "plan.json", "report.json", "units"
LAYOUTS, DEMOS, DATASETS, STATISTICS = "layouts", "demos", "datasets", "statistics"
OUTCOME, OUTCOMES = "outcome.json", "seeds.jsonl"
CHANGEABLE_KEYS = frozenset({"description", "limits"})
"""Keys of a plan that may change between runs, because no episode depends on them."""
Count = Annotated[int, Field(ge=0, le=10**15)]
Seconds = Annotated[float, Field(ge=0, le=1e12)]


@dataclass(frozen=True)
class Outcome:
    """Outcome of a seed."""

    seed: Annotated[int, Field(ge=0, le=MAX_SEED)]
    success: bool  # whether the seed has an episode
    steps: Count = 0  # control steps of the episode
    failures: list[str] = field(default_factory=list)  # "stage: reason" of each failed attempt
    crashes: list[str] = field(default_factory=list)  # "stage: reason" of each process that crashed or exceeded a limit
    record_seconds: Seconds = 0.0  # CPU time of the process that recorded the episode
    render_seconds: Seconds = 0.0  # CPU time of the process that rendered the episode
    size: Count = 0  # bytes of the files without `outcome.json`
    end_time: Seconds = 0.0  # Unix time, by the clock of the machine


_OUTCOME: TypeAdapter[Outcome] = TypeAdapter(Outcome)


@dataclass(frozen=True)
class SeedFiles:
    """Paths of the files of one seed of a part."""

    part: int
    seed: int
    folder: Path

    @property
    def layout(self) -> Path:
        """Layout file of the stage `layouts`."""
        return self.folder / "layout.npy"

    @property
    def recording(self) -> Path:
        """HDF5 file of the recorded episode; its JSON file is next to it."""
        return self.folder / "recording.h5"

    @property
    def episode(self) -> Path:
        """Folder of the rendered episode."""
        return self.folder / episode_folder(0)

    def size(self) -> int:
        """Return the size of all files without the outcome, bytes."""
        return sum(path.stat().st_size for path in self.folder.rglob("*") if path.is_file() and path.name != OUTCOME)

    def outcome(self) -> Outcome | None:
        """Read the outcome; return None if the seed is not complete or the file is damaged."""
        with suppress(OSError, DocumentError, ValidationError):
            return validate_json(_OUTCOME, read_bytes(self.folder / OUTCOME, JSON_LIMIT))

    def write(self, outcome: Outcome) -> None:
        """Write the outcome."""
        (self.folder / OUTCOME).write_bytes(_OUTCOME.dump_json(outcome))

    @contextmanager
    def temporary_files(self) -> Iterator[SeedFiles]:
        """Yield files in a temporary folder, which is renamed to this folder at the end unless this folder exists."""
        tmp = make_folder(self.folder.with_name(f".{self.folder.name}.{secrets.token_hex(8)}.tmp"))
        try:
            yield SeedFiles(self.part, self.seed, tmp)
            flush_to_disk(tmp)  # after a power cut, a folder with this name has complete files
            if self.folder.is_dir() and self.outcome() is None:
                shutil.rmtree(self.folder)  # damaged by a disk error
            try:
                tmp.rename(self.folder)
            except OSError:
                if self.outcome() is None:
                    raise
        finally:
            shutil.rmtree(tmp, ignore_errors=True)


@dataclass(frozen=True, order=True)
class WorkUnit:
    """A block of consecutive seeds of a part, which one worker runs."""

    part: int
    block: int

    def seeds(self, plan: Plan) -> range:
        """Return the seeds of the unit."""
        size = plan.block_of(self.part)
        first = plan.parts[self.part].seed + self.block * size
        return range(first, first + size)


def _settings_of(record: dict[str, Any]) -> dict[str, Any]:
    """Return the part of the content of `plan.json` that may not change between runs."""
    plan = record["plan"]
    if isinstance(plan, dict):
        plan = {key: value for key, value in plan.items() if key not in CHANGEABLE_KEYS}
        images = plan.get("images")
        if isinstance(images, dict) and images.get("cameras") is None:  # written by an older version
            plan["images"] = {**images, "cameras": list(STANDARD_CAMERA_NAMES)}
    return {**record, "plan": plan}


_KIND = FolderKind("robocas plan run", (PLAN,), "plan", upgrade=_settings_of)


@dataclass(frozen=True)
class PlanFolder:
    """The output folder of a plan."""

    plan: Plan
    path: Path

    def record(self) -> dict[str, Any]:
        """Return the content of ``plan.json``: the plan and the versions of the packages."""
        return {"plan": self.plan.model_dump(mode="json"), "versions": package_versions()}

    def open(self, *, overwrite: bool = False, shared: bool = False) -> OutputFolder:
        """Return a context manager that checks that the folder belongs to this plan and these versions."""
        return OutputFolder(self.path, _KIND, _settings_of(self.record()), overwrite=overwrite, shared=shared)

    def unit_folder(self, unit: WorkUnit) -> Path:
        """Return the folder of a work unit."""
        return self.path / UNITS / self.plan.name_of(unit.part) / f"{unit.block:05d}"

    def files(self, unit: WorkUnit, seed: int) -> SeedFiles:
        """Return the files of a seed of a work unit."""
        return SeedFiles(unit.part, seed, self.unit_folder(unit) / f"{seed:010d}")

    def started_units(self) -> list[WorkUnit]:
        """Return the work units that have a folder, in order."""
        units: list[WorkUnit] = []
        for part in range(len(self.plan.parts)):
            with suppress(FileNotFoundError):  # listing is up to date on NFS; a test of existence may be cached
                names = os.listdir(self.path / UNITS / self.plan.name_of(part))
                units += sorted(WorkUnit(part, int(name)) for name in names if name.isascii() and name.isdecimal())
        return units

    def outcomes(self, unit: WorkUnit) -> list[Outcome] | None:
        """Read the outcomes of all seeds of a work unit, in order; return None if the unit is not complete."""
        found: dict[int, Outcome] = {}
        with suppress(OSError, DocumentError):
            found = {outcome.seed: outcome for outcome in self._outcome_lines(unit).read()}
        seeds = unit.seeds(self.plan)
        return [found[seed] for seed in seeds] if found.keys() >= set(seeds) else None

    def partial_outcomes(self, unit: WorkUnit) -> list[Outcome]:
        """Read the outcomes of the completed seeds of a work unit, in order."""
        found = (self.files(unit, seed).outcome() for seed in unit.seeds(self.plan))
        return [outcome for outcome in found if outcome is not None]

    def write_outcomes(self, unit: WorkUnit) -> None:
        """Write ``seeds.jsonl`` of a work unit if all its seeds are complete."""
        outcomes = self.partial_outcomes(unit)
        if len(outcomes) == len(unit.seeds(self.plan)):
            self._outcome_lines(unit).rewrite(outcomes)

    def delete_seeds(self, unit: WorkUnit, seeds: Collection[int]) -> None:
        """Delete seeds of a work unit, so that they run again."""
        self._outcome_lines(unit).path.unlink(missing_ok=True)
        for seed in seeds:
            shutil.rmtree(self.files(unit, seed).folder, ignore_errors=True)

    def _outcome_lines(self, unit: WorkUnit) -> JsonLinesFile[Outcome]:
        return JsonLinesFile(self.unit_folder(unit) / OUTCOMES, Outcome)


def read_plan(out: Path) -> PlanFolder:
    """Read the plan of an output folder; raise PlanError if the folder has no plan."""
    path = out / PLAN
    try:
        record = load_json(path)
    except (OSError, DocumentError) as error:
        if isinstance(error, FileNotFoundError | NotADirectoryError):
            found = "no plan.json" if out.is_dir() else "no such folder"
            fix = "Pass the --out folder of robocas plan run."
            raise PlanError("not the output folder of a plan", where=out, found=found, fix=fix) from error
        found = error.strerror if isinstance(error, OSError) else error
        raise PlanError("cannot read this plan", where=path, found=found) from error
    plan = record.get("plan") if isinstance(record, dict) else None
    return PlanFolder(parse(Plan, plan, PlanError, where=path, about="invalid plan"), out)
