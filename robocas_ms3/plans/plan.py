"""A plan: what a dataset is made of, read from YAML."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from robocas_ms3.assets.pack import MANIFEST, pack_folders, sha256
from robocas_ms3.core.documents import DocumentError, load_yaml
from robocas_ms3.core.errors import PlanError, RobocasError
from robocas_ms3.core.paths import plans_dir
from robocas_ms3.core.strict import StrictModel, nearest, parse
from robocas_ms3.datasets.lerobot.variants import NEWEST, Version
from robocas_ms3.demos.recordings.seeds import GREATEST_SEED
from robocas_ms3.plans.settings import LimitsConfig, PartConfig, PicturesConfig, RecordingConfig, SplitConfig
from robocas_ms3.scenes.config import load_config_of, shipped_configs
from robocas_ms3.scenes.task_specs import TASKS

Stage = Literal["layouts", "demonstrations", "datasets", "statistics"]
_ALWAYS = "builtin"  # the pack of the furniture
_NEEDS = {"datasets": "demonstrations", "statistics": "datasets"}


class Plan(StrictModel):
    """One plan: a file of ``plans/``."""

    description: str = ""
    parts: Annotated[list[PartConfig], Field(min_length=1)]
    stages: Annotated[list[Stage], Field(min_length=1)] = ["demonstrations", "datasets", "statistics"]
    formats: list[Literal["robocas", "lerobot"]] = ["robocas"]
    lerobot_version: Version = Field(default=NEWEST, description="of the LeRobot dataset, as `robocas convert` has it")
    recording: RecordingConfig = RecordingConfig()
    pictures: PicturesConfig = PicturesConfig()
    rate: Annotated[float, Field(gt=0, le=100)] = Field(default=5.0, description="steps of a dataset a second")
    control_freq: Annotated[int, Field(ge=1, le=100)] = 20
    embeddings: bool = True
    split: SplitConfig | None = Field(default=None, description="default: as `robocas convert` has it, 90 : 10 by seed")
    block: Annotated[int, Field(ge=1, le=1000)] = Field(default=10, description="seeds of a unit of work")
    limits: LimitsConfig = LimitsConfig()
    packs: dict[str, str] = Field(default={}, description="pack -> sha256 of its manifest, as they were on loading")

    @field_validator("formats")
    @classmethod
    def _robocas_first(cls, formats: list[str]) -> list[str]:
        if formats[:1] != ["robocas"]:
            raise ValueError("robocas comes first: other formats are made of it")
        return formats

    @model_validator(mode="after")
    def _stages_fit(self) -> Plan:
        for stage in self.stages:
            if _NEEDS.get(stage, stage) not in self.stages:
                raise ValueError(f"stages: {stage} needs {_NEEDS[stage]}")
        if "lerobot" in self.formats and not self.makes_datasets:
            raise ValueError("formats: lerobot needs the stage datasets")
        free = {part.task for part in self.parts if part.split is None}
        if self.split and self.split.by == "task" and len(free) < 2:
            raise ValueError("split: by task needs parts of two tasks that name no side")
        return self

    @property
    def makes_layouts(self) -> bool:
        """Whether layouts are kept."""
        return "layouts" in self.stages

    @property
    def makes_demonstrations(self) -> bool:
        """Whether episodes are recorded."""
        return "demonstrations" in self.stages

    @property
    def makes_datasets(self) -> bool:
        """Whether episodes are rendered."""
        return "datasets" in self.stages

    def block_of(self, part: int) -> int:
        """Seeds of a part's units: no more than it has episodes, since what is beyond them is made for nothing."""
        return min(self.block, self.parts[part].episodes)

    def first_episode(self, part: int) -> int:
        """Number of a part's first episode in the dataset."""
        return sum(one.episodes for one in self.parts[:part])


def shipped_plans() -> dict[str, Path]:
    """Name -> file of the plans that travel with the package."""
    return {path.stem: path for path in sorted(plans_dir().glob("*.yaml"))}


