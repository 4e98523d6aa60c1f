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


def fingerprint(recording: Recording) -> str:
    """Return the SHA-256 of seed, control mode, instruction and actions, which identifies a recording."""
    digest = hashlib.sha256()
    digest.update(f"{recording.seed} {recording.control_mode} {recording.instruction}\n".encode())
    digest.update(np.ascontiguousarray(recording.actions).tobytes())
    return digest.hexdigest()


def recording_entry(file: TrajectoryFile, index: int) -> dict[str, Any]:
    """Return the recording of an episode, as stored in ``conversion.json``."""
    return {
        **entry_without_fingerprint(file, index),
        "recording": fingerprint(file.read_recording(index, bodies=False)),
    }


def entry_without_fingerprint(file: TrajectoryFile, index: int) -> dict[str, Any]:
    """Return `recording_entry` without the fingerprint, for which the actions are read."""
    episode = file.episodes[index]
    recorded = episode.get("robocas")
    return {
        "trajectory": file.path.name,
        "trajectory_episode": episode["episode_id"],
        "seed": episode.get("episode_seed"),
        "success": is_success(episode),
        "target": recorded.get("target") if isinstance(recorded, dict) else None,
        "recording": None,
    }


def recorded_scene(file: TrajectoryFile, index: int) -> dict[str, Any]:
    """Return the content of ``scene.json`` that the JSON of a trajectory file has, by `SCENE_KEYS`."""
    entry, recorded = file.read_entry(index), file.episodes[index].get("robocas", {})
    known = {"target", "instruction", "subgoals", "objects"}  # stored under other keys
    return {
        "schema_version": schema.SCHEMA_VERSION,
        "task": task_of(file.env_info["env_id"]),
        "env_info": {key: file.env_info[key] for key in ("env_id", "env_kwargs")},
        "seed": entry.seed,
        "reset_options": entry.reset_options,
        "target": recorded.get("target"),
        "success": is_success(file.episodes[index]),
        "control_mode": entry.control_mode,
        "control_freq": file.control_freq,
        "source": {"trajectory": file.path.name, "episode_id": entry.episode_id},
        "recorded": {key: value for key, value in recorded.items() if key not in known},
        "versions": file.versions,
    }


def scene_record(
    file: TrajectoryFile, index: int, recording: Recording, scene: dict[str, Any], rate_hz: float
) -> dict[str, Any]:
    """Return ``scene.json`` of a recording; ``scene``: task, config, layout and objects as rebuilt."""
    record = {**recorded_scene(file, index), **scene, "rate_hz": rate_hz}
    record["source"]["recording"] = fingerprint(recording)
    return {key: record.get(key) for key in SCENE_KEYS}


def is_success(episode: dict[str, Any]) -> bool:
    """Return whether a recorded episode was successful, by its JSON entry."""
    found = episode.get("success", False)
    return found is True or (isinstance(found, list) and bool(found) and all(one is True for one in found))


def task_of(env_id: str | None) -> str | None:
    """Return the task name of an environment id, without importing the simulator."""
    match = re.fullmatch(r"(?:\w+:)?RoboCAS(\w+)-v\d+", env_id or "")
    return "_".join(re.findall("[A-Z][a-z]*", match[1])).lower() if match else None


def environment_id(env_info: Mapping[str, Any] | None) -> str:
    """Return an identifier of the task, configuration and pack of an environment; empty if unknown."""
    if not env_info or not env_info.get("env_id"):
        return ""
    known = [env_info["env_id"], env_info.get("env_kwargs") or {}]
    return hashlib.sha256(json.dumps(known, sort_keys=True, default=str).encode()).hexdigest()[:12]
