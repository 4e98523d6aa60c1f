"""Join the episodes of work units: layouts and demonstrations per plan part, and the dataset of all plan parts."""

from __future__ import annotations

import logging
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from robocas_ms3.core.documents import DAMAGED_FILE_ERRORS, load_json, load_npy
from robocas_ms3.core.errors import DatasetError, PlanError
from robocas_ms3.core.files import atomic_file, encode_json, flush_to_disk, make_folder, write_json
from robocas_ms3.core.output_folder import remove_temporary_files
from robocas_ms3.core.text import format_count, one_line
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.conversion.data_info import write_data_info
from robocas_ms3.datasets.conversion.episode_plan import make_header, make_settings
from robocas_ms3.datasets.manage.split import SplitOptions, divide_episodes, group_episodes
from robocas_ms3.datasets.sources.provenance import make_recording_entry
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.sources.split import SPLIT_RULE, split_by_seed
from robocas_ms3.demos.candidates.candidates_file import FILE_NAME as CANDIDATES_FILE
from robocas_ms3.demos.candidates.candidates_file import CandidateFile, merge_candidates
from robocas_ms3.demos.recordings.trajectory_file import TrajectoryFile
from robocas_ms3.demos.recordings.trajectory_hdf5 import find_violation, merge
from robocas_ms3.plans.folder import (
    DATASETS,
    DEMOS,
    LAYOUTS,
    REPORT,
    STATISTICS,
    UNITS,
    Outcome,
    PlanFolder,
    SeedFiles,
    WorkUnit,
)
from robocas_ms3.plans.plan import Plan
from robocas_ms3.scenes.layout_table import join_frozen_layouts

TRAJECTORY = "trajectory.h5"
ChosenEpisodes = Mapping[int, Sequence[tuple[WorkUnit, Outcome]]]
"""Index of a plan part -> (work unit, outcome) of each episode to join, in the order of their seeds."""
EpisodeFiles = Mapping[int, Sequence[SeedFiles]]
OnStage = Callable[[str], None]
_log = logging.getLogger(__name__)


def join_episodes(
    folder: PlanFolder, chosen: ChosenEpisodes, *, jobs: int = 1, on_stage: OnStage = lambda text: None
) -> dict[str, Any]:
    """Join all episodes and return the content of ``report.json``; continue a join that was interrupted.

    When the joined files are complete and flushed to disk, the files of the work units are deleted.

    Args:
        folder: output folder of the plan.
        chosen: episodes to join.
        jobs: number of processes that write the LeRobot dataset, at most one per CPU core.
        on_stage: called with the name of each stage, such as "joining the dataset".

    Raises:
        PlanError: a joined file is damaged and its source files are deleted, or a file is damaged after writing.
    """
    plan, out = folder.plan, folder.path
    report = _make_report(plan, chosen)
    files = {part: [folder.seed_files(unit, outcome.seed) for unit, outcome in found] for part, found in chosen.items()}
    finished = False
    with suppress(OSError, ValueError):
        finished = load_json(out / REPORT) == report
    # a folder of a seed: to be joined, not needed, or left by a killed process
    if not finished or any(path.is_dir() for path in (out / UNITS).glob("*/*/*")):
        _join_files(folder, files, on_stage)
    if not finished:
        if "datasets" in plan.stages and "lerobot" in plan.formats:
            on_stage("writing the LeRobot dataset")
            _convert_lerobot(plan, out / DATASETS / "robocas", out / DATASETS / "lerobot", jobs)
        if "statistics" in plan.stages:
            on_stage("writing statistics")
            _write_statistics(out)
    flush_to_disk(out)
    if not finished:
        write_json(out / REPORT, report, sync=True)
    for path in [path for path in (out / UNITS).glob("*/*/*") if path.is_dir()]:
        shutil.rmtree(path)
    return report


