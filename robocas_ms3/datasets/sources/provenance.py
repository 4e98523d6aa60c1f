"""Provenance of an episode: ``scene.json`` and the recording in ``conversion.json``."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.sources.file_models import SCENE_KEYS
from robocas_ms3.demos.recordings.trajectory_file import Recording, TrajectoryFile


def fingerprint_recording(recording: Recording) -> str:
    """Compute the SHA-256 of seed, control mode, instruction and actions, which identifies a recording."""
    digest = hashlib.sha256()
    digest.update(f"{recording.seed} {recording.control_mode} {recording.instruction}\n".encode())
    digest.update(np.ascontiguousarray(recording.actions).tobytes())
    return digest.hexdigest()


def make_recording_entry(file: TrajectoryFile, index: int) -> dict[str, Any]:
    """Make the entry of an episode for ``conversion.json``.

    ``index`` is its position in the trajectory file. The keys are ``trajectory``, ``trajectory_episode``, ``seed``,
    ``success``, ``target`` and ``recording`` (the fingerprint).
    """
    return {
        **make_entry_without_fingerprint(file, index),
        "recording": fingerprint_recording(file.read_recording(index, bodies=False)),
    }


def make_entry_without_fingerprint(file: TrajectoryFile, index: int) -> dict[str, Any]:
    """Make the entry of an episode without reading its actions; ``recording`` (the fingerprint) is None."""
    episode = file.episodes[index]
    recorded = episode.get("robocas")
    return {
        "trajectory": file.path.name,
        "trajectory_episode": episode["episode_id"],
        "seed": episode.get("episode_seed"),
        "success": was_successful(episode),
        "target": recorded.get("target") if isinstance(recorded, dict) else None,
        "recording": None,
    }


def make_recorded_scene(file: TrajectoryFile, index: int) -> dict[str, Any]:
    """Make the part of ``scene.json`` that is known from the JSON of a trajectory file."""
    entry, recorded = file.read_entry(index), file.episodes[index].get("robocas", {})
    known = {"target", "instruction", "subgoals", "objects"}  # stored under other keys
    return {
        "schema_version": schema.SCHEMA_VERSION,
        "task": parse_task_name(file.env_info["env_id"]),
        "env_info": {key: file.env_info[key] for key in ("env_id", "env_kwargs")},
        "seed": entry.seed,
        "reset_options": entry.reset_options,
        "target": recorded.get("target"),
        "success": was_successful(file.episodes[index]),
        "control_mode": entry.control_mode,
        "control_freq": file.control_freq,
        "source": {"trajectory": file.path.name, "episode_id": entry.episode_id},
        "recorded": {key: value for key, value in recorded.items() if key not in known},
        "versions": file.versions,
    }


def make_scene(
    file: TrajectoryFile, index: int, recording: Recording, scene: dict[str, Any], rate_hz: float
) -> dict[str, Any]:
    """Make the content of ``scene.json`` of a recording.

    ``scene`` has the task, config, layout and objects of the rebuilt scene.
    """
    record = {**make_recorded_scene(file, index), **scene, "rate_hz": rate_hz}
    record["source"]["recording"] = fingerprint_recording(recording)
    return {key: record.get(key) for key in SCENE_KEYS}


def was_successful(episode: dict[str, Any]) -> bool:
    """Return whether a recorded episode succeeded, from its entry in the JSON of the trajectory file."""
    found = episode.get("success", False)
    return found is True or (isinstance(found, list) and bool(found) and all(one is True for one in found))


def parse_task_name(env_id: str | None) -> str | None:
    """Parse the task name from an environment id, such as ``open_pick`` from ``RoboCASOpenPick-v1``."""
    match = re.fullmatch(r"(?:\w+:)?RoboCAS(\w+)-v\d+", env_id or "")
    return "_".join(re.findall("[A-Z][a-z]*", match[1])).lower() if match else None


def compute_environment_id(env_info: Mapping[str, Any] | None) -> str:
    """Compute an identifier of the id and the arguments of an environment; empty if they are unknown."""
    if not env_info or not env_info.get("env_id"):
        return ""
    known = [env_info["env_id"], env_info.get("env_kwargs") or {}]
    return hashlib.sha256(json.dumps(known, sort_keys=True, default=str).encode()).hexdigest()[:12]
