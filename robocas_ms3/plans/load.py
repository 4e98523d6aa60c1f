"""Plans are read from YAML, and checked before any work begins."""

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
from robocas_ms3.core.errors import MissingExtraError, PlanError, require_extra
from robocas_ms3.core.paths import plans_dir
from robocas_ms3.core.strict_model import parse
from robocas_ms3.core.text import did_you_mean, format_error
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.plans.plan import PartConfig, Plan
from robocas_ms3.robots.registry import find_robot
from robocas_ms3.scenes.config import TaskConfig, bundled_configs, load_config_for
from robocas_ms3.scenes.task_specs import TASKS

_FURNITURE_PACK = "builtin"


def shipped_plans() -> dict[str, Path]:
    """Return name -> file of the bundled plans."""
    return {path.stem: path for path in sorted(plans_dir().glob("*.yaml"))}


def load_plan(plan: str | Path) -> Plan:
    """Read a plan, and complete its parts by their configurations, names and hashes of packs.

    Args:
        plan: name of a bundled plan, or a YAML file.

    Raises:
        PlanError: there is no such plan, or a key or value is invalid.
        ConfigError: a configuration is invalid.
    """
    shipped, path = shipped_plans(), Path(plan)
    if str(plan) in shipped:
        path = shipped[str(plan)]
    elif path.suffix not in {".yaml", ".yml"} or not path.is_file():
        expected, fix = f"a YAML file, or one of {', '.join(shipped)}", did_you_mean(str(plan), shipped)
        raise PlanError("no such plan", where=plan, expected=expected, fix=fix)
    try:
        data = load_yaml(path)
    except (OSError, DocumentError) as error:
        raise PlanError("this plan can't be read", where=path, found=error) from error
    loaded = parse(Plan, data, PlanError, where=path, about="not a valid plan")
    completed = [_completed(part, number, path) for number, part in enumerate(loaded.parts)]
    parts = [part for part, _ in completed]
    names = [part.name or "" for part in parts]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise PlanError("parts of one name", where=path, found=", ".join(twice), fix="Give them a name each.")
    _check_seeds(parts, [scene for _, scene in completed], loaded.block, path)
    cameras = _cameras(loaded, [config for _, (_, config, _) in completed], path)
    images = loaded.images.model_copy(update={"cameras": cameras})
    packs = sorted({_FURNITURE_PACK, *(part.pack for part in parts)})
    found = {pack: digest for pack in packs if (digest := _digest(pack))}
    check_packs(loaded, found)
    return loaded.model_copy(update={"parts": parts, "packs": found, "images": images})


def max_seeds(episodes: int, block: int) -> int:
    """Return how many seeds a part may try before the run ends because too few succeed."""
    return episodes + max(20, 3 * episodes) + 2 * block  # the last work units are done whole


def check_packs(plan: Plan, packs: Iterable[str]) -> None:
    """Raise PlanError if a pack, or that of the furniture, differs from the one that a plan was loaded with."""
    for pack in {_FURNITURE_PACK, *packs}:
        expected, found = plan.packs.get(pack), _digest(pack)
        if expected and found and found != expected:
            what, fix = "this pack differs from the one that the plan started with", "Use that pack, or --overwrite."
            hashes = f"a manifest of sha256 {expected[:12]}...", f"{found[:12]}..."
            raise PlanError(what, where=pack, expected=hashes[0], found=hashes[1], fix=fix)


def check_plan(plan: Plan) -> None:
    """Check that this machine can record, render and join a plan: errors that would come after days of work."""
    from robocas_ms3.demos.recordings.motion import sample_stride

    for number in range(len(plan.parts)):
        recording_settings(plan, number).check()
    if "datasets" in plan.stages:
        sample_stride(plan.control_freq, plan.rate)
        if plan.embeddings:
            from robocas_ms3.scenes.language.embed import TextEmbedder

            TextEmbedder()  # raises if something is missing; loads nothing
        if "lerobot" in plan.formats:
            from robocas_ms3.datasets.lerobot.schema import check_video_size, require_lerobot, whole_rate

            require_lerobot()
            whole_rate(plan.rate)
            check_video_size(plan.images.size)
    if "statistics" in plan.stages:
        require_extra("plots", "statistics", "matplotlib", fix="Or leave the stage out.")


