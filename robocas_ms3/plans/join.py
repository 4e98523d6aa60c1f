"""Joins what the units made: layouts and demonstrations part by part, and datasets of all of them."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
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
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.sides import rule_of, sides_of
from robocas_ms3.plans.units import EPISODES, REPORT, UNITS, Outcome, Task, Unit
from robocas_ms3.scenes.frozen import join_frozen

LAYOUTS, DEMOS, DATASETS, STATISTICS = "layouts", "demos", "datasets", "statistics"
TRAJECTORY = "trajectory.h5"
Chosen = Mapping[int, Sequence[tuple[Unit, Outcome]]]
"""Part -> its episodes, in the order of their seeds."""
Tasks = Mapping[int, Sequence[Task]]
Say = Callable[[str], None]


def join(plan: Plan, out: Path, chosen: Chosen, *, jobs: int, say: Say) -> dict[str, Any]:
    """Join everything; killed at any moment, it goes on and ends the same.

    What was made by units is deleted once what was joined of it is on the disk, and holds what it must.

    Args:
        plan: it.
        out: its folder.
        chosen: the episodes.
        jobs: processes, of this machine no more than it has cores.
        say: called with what is done.

    Returns:
        The report.

    Raises:
        PlanError: what was joined is damaged, and what it was joined from is gone; or the disk does not keep it.
    """
    report = _report(plan, chosen)
    tasks = {
        number: [Task(number, outcome.seed, unit.folder(plan, out)) for unit, outcome in episodes]
        for number, episodes in chosen.items()
    }
    finished = _is_written(out / REPORT, report)
    if not finished or _left(out):
        _join_units(plan, out, tasks, say)
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
        shutil.rmtree(path) if path.is_dir() else path.unlink()  # they are joined, or more than were asked for
    return report


def has_begun(out: Path) -> bool:
    """Whether files of units have been moved already."""
    return (out / DATASETS).exists() or (out / DEMOS).exists() or (out / REPORT).is_file()


def _is_written(path: Path, report: Mapping[str, Any]) -> bool:
    """Whether the report is there; one that is damaged is written again."""
    with suppress(OSError, ValueError):
        return load_json(path) == report
    return False


def _left(out: Path) -> list[Path]:
    """What units made and nobody has deleted."""
    return [*(out / UNITS).glob("*/*/seed_*"), *(out / UNITS).glob(f"*/*/{EPISODES}")]


def _join_units(plan: Plan, out: Path, tasks: Tasks, say: Say) -> None:
    """Join what units made, where that is not done."""
    for number, made in tasks.items() if plan.makes_layouts else ():
        path, sources = out / LAYOUTS / f"{plan.parts[number].name}.npy", [task.layout for task in made]
        sweep(make_folder(path.parent))
        _join_once(
            path,
            sources,
            partial(_damage_of_layouts, path, [task.seed for task in made]),
            partial(join_frozen, path, sources),
            partial(say, f"joining layouts, {plan.parts[number].name}"),
        )
    if plan.makes_datasets:
        robocas = out / DATASETS / "robocas"
        _join_once(
            robocas,
            _needed(plan, robocas, tasks),
            partial(_damage_of_dataset, robocas, sum(map(len, tasks.values()))),
            partial(_join_episodes, plan, robocas, tasks),
            partial(say, "joining the dataset"),
        )
    for number, recorded in tasks.items() if plan.makes_demonstrations else ():
        path, sources = out / DEMOS / f"{plan.parts[number].name}" / TRAJECTORY, [task.recording for task in recorded]
        sweep(make_folder(path.parent))
        _join_once(
            path,
            sources,
            partial(damage_of, path, [task.seed for task in recorded]),
            partial(merge, sources, path),
            partial(say, f"joining demonstrations, {plan.parts[number].name}"),
        )


def _join_once(
    path: Path, sources: Iterable[Path], damage: Callable[[], str], join: Callable[[], None], say: Callable[[], None]
) -> None:
    """Join some files, unless that is done and nothing is wrong with it.

    Args:
        path: of what is made of them.
        sources: the files.
        damage: says what is wrong with it, if anything.
        join: makes it.
        say: that it is made.

    Raises:
        PlanError: it is damaged and some of the files are gone, or it is not what it should be right after it was made.
    """
    if not (found := damage()):
        return
    if gone := next((source for source in sources if not source.exists()), None):
        found, fix = f"{found}; {gone.name} is gone", "Put either back from a copy, or begin again with --overwrite."
        raise PlanError("this is not whole, and can't be joined again", where=path, found=found, fix=fix)
    say()
    join()
    if found := damage():
        raise PlanError("this is not what was written", where=path, found=found, fix="Look at the disk; then --resume.")


def _damage_of_layouts(path: Path, seeds: Sequence[int]) -> str:
    try:
        found = load_array(path)["seed"].tolist()
    except (*DAMAGED, IndexError, KeyError, TypeError) as error:
        return _said(error)
    return "" if found == list(seeds) else f"{len(found)} layouts, of other seeds"


def _damage_of_dataset(root: Path, count: int) -> str:
    try:
        load_json(root / schema.DATA_INFO_FILE)
        said = len(load_json(root / schema.CONVERSION_FILE)["episodes"])
        there = set(os.listdir(root))
    except (OSError, ValueError, KeyError, TypeError) as error:
        return _said(error)
    missing = sorted({schema.episode_folder(number) for number in range(count)} - there)
    return f"no {missing[0]}" if missing else "" if said == count else f"{said} of {count_of(count, 'episode')}"


def _said(error: Exception) -> str:
    return "it is not there" if isinstance(error, FileNotFoundError) else reason(error)


def _needed(plan: Plan, robocas: Path, tasks: Tasks) -> Iterator[Path]:
    """What a dataset is made of, as far as it is not there yet."""
    for part, recorded in tasks.items():
        for place, task in enumerate(recorded):
            yield task.recording
            if not (robocas / schema.episode_folder(plan.first_episode(part) + place)).is_dir():
                yield task.episode


def _join_episodes(plan: Plan, out: Path, tasks: Tasks) -> None:
    """Move the rendered episodes into one dataset, numbered part by part."""
    sweep(make_folder(out))
    entries: dict[str, Any] = {}
    for part, recorded in tasks.items():
        name = plan.parts[part].name
        for place, task in enumerate(recorded):
            number = plan.first_episode(part) + place
            joined = {"trajectory": f"{DEMOS}/{name}/{TRAJECTORY}"}  # not the file that goes once it is joined
            folder = out / schema.episode_folder(number)
            if not folder.is_dir():
                _say_source(task.episode / schema.SCENE_FILE, {**joined, "episode_id": place})
                os.replace(task.episode, folder)
            with TrajectoryFile(task.recording, pack=plan.parts[part].pack) as file:
                entry = recording_entry(file, 0)
            entries[str(number)] = {**entry, **joined, "trajectory_episode": place}
    settings = dataset_settings(plan.rate, plan.pictures.chosen(), plan.embeddings)
    write_json(out / schema.CONVERSION_FILE, {**header(settings, rule_of(plan)), "episodes": entries}, sync=True)
    flush_to_disk(out)  # what was moved, before there is what says that all of it was
    write_info(out, sides_of(plan, out))


def _say_source(path: Path, source: dict[str, Any]) -> None:
    """Say in an episode's ``scene.json`` where its recording is in the end."""
    scene = load_json(path)
    text = json_text({**scene, "source": {**scene["source"], **source}}, path, indent=1)
    with replacing(path, sync=True) as tmp:  # nobody else makes it again
        tmp.write_text(text + "\n", encoding="utf-8")


