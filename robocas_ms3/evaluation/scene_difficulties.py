"""Difficulties of the scenes of a protocol: ``difficulty.jsonl`` in its folder."""

from __future__ import annotations

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.demos.difficulty.records import SceneDifficulty
from robocas_ms3.evaluation.protocol import LoadedProtocol

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
        fix = "Measure the scenes with robocas difficulty."
        raise EvaluationError("the protocol has no difficulties of its scenes", where=path, fix=fix)
    expected = [(episode.seed, episode.target) for episode in protocol.episodes]
    if [(scene.seed, scene.target) for scene in scenes] != expected:
        what, wanted = "the difficulties do not fit the episodes", "one line per episode, with its seed and target"
        raise EvaluationError(what, where=path, expected=wanted)
    return scenes