def _join_files(folder: PlanFolder, files: EpisodeFiles, on_stage: OnStage) -> None:
    plan, out = folder.plan, folder.path
    seeds = {part: [each.seed for each in episodes] for part, episodes in files.items()}
    for part, episodes in files.items() if "layouts" in plan.stages else ():
        path, layouts = out / LAYOUTS / f"{plan.part_name(part)}.npy", [each.layout_path for each in episodes]
        remove_temporary_files(make_folder(path.parent))
        damage, write = partial(_find_layouts_damage, path, seeds[part]), partial(join_frozen_layouts, path, layouts)
        _join_file(path, layouts, damage, write, partial(on_stage, f"joining layouts, {plan.part_name(part)}"))
    if "datasets" in plan.stages:
        root, count = out / DATASETS / "robocas", sum(map(len, files.values()))
        remove_temporary_files(make_folder(root))
        damage, write = partial(_find_dataset_damage, root, count), partial(_join_dataset, plan, root, files)
        _join_file(root, _dataset_sources(plan, root, files), damage, write, partial(on_stage, "joining the dataset"))
    for part, episodes in files.items() if "demonstrations" in plan.stages else ():
        path, recordings = out / DEMOS / plan.part_name(part) / TRAJECTORY, [each.recording_path for each in episodes]
        remove_temporary_files(make_folder(path.parent))
        damage, write = partial(find_violation, path, seeds[part]), partial(merge, recordings, path)
        _join_file(
            path, recordings, damage, write, partial(on_stage, f"joining demonstrations, {plan.part_name(part)}")
        )
        if plan.recording.record_candidates:
            target, sources = path.with_name(CANDIDATES_FILE), [each.candidates_path for each in episodes]
            damage, write = partial(_find_candidates_damage, target, seeds[part]), partial(_merge, sources, target)
            _join_file(target, sources, damage, write, partial(on_stage, f"joining candidates, {plan.part_name(part)}"))


def _join_file(
    path: Path,
    sources: Iterable[Path],
    damage: Callable[[], str],
    write: Callable[[], None],
    on_start: Callable[[], None],
) -> None:
    """Write a joined file or folder, unless it is complete.

    Args:
        path: of the joined file or folder.
        sources: files to join, which must exist.
        damage: returns how the joined file is damaged; empty if it is complete.
        write: writes the joined file.
        on_start: called before writing.
    """
    if not (found := damage()):
        return
    if missing := next((source for source in sources if not source.exists()), None):
        found = f"{found}; {missing.parent.name}/{missing.name} is missing"
        fix = "Restore the file or its source files from a copy, or start again with --overwrite."
        raise PlanError(
            "this file or folder is damaged, and its source files are missing", where=path, found=found, fix=fix
        )
    on_start()
    write()
    if found := damage():
        fix = "Check the disk; then run the command again."
        raise PlanError("this file or folder is damaged after writing", where=path, found=found, fix=fix)


def _merge(sources: Sequence[Path], target: Path) -> None:
    target.unlink(missing_ok=True)  # damaged; otherwise its content would be kept
    merge_candidates(sources, target)


def _find_candidates_damage(path: Path, seeds: Sequence[int]) -> str:
    try:
        found = list(dict.fromkeys(CandidateFile(path).decisions["seed"].tolist()))
    except (DatasetError, OSError) as error:
        return _describe_error(error)
    return "" if found == list(seeds) else f"candidates of {format_count(len(found), 'episode')} with other seeds"


def _find_layouts_damage(path: Path, seeds: Sequence[int]) -> str:
    try:
        found = load_npy(path)["seed"].tolist()
    except (*DAMAGED_FILE_ERRORS, IndexError, KeyError, TypeError) as error:
        return _describe_error(error)
    return "" if found == list(seeds) else f"{format_count(len(found), 'layout')} of other seeds"


def _find_dataset_damage(root: Path, count: int) -> str:
    try:
        load_json(root / schema.DATA_INFO_FILE)
        listed = len(load_json(root / schema.CONVERSION_FILE)["episodes"])
        names = set(os.listdir(root))
    except (OSError, ValueError, KeyError, TypeError) as error:
        return _describe_error(error)
    missing = sorted({schema.episode_folder(number) for number in range(count)} - names)
    return (
        f"{missing[0]} is missing"
        if missing
        else ""
        if listed == count
        else f"{listed} of {format_count(count, 'episode')} in {schema.CONVERSION_FILE}"
    )


def _describe_error(error: Exception) -> str:
    return "it does not exist" if isinstance(error, FileNotFoundError) else one_line(error)


def _dataset_sources(plan: Plan, root: Path, files: EpisodeFiles) -> Iterator[Path]:
    for part, episodes in files.items():
        for number, each in enumerate(episodes, plan.first_episode_index(part)):
            yield each.recording_path
            if not (root / schema.episode_folder(number)).is_dir():
                yield each.episode_path


