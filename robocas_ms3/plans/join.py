"""Joins the episodes of work units: layouts and demonstrations by part, and datasets of all parts."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from robocas_ms3.core.documents import DAMAGED, load_array, load_json
from robocas_ms3.core.errors import PlanError
from robocas_ms3.core.files import flush_to_disk, json_text, make_folder, replacing, write_json
from robocas_ms3.core.outputs import sweep
from robocas_ms3.core.words import count_of
from robocas_ms3.core.workers import Limits
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.sources.provenance import recording_entry
from robocas_ms3.datasets.writing.info import write_info
from robocas_ms3.datasets.writing.plan import dataset_settings, header
from robocas_ms3.demos.recordings.entries import reason
from robocas_ms3.demos.recordings.merging import damage_of, merge
from robocas_ms3.demos.recordings.reading import TrajectoryFile
from robocas_ms3.plans.folder import REPORT, UNITS
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.split import rule_of, split_of
from robocas_ms3.plans.units import Outcome, SeedFiles, Unit
from robocas_ms3.scenes.table import join_frozen

LAYOUTS, DEMOS, DATASETS, STATISTICS = "layouts", "demos", "datasets", "statistics"
TRAJECTORY = "trajectory.h5"
Chosen = Mapping[int, Sequence[tuple[Unit, Outcome]]]
"""Part -> its episodes, in the order of their seeds."""
EpisodeFiles = Mapping[int, Sequence[SeedFiles]]


def join(
    plan: Plan, out: Path, chosen: Chosen, *, jobs: int = 1, say: Callable[[str], None] = lambda text: None
) -> dict[str, Any]:
    """Join all episodes; after a kill at any moment, another call continues and makes the same.

    Files of units are deleted once the joined files are on the disk and complete.

    Args:
        plan: the plan.
        out: its folder.
        chosen: the episodes.
        jobs: processes that make the LeRobot dataset, at most one per core.
        say: called with each stage.

    Returns:
        The content of ``report.json``.

    Raises:
        PlanError: a joined file is damaged, and the files of units are gone; or the disk does not keep it.
    """
    report = _report(plan, chosen)
    files = {
        part: [unit.files(plan, out, outcome.seed) for unit, outcome in episodes] for part, episodes in chosen.items()
    }
    finished = _is_written(out / REPORT, report)
    if not finished or _left(out):
        for joined in _joined_files(plan, out, files):
            joined.write(say)
    if not finished:
        if plan.makes_datasets and "lerobot" in plan.formats:
            say("making the LeRobot dataset")
            _convert_lerobot(plan, out / DATASETS / "robocas", out / DATASETS / "lerobot", jobs)
        if "statistics" in plan.stages:
            say("drawing statistics")
            _write_statistics(out)
    flush_to_disk(out)
    if not finished:
        write_json(out / REPORT, report, sync=True)
    for path in _left(out):
        shutil.rmtree(path)  # joined, more than the plan asks for, or left behind by a process that was killed
    return report


def has_moved(out: Path) -> bool:
    """Whether files of units may have been moved or deleted already."""
    return (out / DATASETS).exists() or (out / DEMOS).exists() or (out / REPORT).is_file()


def damaged_episodes(plan: Plan, out: Path, chosen: Chosen) -> dict[Unit, list[int]]:
    """Return seeds whose files have lost their size, as a disk with errors may do."""
    found: dict[Unit, list[int]] = {}
    for unit, outcome in (episode for episodes in chosen.values() for episode in episodes):
        if unit.files(plan, out, outcome.seed).size() != outcome.size:
            found.setdefault(unit, []).append(outcome.seed)
    return found


@dataclass(frozen=True)
class _Joined:
    """A file or folder that is joined from others.

    Attributes:
        path: of it.
        sources: files that it is joined from, as far as they are not joined yet.
        damage: returns what is wrong with it; empty: nothing.
        join: writes it.
        stage: for the user.
    """

    path: Path
    sources: Iterable[Path]
    damage: Callable[[], str]
    join: Callable[[], None]
    stage: str

    def write(self, say: Callable[[str], None]) -> None:
        """Join it, unless it is complete.

        Raises:
            PlanError: it is damaged and a source is gone, or it is damaged right after it was written.
        """
        if not (found := self.damage()):
            return
        if gone := next((source for source in self.sources if not source.exists()), None):
            found = f"{found}; {gone.parent.name}/{gone.name} is gone"
            fix = "Restore either from a copy, or start again with --overwrite."
            raise PlanError("this is damaged, and can't be joined again", where=self.path, found=found, fix=fix)
        say(self.stage)
        self.join()
        if found := self.damage():
            fix = "Check the disk; then run the command again."
            raise PlanError("this is not what was written", where=self.path, found=found, fix=fix)


def _joined_files(plan: Plan, out: Path, files: EpisodeFiles) -> Iterator[_Joined]:
    for part, episodes in files.items() if plan.makes_layouts else ():
        path, layouts = out / LAYOUTS / f"{plan.name_of(part)}.npy", [each.layout for each in episodes]
        sweep(make_folder(path.parent))
        damage = partial(_layouts_damage, path, [each.seed for each in episodes])
        join_layouts = partial(join_frozen, path, layouts)
        yield _Joined(path, layouts, damage, join_layouts, f"joining layouts, {plan.name_of(part)}")
    if plan.makes_datasets:
        root, count = out / DATASETS / "robocas", sum(map(len, files.values()))
        damage = partial(_dataset_damage, root, count)
        join_dataset = partial(_join_dataset, plan, root, files)
        yield _Joined(root, _dataset_sources(plan, root, files), damage, join_dataset, "joining the dataset")
    for part, episodes in files.items() if plan.makes_demonstrations else ():
        path, recordings = out / DEMOS / plan.name_of(part) / TRAJECTORY, [each.recording for each in episodes]
        sweep(make_folder(path.parent))
        damage = partial(damage_of, path, [each.seed for each in episodes])
        join_demos = partial(merge, recordings, path)
        yield _Joined(path, recordings, damage, join_demos, f"joining demonstrations, {plan.name_of(part)}")


def _is_written(path: Path, report: Mapping[str, Any]) -> bool:
    """Whether the report is written; a damaged one is written again."""
    with suppress(OSError, ValueError):
        return load_json(path) == report
    return False


def _left(out: Path) -> list[Path]:
    """Return folders of seeds, and temporary ones of processes that were killed."""
    return [path for path in (out / UNITS).glob("*/*/*") if path.is_dir()]


def _layouts_damage(path: Path, seeds: Sequence[int]) -> str:
    try:
        found = load_array(path)["seed"].tolist()
    except (*DAMAGED, IndexError, KeyError, TypeError) as error:
        return _reason(error)
    return "" if found == list(seeds) else f"{len(found)} layouts, of other seeds"


def _dataset_damage(root: Path, count: int) -> str:
    try:
        load_json(root / schema.DATA_INFO_FILE)
        listed = len(load_json(root / schema.CONVERSION_FILE)["episodes"])
        names = set(os.listdir(root))
    except (OSError, ValueError, KeyError, TypeError) as error:
        return _reason(error)
    missing = sorted({schema.episode_folder(number) for number in range(count)} - names)
    return f"no {missing[0]}" if missing else "" if listed == count else f"{listed} of {count_of(count, 'episode')}"


def _reason(error: Exception) -> str:
    return "it does not exist" if isinstance(error, FileNotFoundError) else reason(error)


def _dataset_sources(plan: Plan, root: Path, files: EpisodeFiles) -> Iterator[Path]:
    for part, episodes in files.items():
        for place, each in enumerate(episodes):
            yield each.recording
            if not (root / schema.episode_folder(plan.first_episode(part) + place)).is_dir():
                yield each.episode


def _join_dataset(plan: Plan, root: Path, files: EpisodeFiles) -> None:
    """Move the rendered episodes into one dataset, numbered part by part."""
    sweep(make_folder(root))
    entries: dict[str, Any] = {}
    for part, episodes in files.items():
        trajectory = {"trajectory": f"{DEMOS}/{plan.name_of(part)}/{TRAJECTORY}"}  # that of the unit is deleted
        for place, each in enumerate(episodes):
            number = plan.first_episode(part) + place
            folder = root / schema.episode_folder(number)
            if not folder.is_dir():
                _set_source(each.episode / schema.SCENE_FILE, {**trajectory, "episode_id": place})
                os.replace(each.episode, folder)
            with TrajectoryFile(each.recording, pack=plan.parts[part].pack) as file:
                entry = recording_entry(file, 0)
            entries[str(number)] = {**entry, **trajectory, "trajectory_episode": place}
    settings = dataset_settings(plan.rate, plan.pictures.chosen(), plan.embeddings)
    write_json(root / schema.CONVERSION_FILE, {**header(settings, rule_of(plan)), "episodes": entries}, sync=True)
    flush_to_disk(root)  # the episodes, before the file that lists them
    write_info(root, split_of(plan, root))


def _set_source(path: Path, source: dict[str, Any]) -> None:
    """Set in an episode's ``scene.json`` where its recording is in the end."""
    scene = load_json(path)
    text = json_text({**scene, "source": {**scene["source"], **source}}, path, indent=1)
    with replacing(path, sync=True) as tmp:
        tmp.write_text(text + "\n", encoding="utf-8")


