"""Difficulties of the scenes of a protocol: ``difficulty.jsonl`` in its folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from robocas_ms3.core.errors import EvaluationError, OutputExistsError
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.demos.difficulty.difficulty_file import (
    SCENES,
    DifficultySettings,
    SeedResult,
    measure_seeds,
    read_difficulties,
)
from robocas_ms3.demos.difficulty.records import RemovalLimits, SceneDifficulty
from robocas_ms3.evaluation.protocols.protocol import LoadedProtocol
from robocas_ms3.scenes.config import load_task_config

DIFFICULTIES = "difficulty.jsonl"
"""File in the folder of a protocol, with the difficulties of its episodes in their order."""


def read_difficulties_of(protocol: LoadedProtocol) -> list[SceneDifficulty]:
    """Read the difficulties of the scenes of a protocol, one per episode.

    Raises:
        EvaluationError: the protocol has no difficulties, or they do not fit its episodes.
    """
    path = protocol.folder / DIFFICULTIES
    scenes = JsonLinesFile[SceneDifficulty](path, SceneDifficulty).read()
    if not scenes:
        fix = (
            f"Run robocas difficulty --protocol {protocol.folder} --out difficulty, and copy difficulty/{DIFFICULTIES} "
            "into the folder of the protocol."
        )
        raise EvaluationError("the protocol has no difficulties of its scenes", where=path, fix=fix)
    expected = [(episode.seed, episode.target) for episode in protocol.episodes]
    if [(scene.seed, scene.target) for scene in scenes] != expected:
        what, wanted = "the difficulties do not fit the episodes", "one line per episode, with its seed and target"
        raise EvaluationError(what, where=path, expected=wanted)
    return scenes


def measure_protocol(
    protocol: LoadedProtocol,
    out: Path,
    limits: RemovalLimits,
    *,
    jobs: int = 1,
    overwrite: bool = False,
    on_start: Callable[[int, int], None] = lambda total, measured: None,
) -> Iterator[SeedResult]:
    """Measure the scenes of a protocol in its frozen layouts, and yield each result that was not stored earlier.

    The folder ``out`` gets a folder of `measure_seeds` per configuration, and `DIFFICULTIES` when all scenes are
    measured.

    Args:
        protocol: protocol whose scenes have a measure of difficulty.
        out: output folder.
        limits: limits of the search for removals.
        jobs: number of processes, which has no effect on the results.
        overwrite: whether to delete earlier results.
        on_start: called with the number of scenes, and the number of those that were measured earlier.

    Raises:
        OutputExistsError: ``out`` was written with other settings, or by another command.
        RobocasError: the scenes have no measure of difficulty, or the installed pack differs.
    """
    protocol.check_pack()
    seeds: dict[str, list[int]] = {}
    for episode in protocol.episodes:
        seeds.setdefault(episode.config, []).append(episode.seed)
    settings: dict[str, DifficultySettings] = {}
    for name in seeds:
        config = load_task_config(protocol.config_file(name))
        layouts = str(protocol.layouts_file(name))
        content = config.model_dump(mode="json")
        settings[name] = DifficultySettings(config.task, content, protocol.rules.pack, limits, layouts)
        settings[name].check(where=f"configuration {name} of {protocol.rules.name}")
    scenes = {(episode.config, episode.seed) for episode in protocol.episodes}
    if (out / DIFFICULTIES).exists() and not any((out / name / SCENES).exists() for name in seeds):
        what, fix = "the output exists and was not written by robocas difficulty", "Choose another folder."
        raise OutputExistsError(what, where=out / DIFFICULTIES, fix=fix)
    on_start(len(scenes), 0 if overwrite else len(read_measured(protocol, out)))

    def delete_earlier(_: int) -> None:
        (out / DIFFICULTIES).unlink(missing_ok=True)  # of other limits, or of fewer scenes

    for name, numbers in seeds.items():
        distinct = list(dict.fromkeys(numbers))
        yield from measure_seeds(
            settings[name], distinct, out / name, jobs=jobs, overwrite=overwrite, on_start=delete_earlier
        )
    measured = read_measured(protocol, out)
    if len(measured) == len(scenes):
        lines = [measured[episode.config, episode.seed] for episode in protocol.episodes]
        JsonLinesFile[SceneDifficulty](out / DIFFICULTIES, SceneDifficulty).rewrite(lines)


def read_measured(protocol: LoadedProtocol, out: Path) -> dict[tuple[str, int], SceneDifficulty]:
    """Return the difficulties that `measure_protocol` has stored in a folder, by configuration and seed."""
    scenes = dict.fromkeys((episode.config, episode.seed) for episode in protocol.episodes)
    stored = {
        (name, scene.seed): scene
        for name in dict.fromkeys(name for name, _ in scenes)
        for scene in read_difficulties(out / name)
    }
    return {scene: stored[scene] for scene in scenes if scene in stored}
