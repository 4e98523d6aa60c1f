"""Demonstrations: generation with scripted policies, recordings, failed attempts and replay.

Public names are imported from this package at first use.
"""

from typing import TYPE_CHECKING

from robocas_ms3.core.lazy import make_lazy_exports

if TYPE_CHECKING:
    from robocas_ms3.demos.candidates.candidates_file import CandidateFile as CandidateFile
    from robocas_ms3.demos.candidates.candidates_file import merge_candidates as merge_candidates
    from robocas_ms3.demos.generation import Summary as Summary
    from robocas_ms3.demos.generation import generate as generate
    from robocas_ms3.demos.recordings.trajectory_file import TrajectoryFile as TrajectoryFile
    from robocas_ms3.demos.settings import EpisodeSettings as EpisodeSettings
    from robocas_ms3.demos.settings import GenerateSettings as GenerateSettings
    from robocas_ms3.demos.settings import ReplaySettings as ReplaySettings
    from robocas_ms3.demos.trajectory_replay import ReplayResult as ReplayResult
    from robocas_ms3.demos.trajectory_replay import replay as replay

__getattr__, __dir__, __all__ = make_lazy_exports(
    __name__,
    {
        "robocas_ms3.demos.candidates.candidates_file": ["CandidateFile", "merge_candidates"],
        "robocas_ms3.demos.generation": ["Summary", "generate"],
        "robocas_ms3.demos.recordings.trajectory_file": ["TrajectoryFile"],
        "robocas_ms3.demos.settings": ["EpisodeSettings", "GenerateSettings", "ReplaySettings"],
        "robocas_ms3.demos.trajectory_replay": ["ReplayResult", "replay"],
    },
)