def load_plan(plan: str | Path) -> Plan:
    """Read a plan; its parts get their configurations and names.

    Args:
        plan: name of a shipped one, or a YAML file.

    Raises:
        PlanError: there is none, or a key or value is wrong.
        ConfigError: so is a configuration.
    """
    path = _find(plan)
    try:
        data = load_yaml(path)
    except (OSError, DocumentError) as error:
        raise PlanError("this plan can't be read", where=path, found=error) from error
    loaded = parse(Plan, data, PlanError, where=path, about="not a valid plan")
    try:
        loaded.pictures.chosen()
    except RobocasError as error:
        raise PlanError("not a valid plan: pictures", where=path, found=error) from error
    parts, scenes = [], []
    for number, part in enumerate(loaded.parts):
        if part.task not in TASKS:
            where, expected, fix = f"{path}, parts.{number}", ", ".join(TASKS), nearest(part.task, list(TASKS))
            raise PlanError("no such task", where=where, expected=expected, found=repr(part.task), fix=fix)
        spec = TASKS[part.task]
        name, config = part.config or spec.default_config, part.config or spec.default_config
        if isinstance(config, str) and (path.parent / config).is_file():
            config = path.parent / config
        loaded_config = load_config_of(spec, config)
        scenes.append((part.task, loaded_config, pack := _pack(part.pack, path.parent)))
        shipped = isinstance(config, str) and config in shipped_configs()  # a file may be another by the next run
        stem = Path(name).stem if isinstance(name, str) else part.task
        parts.append(
            part.model_copy(
                update={
                    "config": name if shipped else loaded_config.model_dump(mode="json"),
                    "pack": pack,
                    "name": part.name or re.sub(r"[^\w-]+", "-", f"{number:02d}-{stem}")[:60],
                }
            )
        )
    _check_names(parts, path)
    _check_seeds(parts, scenes, loaded.block, path)
    found = {pack: digest for pack in sorted({_ALWAYS, *(part.pack for part in parts)}) if (digest := _digest(pack))}
    check_packs(loaded, found)
    return loaded.model_copy(update={"parts": parts, "packs": found})


def most_seeds(episodes: int, block: int) -> int:
    """So many seeds a part of so many episodes may try before it ends for having too few."""
    return episodes + max(20, 3 * episodes) + 2 * block  # the last ones are done whole


def _pack(named: str, folder: Path) -> str:
    """A pack's name, or the whole path of its folder, which may be named from where the plan lies, or from here."""
    if named in pack_folders():
        return named
    return next((str(path.resolve()) for path in (folder / named, Path(named)) if path.is_dir()), named)


def check_packs(plan: Plan, packs: str | Iterable[str]) -> None:
    """See that packs are those that a plan was loaded with, as far as it says; the furniture's is among them.

    Args:
        plan: it.
        packs: names or folders, or one of them.

    Raises:
        PlanError: one has changed, or is another on this machine.
    """
    for pack in {_ALWAYS, *([packs] if isinstance(packs, str) else packs)}:
        expected, found = plan.packs.get(pack), _digest(pack)
        if expected and found and found != expected:
            what, fix = "this pack is not the one that the plan was begun with", "Use that one, or begin again."
            said, is_now = f"a manifest of sha256 {expected[:12]}...", f"{found[:12]}..."
            raise PlanError(what, where=pack, expected=said, found=is_now, fix=fix)


def _digest(pack: str) -> str:
    """Of a pack's manifest, which has those of its files; empty where there is no such pack."""
    path = pack_folders().get(pack, Path(pack)) / MANIFEST
    return sha256(path) if path.is_file() else ""


def _check_names(parts: Sequence[PartConfig], path: Path) -> None:
    names = [part.name for part in parts]
    twice = sorted({str(name) for name in names if names.count(name) > 1})
    if twice:
        raise PlanError("no plan: parts of one name", where=path, found=", ".join(twice), fix="Give them a name each.")


def _check_seeds(parts: Sequence[PartConfig], scenes: Sequence[Any], block: int, path: Path) -> None:
    """See that no seed of a scene is tried by two parts: a dataset has no episode twice."""
    for number, part in enumerate(parts):
        if part.seed + most_seeds(part.episodes, block) > GREATEST_SEED:
            where, expected = f"{path}, parts.{number}.seed", f"<= {GREATEST_SEED - most_seeds(part.episodes, block)}"
            raise PlanError(f"no plan: seeds end at {GREATEST_SEED}", where=where, expected=expected, found=part.seed)
        for other, scene in zip(parts[:number], scenes, strict=False):
            first, last = sorted((part, other), key=lambda one: one.seed)
            apart = first.seed + most_seeds(first.episodes, block)
            if scenes[number] == scene and last.seed < apart:
                where, expected = f"{path}, parts.{number}.seed", f"one of the two from {apart} on"
                found = f"{part.seed}, and {other.seed} of {other.name}"
                raise PlanError(
                    "no plan: two parts may try the same seeds", where=where, expected=expected, found=found
                )


def _find(plan: str | Path) -> Path:
    shipped, path = shipped_plans(), Path(plan)
    if str(plan) in shipped:
        return shipped[str(plan)]
    if path.suffix in {".yaml", ".yml"} and path.is_file():
        return path
    likely = nearest(str(plan), shipped)
    expected = f"a YAML file, or one of {', '.join(shipped)}"
    raise PlanError("no such plan", where=plan, expected=expected, fix=likely)
