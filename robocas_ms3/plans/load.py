"""Read plans from YAML files, and check them before a run starts."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

from robocas_ms3.assets.pack import MANIFEST, find_packs, sha256
from robocas_ms3.core.checks import MAX_SEED
from robocas_ms3.core.documents import DocumentError, load_yaml
from robocas_ms3.core.errors import DatasetError, MissingExtraError, PlanError, RobocasError, require_extra
from robocas_ms3.core.paths import plans_dir
from robocas_ms3.core.strict_model import parse
from robocas_ms3.core.text import did_you_mean, format_error
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.plans.plan import PartConfig, Plan
from robocas_ms3.robots.registry import find_robot
from robocas_ms3.scenes.config import TaskConfig, bundled_configs, load_config_for
from robocas_ms3.scenes.task_specs import SIM_FREQ, TASKS

_FURNITURE_PACK = "builtin"


def bundled_plans() -> dict[str, Path]:
    """Return the YAML files of the bundled plans by name."""
    return {path.stem: path for path in sorted(plans_dir().glob("*.yaml"))}


def load_plan(plan: str | Path) -> Plan:
    """Read a plan, and fill in the configuration and name of each plan part, the cameras and the pack hashes.

    Args:
        plan: name of a bundled plan, or a YAML file.

    Raises:
        PlanError: the plan does not exist, or a key or value is invalid.
        ConfigError: a configuration is invalid.
    """
    bundled, path = bundled_plans(), Path(plan)
    if str(plan) in bundled:
        path = bundled[str(plan)]
    elif path.suffix not in {".yaml", ".yml"} or not path.is_file():
        expected, fix = f"a YAML file, or one of {', '.join(bundled)}", did_you_mean(str(plan), bundled)
        raise PlanError("no such plan", where=plan, expected=expected, fix=fix, usage=True)
    try:
        data = load_yaml(path)
    except (OSError, DocumentError) as error:
        raise PlanError("cannot read this plan", where=path, expected="a YAML file", found=error) from error
    loaded = parse(Plan, data, PlanError, where=path, about="invalid plan")
    _check_rates(loaded, path)
    resolved = [_resolve_part(part, number, path) for number, part in enumerate(loaded.parts)]
    parts = [part for part, _ in resolved]
    names = [part.name or "" for part in parts]
    if duplicates := sorted({name for name in names if names.count(name) > 1}):
        what, fix = "two plan parts have the same name", "Set `name` of one of these parts."
        raise PlanError(what, where=f"{path}, parts", found=", ".join(duplicates), fix=fix)
    _check_seeds(parts, [scene for _, scene in resolved], loaded.block, path)
    cameras = _resolve_cameras(loaded, [config for _, (_, config, _) in resolved], path)
    images = loaded.images.model_copy(update={"cameras": cameras})
    packs = sorted({_FURNITURE_PACK, *(part.pack for part in parts)})
    found = {pack: digest for pack in packs if (digest := _manifest_hash(pack))}
    check_packs(loaded, found)
    return loaded.model_copy(update={"parts": parts, "packs": found, "images": images})


def max_seeds(episodes: int, block: int) -> int:
    """Return the largest number of seeds that a plan part can use before its run ends with too many failures.

    Args:
        episodes: number of episodes of the plan part.
        block: number of seeds per work unit; workers complete the work units that have started.
    """
    return episodes + max(20, 3 * episodes) + 2 * block


def check_packs(plan: Plan, packs: Iterable[str]) -> None:
    """Raise PlanError if one of these packs, or the furniture pack, has changed since the plan was loaded."""
    for pack in {_FURNITURE_PACK, *packs}:
        expected, found = plan.packs.get(pack), _manifest_hash(pack)
        if expected and found and found != expected:
            what, fix = "this pack has changed since the run was started", "Restore the pack, or pass --overwrite."
            hashes = f"a manifest with sha256 {expected[:12]}...", f"{found[:12]}..."
            raise PlanError(what, where=pack, expected=hashes[0], found=hashes[1], fix=fix)


def check_plan(plan: Plan) -> None:
    """Check that this machine can record, render and join a plan, before a run of days starts.

    Raises:
        RobocasError: a setting is invalid, or an extra, pack or planner is missing.
    """
    for number, part in enumerate(plan.parts):
        try:
            recording_settings(plan, number).check()
        except RobocasError as error:
            if not str(error.where).startswith("--"):
                raise
            # an option of `robocas generate` is a key of the plan here
            where = f"plan part {part.name}, {str(error.where)[2:].replace('-', '_')}"
            raise PlanError(
                error.what, where=where, expected=error.expected, found=error.found, fix=error.fix
            ) from error
    if "datasets" in plan.stages:
        if plan.embeddings:
            from robocas_ms3.scenes.language.embed import TextEmbedder

            TextEmbedder()  # checks the extra and the model without loading it
        if "lerobot" in plan.formats:
            from robocas_ms3.datasets.lerobot.schema import check_video_size, require_lerobot, to_integer_rate

            require_lerobot()
            to_integer_rate(plan.rate)
            check_video_size(plan.images.size)
    if "statistics" in plan.stages:
        require_extra("plots", "statistics", "matplotlib", fix="Or remove the stage `statistics`.")


def recording_settings(plan: Plan, part: int) -> EpisodeSettings:
    """Return the settings of `robocas generate` with which the episodes of a plan part are recorded."""
    config = plan.parts[part]
    assert config.config is not None  # set by `load_plan`
    rate = int(plan.rate) if plan.rate == int(plan.rate) else 5  # the open-loop check uses the rate of the dataset
    chosen = {"control_freq": plan.control_freq, **plan.recording.model_dump(exclude_none=True)}
    if not any(plan.recording.action_noise or ()):  # otherwise the default is no check
        chosen = {"check_rate": rate, **chosen}
    return EpisodeSettings(config.task, config.config, config.pack, **chosen)


@contextmanager
def convert_part_errors(plan: Plan, part: int) -> Iterator[None]:
    """Convert errors inside the context, which affect all seeds of a plan part, to PlanError.

    Raises:
        PlanError: the environment of the plan part cannot be opened on this machine, or its pack has changed.
        MissingExtraError: an extra is missing.
        OSError: an error of the disk or the system.
    """
    config = plan.parts[part]
    try:
        check_packs(plan, [config.pack])
        yield
    except (PlanError, MissingExtraError):
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno:
            raise
        what, fix = "cannot open the environment of this plan part", "Fix the error, then run the command again."
        raise PlanError(what, where=f"plan part {config.name}", found=format_error(error), fix=fix) from error


def _resolve_part(part: PartConfig, number: int, path: Path) -> tuple[PartConfig, Any]:
    """Fill in configuration, pack and name of a plan part.

    Returns:
        The plan part, and (task, configuration, pack), which determine its scenes.
    """
    if part.task not in TASKS:
        where, expected, fix = f"{path}, parts.{number}", ", ".join(TASKS), did_you_mean(part.task, list(TASKS))
        raise PlanError("unknown task", where=where, expected=expected, found=repr(part.task), fix=fix)
    spec = TASKS[part.task]
    name, config = part.config or spec.default_config, part.config or spec.default_config
    if isinstance(config, str) and (path.parent / config).is_file():
        config = path.parent / config
    loaded = load_config_for(spec, config)
    is_bundled = isinstance(config, str) and config in bundled_configs()  # else the content of the file is stored
    stem, pack = Path(name).stem if isinstance(name, str) else part.task, part.pack
    if pack not in find_packs():  # a folder, relative to the plan or to the working directory
        folders = [folder for folder in (path.parent / pack, Path(pack)) if folder.is_dir()]
        pack = str(folders[0].resolve()) if folders else pack
    values = {
        "config": name if is_bundled else loaded.model_dump(mode="json"),
        "pack": pack,
        "name": part.name or re.sub(r"[^\w-]+", "-", f"{number:02d}-{stem}")[:60],
    }
    return part.model_copy(update=values), (part.task, loaded, pack)


def _resolve_cameras(plan: Plan, configs: Sequence[TaskConfig], path: Path) -> list[str]:
    """Return the cameras of the dataset: `images.cameras`, or all cameras of the configurations."""
    robot, where = find_robot(plan.recording.robot).description, f"{path}, images.cameras"
    declared = [[camera.name for camera in config.cameras_of(robot)] for config in configs]
    common = [name for name in declared[0] if all(name in names for names in declared)]
    if not plan.images.cameras:
        if "datasets" in plan.stages and any(len(names) > len(common) for names in declared):
            only_some = ", ".join(sorted({*chain(*declared)} - {*common}))
            what, fix = "the plan parts have different cameras", f"Set cameras to some of {', '.join(common)}."
            raise PlanError(what, where=where, found=f"{only_some} in some plan parts only", fix=fix)
        return common
    if unknown := sorted({*plan.images.cameras} - {*common}):
        raise PlanError("unknown camera", where=where, expected=f"any of {', '.join(common)}", found=", ".join(unknown))
    return plan.images.cameras


def _check_rates(plan: Plan, path: Path) -> None:
    """Check that the control rate divides the physics rate, and that the dataset rate divides the control rate."""
    if SIM_FREQ % plan.control_freq:
        expected = f"a divisor of {SIM_FREQ}"
        what, where = "the control rate must divide the rate of physics", f"{path}, control_freq"
        raise PlanError(what, where=where, expected=expected, found=plan.control_freq)
    if "datasets" in plan.stages:
        from robocas_ms3.demos.recordings.motion import sample_stride

        try:
            sample_stride(plan.control_freq, plan.rate)
        except DatasetError as error:
            where = f"{path}, rate"
            raise PlanError(error.what, where=where, expected=error.expected, found=error.found) from error


def _manifest_hash(pack: str) -> str:
    """Return the sha256 of the manifest of a pack as hex digits, or "" if there is no such pack."""
    path = find_packs().get(pack, Path(pack)) / MANIFEST
    return sha256(path) if path.is_file() else ""


def _check_seeds(parts: Sequence[PartConfig], scenes: Sequence[Any], block: int, path: Path) -> None:
    """Check that two plan parts with equal scenes use different seeds, since episodes of a dataset are unique."""
    for number, part in enumerate(parts):
        where, count = f"{path}, parts.{number}.seed", max_seeds(part.episodes, block)
        if part.seed + count > MAX_SEED:
            expected = f"at most {MAX_SEED - count}"
            raise PlanError(
                "the seeds of this plan part may become too large", where=where, expected=expected, found=part.seed
            )
        for other, scene in zip(parts[:number], scenes, strict=False):
            first, last = sorted((part, other), key=lambda each: each.seed)
            end = first.seed + max_seeds(first.episodes, block)
            if scenes[number] == scene and last.seed < end:
                expected, found = (
                    f"one of the two at least {end}",
                    f"{part.seed}, and {other.seed} of plan part {other.name}",
                )
                raise PlanError("two plan parts may use the same seeds", where=where, expected=expected, found=found)