def recording_settings(plan: Plan, part: int) -> EpisodeSettings:
    """Return how a part's episodes are recorded."""
    config = plan.parts[part]
    assert config.config is not None  # set by `load_plan`
    rate = int(plan.rate) if plan.rate == int(plan.rate) else 5  # episodes are checked at the dataset's rate
    chosen = {"control_freq": plan.control_freq, "check_rate": rate, **plan.recording.model_dump(exclude_none=True)}
    return EpisodeSettings(config.task, config.config, config.pack, **chosen)


@contextmanager
def part_error_context(plan: Plan, part: int) -> Iterator[None]:
    """Open an environment, or whatever else all seeds of a part share: an error there is no seed's fault.

    Raises:
        PlanError: it can't be opened on this machine, or the part's pack differs here.
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
        found, fix = format_error(error), "Repair it, and run the command again."
        raise PlanError("this part can't be opened", where=f"part {config.name}", found=found, fix=fix) from error


def _completed(part: PartConfig, number: int, path: Path) -> tuple[PartConfig, Any]:
    """Return a part with its configuration, pack and name; and what its scenes depend on."""
    if part.task not in TASKS:
        where, expected, fix = f"{path}, parts.{number}", ", ".join(TASKS), did_you_mean(part.task, list(TASKS))
        raise PlanError("no such task", where=where, expected=expected, found=repr(part.task), fix=fix)
    spec = TASKS[part.task]
    name, config = part.config or spec.default_config, part.config or spec.default_config
    if isinstance(config, str) and (path.parent / config).is_file():
        config = path.parent / config
    loaded = load_config_for(spec, config)
    shipped = isinstance(config, str) and config in bundled_configs()  # a file may change until the next run
    stem, pack = Path(name).stem if isinstance(name, str) else part.task, part.pack
    if pack not in find_packs():  # a folder, relative to the plan or to the working directory
        folders = [folder for folder in (path.parent / pack, Path(pack)) if folder.is_dir()]
        pack = str(folders[0].resolve()) if folders else pack
    completed = {
        "config": name if shipped else loaded.model_dump(mode="json"),
        "pack": pack,
        "name": part.name or re.sub(r"[^\w-]+", "-", f"{number:02d}-{stem}")[:60],
    }
    return part.model_copy(update=completed), (part.task, loaded, pack)


def _cameras(plan: Plan, configs: Sequence[TaskConfig], path: Path) -> list[str]:
    """Return the cameras of the dataset: the chosen ones, or all that the parts' configurations declare."""
    robot, where = find_robot(plan.recording.robot).description, f"{path}, images.cameras"
    declared = [[camera.name for camera in config.cameras_of(robot)] for config in configs]
    common = [name for name in declared[0] if all(name in names for names in declared)]
    if not plan.images.cameras:
        if "datasets" in plan.stages and any(len(names) > len(common) for names in declared):
            what, fix = "the parts have different cameras", f"Choose some of {', '.join(common)}."
            raise PlanError(what, where=where, found=sorted({*chain(*declared)} - {*common}), fix=fix)
        return common
    if wrong := sorted({*plan.images.cameras} - {*common}):
        raise PlanError("no such camera", where=where, expected=f"some of {', '.join(common)}", found=wrong)
    return plan.images.cameras


def _digest(pack: str) -> str:
    """Return the hash of a pack's manifest, which has those of its files; empty where there is no such pack."""
    path = find_packs().get(pack, Path(pack)) / MANIFEST
    return sha256(path) if path.is_file() else ""


def _check_seeds(parts: Sequence[PartConfig], scenes: Sequence[Any], block: int, path: Path) -> None:
    """Check that no two parts may try the same seed of a scene: a dataset has no episode twice."""
    for number, part in enumerate(parts):
        where, most = f"{path}, parts.{number}.seed", max_seeds(part.episodes, block)
        if part.seed + most > MAX_SEED:
            expected = f"<= {MAX_SEED - most}"
            raise PlanError(f"seeds end at {MAX_SEED}", where=where, expected=expected, found=part.seed)
        for other, scene in zip(parts[:number], scenes, strict=False):
            first, last = sorted((part, other), key=lambda each: each.seed)
            end = first.seed + max_seeds(first.episodes, block)
            if scenes[number] == scene and last.seed < end:
                expected, found = f"one of the two from {end} on", f"{part.seed}, and {other.seed} of {other.name}"
                raise PlanError("two parts may try the same seeds", where=where, expected=expected, found=found)