def _convert_lerobot(plan: Plan, robocas: Path, out: Path, jobs: int) -> None:
    from robocas_ms3.datasets.lerobot.convert import convert_lerobot
    from robocas_ms3.datasets.writing.settings import ConversionSettings

    limits = Limits(plan.limits.render_seconds, plan.limits.memory_gb)
    jobs = min(jobs, os.cpu_count() or 1)  # those of a plan may be a cluster's
    version = plan.lerobot_version
    convert_lerobot(ConversionSettings(robocas, out, resume=True, jobs=jobs, limits=limits, lerobot_version=version))


def _write_statistics(out: Path) -> None:
    from robocas_ms3.datasets.statistics.collect import collect
    from robocas_ms3.datasets.statistics.plots import write_stats

    dataset = Path(DATASETS, "robocas")
    write_stats(replace(collect(out / dataset), path=dataset), out / STATISTICS)  # the same wherever the folder lies


def _report(plan: Plan, chosen: Chosen) -> dict[str, Any]:
    """What was made, without anything that a clock or another machine would say otherwise."""
    parts = {}
    for number, episodes in chosen.items():
        found = [outcome for _, outcome in episodes]
        parts[f"{plan.parts[number].name}"] = {
            "episodes": len(found),
            "seeds": [outcome.seed for outcome in found],
            "steps": sum(outcome.steps for outcome in found),
            "failed_attempts": dict(Counter(failure for outcome in found for failure in outcome.failures)),
        }
    return {"episodes": sum(part["episodes"] for part in parts.values()), "parts": parts}