def _join_dataset(plan: Plan, root: Path, files: EpisodeFiles) -> None:
    entries: dict[str, Any] = {}
    for part, episodes in files.items():
        trajectory = {
            "trajectory": f"{DEMOS}/{plan.part_name(part)}/{TRAJECTORY}"
        }  # the recording of the unit is deleted
        for place, each in enumerate(episodes):
            number = plan.first_episode_index(part) + place
            folder = root / schema.episode_folder(number)
            if not folder.is_dir():
                _set_source(each.episode_path / schema.SCENE_FILE, {**trajectory, "episode_id": place})
                os.replace(each.episode_path, folder)
            with TrajectoryFile(each.recording_path, pack=plan.parts[part].pack) as file:
                entry = make_recording_entry(file, 0)
            entries[str(number)] = {**entry, **trajectory, "trajectory_episode": place}
    settings = make_settings(plan.rate, plan.images.image_options(), plan.embeddings)
    write_json(
        root / schema.CONVERSION_FILE, {**make_header(settings, describe_split(plan)), "episodes": entries}, sync=True
    )
    flush_to_disk(root)  # episodes are on disk before the file that lists them
    write_data_info(root, split_episodes(plan, root))


def _set_source(path: Path, source: dict[str, Any]) -> None:
    """Write the path and the index of the joined recording (``source``) into ``scene.json`` of an episode."""
    scene = load_json(path)
    text = encode_json({**scene, "source": {**scene["source"], **source}}, path, indent=1)
    with atomic_file(path, sync=True) as tmp:
        tmp.write_text(text + "\n", encoding="utf-8")


def describe_split(plan: Plan) -> str:
    """Return a text for ``conversion.json`` that describes how the validation episodes are chosen."""
    rule = SplitOptions(plan.split.val_fraction, plan.split.group_by).rule if plan.split else SPLIT_RULE
    named = [f"{part.name}: {part.split}" for part in plan.parts if part.split]
    return "; ".join([*named, *([rule] if len(named) < len(plan.parts) else [])])


def split_episodes(plan: Plan, root: Path) -> tuple[list[int], list[int]]:
    """Return the numbers of the training episodes and of the validation episodes.

    The episodes of plan parts without `split` are split by the rule `split` of the plan.
    """
    train: list[int] = []
    val: list[int] = []
    free: list[int] = []
    for number, part in enumerate(plan.parts):
        first = plan.first_episode_index(number)
        chosen = {None: free, "train": train, "val": val}[part.split]
        chosen += range(first, first + part.episodes)
    by = plan.split.group_by if plan.split else "seed"
    among, found = set(free), group_episodes(Dataset(root), by) if free else {}
    groups = {number: group for number, group in found.items() if number in among}
    if plan.split is None:
        by_rule = split_by_seed({number: int(group) for number, group in groups.items()})
    elif len(set(groups.values())) < 2:
        _log.warning("%s: there are no validation episodes, because all episodes have the same %s", root, by)
        by_rule = free, []
    else:
        by_rule = divide_episodes(groups, [1 - plan.split.val_fraction, plan.split.val_fraction])
    return sorted([*train, *by_rule[0]]), sorted([*val, *by_rule[1]])


def _convert_lerobot(plan: Plan, robocas: Path, out: Path, jobs: int) -> None:
    from robocas_ms3.datasets.conversion.settings import ConversionSettings
    from robocas_ms3.datasets.lerobot.convert import convert_lerobot

    seconds, memory_gb = plan.limits.render_seconds, plan.limits.memory_gb
    jobs = min(jobs, os.cpu_count() or 1)  # `--jobs` may be the number of jobs on a cluster
    version = plan.lerobot_version
    settings = ConversionSettings(
        robocas, out, jobs=jobs, episode_seconds=seconds, memory_gb=memory_gb, lerobot_version=version
    )
    convert_lerobot(settings)


def _write_statistics(out: Path) -> None:
    from robocas_ms3.datasets.statistics.collect import collect_statistics
    from robocas_ms3.datasets.statistics.plots import write_stats

    dataset = Path(DATASETS, "robocas")
    write_stats(
        replace(collect_statistics(out / dataset), path=dataset), out / STATISTICS
    )  # no absolute path in the statistics


def _make_report(plan: Plan, chosen: ChosenEpisodes) -> dict[str, Any]:
    """Return the content of ``report.json``; it does not depend on times and machines."""
    parts = {}
    for part, episodes in chosen.items():
        found = [outcome for _, outcome in episodes]
        parts[plan.part_name(part)] = {
            "episodes": len(found),
            "seeds": [outcome.seed for outcome in found],
            "steps": sum(outcome.steps for outcome in found),
            "failed_attempts": dict(Counter(failure for outcome in found for failure in outcome.failures)),
        }
    return {"episodes": sum(part["episodes"] for part in parts.values()), "parts": parts}
