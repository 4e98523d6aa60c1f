"""Joins what the units made: layouts and demonstrations part by part, and datasets of all of them."""

from __future__ import annotations

import json
import os
import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.sources.provenance import recording_entry
from robocas_ms3.datasets.writing.info import write_info
from robocas_ms3.datasets.writing.plan import dataset_settings, header
from robocas_ms3.documents import load_json
from robocas_ms3.files import flush_to_disk, make_folder, replacing, write_json
from robocas_ms3.outputs import sweep
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.sides import rule_of, sides_of
from robocas_ms3.plans.units import EPISODES, REPORT, UNITS, Outcome, Task, Unit
from robocas_ms3.processes.child import Limits
from robocas_ms3.recordings.merging import merge
from robocas_ms3.recordings.reading import TrajectoryFile
from robocas_ms3.scenes.frozen import join_frozen

LAYOUTS, DEMOS, DATASETS, STATISTICS = "layouts", "demos", "datasets", "statistics"
TRAJECTORY = "trajectory.h5"
Chosen = Mapping[int, Sequence[tuple[Unit, Outcome]]]
"""Part -> its episodes, in the order of their seeds."""


def join(plan: Plan, out: Path, chosen: Chosen, *, jobs: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Join everything; killed at any moment, it goes on and ends the same.

    Args:
        plan: it.
        out: its folder.
        chosen: the episodes.
        jobs: processes, of this machine no more than it has cores.
        say: called with what is done.

    Returns:
        The report.
    """
    if not (out / REPORT).is_file():
        tasks = {
            number: [Task(number, outcome.seed, unit.folder(plan, out)) for unit, outcome in episodes]
            for number, episodes in chosen.items()
        }
        if plan.makes_layouts:
            say("joining layouts")
            _join_layouts(plan, out / LAYOUTS, tasks)
        robocas = out / DATASETS / "robocas"
        if plan.makes_datasets and not (robocas / schema.DATA_INFO_FILE).is_file():
            say("joining the dataset")
            _join_episodes(plan, robocas, tasks)
        for number, recorded in tasks.items() if plan.makes_demonstrations else ():
            path = make_folder(out / DEMOS / f"{plan.parts[number].name}") / TRAJECTORY
            sweep(path.parent)
            if not path.is_file():
                say(f"joining demonstrations, {plan.parts[number].name}")
                merge([task.recording for task in recorded], path)
        if plan.makes_datasets and "lerobot" in plan.formats:
            say("making the LeRobot dataset")
            _convert_lerobot(plan, robocas, out / DATASETS / "lerobot", jobs)
        if "statistics" in plan.stages:
            say("drawing statistics")
            _write_statistics(out)
        write_json(out / REPORT, _report(plan, chosen))
    flush_to_disk(out)
    for path in [*(out / UNITS).glob("*/*/seed_*"), *(out / UNITS).glob(f"*/*/{EPISODES}")]:
        shutil.rmtree(path) if path.is_dir() else path.unlink()  # they are joined, or more than were asked for
    return load_json(out / REPORT)


def has_begun(out: Path) -> bool:
    """Whether files of units have been moved already."""
    return (out / DATASETS).exists() or (out / DEMOS).exists() or (out / REPORT).is_file()


def _join_layouts(plan: Plan, out: Path, tasks: Mapping[int, Sequence[Task]]) -> None:
    make_folder(out)
    sweep(out)
    for number, made in tasks.items():
        join_frozen(out / f"{plan.parts[number].name}.npy", [task.layout for task in made])


def _join_episodes(plan: Plan, out: Path, tasks: Mapping[int, Sequence[Task]]) -> None:
    """Move the rendered episodes into one dataset, numbered part by part."""
    make_folder(out)
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
    write_json(out / schema.CONVERSION_FILE, {**header(settings, rule_of(plan)), "episodes": entries})
    write_info(out, sides_of(plan, out))


def _say_source(path: Path, source: dict[str, Any]) -> None:
    """Say in an episode's ``scene.json`` where its recording is in the end."""
    scene = load_json(path)
    text = json.dumps({**scene, "source": {**scene["source"], **source}}, indent=1, ensure_ascii=False)
    with replacing(path) as tmp:
        tmp.write_text(text + "\n", encoding="utf-8")


def _convert_lerobot(plan: Plan, robocas: Path, out: Path, jobs: int) -> None:
    from robocas_ms3.datasets.lerobot.convert import convert_lerobot

    limits = Limits(plan.limits.render_seconds, plan.limits.memory_gb)
    jobs = min(jobs, os.cpu_count() or 1)  # those of a plan may be a cluster's
    convert_lerobot(robocas, out, resume=True, jobs=jobs, episode_limits=limits)


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