def _convert_lerobot(plan: Plan, robocas: Path, out: Path, jobs: int) -> None:
    from robocas_ms3.datasets.lerobot.convert import convert_lerobot
    from robocas_ms3.datasets.writing.settings import ConversionSettings

    limits = Limits(plan.limits.render_seconds, plan.limits.memory_gb)
    jobs = min(jobs, os.cpu_count() or 1)  # those of a plan may be a cluster's
    version = plan.lerobot_version
    convert_lerobot(ConversionSettings(robocas, out, jobs=jobs, limits=limits, lerobot_version=version))


def _write_statistics(out: Path) -> None:
    from robocas_ms3.datasets.statistics.collect import collect
    from robocas_ms3.datasets.statistics.plots import write_stats

    dataset = Path(DATASETS, "robocas")
    write_stats(replace(collect(out / dataset), path=dataset), out / STATISTICS)  # the same wherever the folder is


def _report(plan: Plan, chosen: Chosen) -> dict[str, Any]:
    """Return the report, without anything that a clock or a machine decides."""
    parts = {}
    for part, episodes in chosen.items():
        found = [outcome for _, outcome in episodes]
        parts[plan.name_of(part)] = {
            "episodes": len(found),
            "seeds": [outcome.seed for outcome in found],
            "steps": sum(outcome.steps for outcome in found),
            "failed_attempts": dict(Counter(failure for outcome in found for failure in outcome.failures)),
        }
    return {"episodes": sum(part["episodes"] for part in parts.values()), "parts": parts}
