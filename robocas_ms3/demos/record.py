"""Record episodes in ManiSkill's trajectory format: one file an episode while generating, merged at the end."""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import h5py
import numpy as np
from mani_skill.utils.wrappers.record import RecordEpisode
from numpy.typing import NDArray

from robocas_ms3.errors import DatasetError
from robocas_ms3.files import replacing, write_json

# Settings of one machine or one run; a trajectory has to replay without them.
_LOCAL_KWARGS = ("render_backend", "render_mode", "sim_backend", "reward_mode")


class EpisodeRecorder(RecordEpisode):
    """ManiSkill's recorder for a single episode in a file of its own, so that a crash costs one episode at most.

    Args:
        env: the environment to record.
        folder: where ``<name>.h5`` and ``<name>.json`` go.
        name: of the files.
    """

    def __init__(self, env: gym.Env, folder: Path, name: str) -> None:
        super().__init__(
            cast(Any, env),
            output_dir=str(folder),
            trajectory_name=name,
            save_video=False,
            save_on_reset=False,
            record_reward=False,
            clean_on_close=False,
            source_type="motionplanning",
            source_desc="scripted policy of robocas_ms3",
        )
        self._paths = [folder / f"{name}.h5", folder / f"{name}.json"]
        self.discard()  # nothing is open while the episode is made: a forked child may be the one that writes it

    @property
    def states(self) -> dict[str, dict[str, NDArray[np.float32]]]:
        """ManiSkill's states since the reset: ``{"actors": {name: (S + 1, 13)}, "articulations": {...}}``."""
        buffer: Any = self._trajectory_buffer
        return {kind: {name: array[:, 0] for name, array in found.items()} for kind, found in buffer.state.items()}

    def finish(self, episode: dict[str, Any]) -> None:
        """Write the episode and close the file; the environment stays open.

        Args:
            episode: what ManiSkill's format has no place for: instruction, target, sub-goals.
        """
        self._h5_file = h5py.File(self._paths[0], "w")
        self.flush_trajectory()
        self._h5_file.close()
        data = json.loads(self._paths[1].read_text(encoding="utf-8"))
        info = data["env_info"]
        # With the module's name in front, gymnasium imports this package by itself: ManiSkill's own tools then work.
        info["env_id"] = f"robocas_ms3:{info['env_id']}"
        info["env_kwargs"] = {k: v for k, v in info["env_kwargs"].items() if k not in _LOCAL_KWARGS}
        data.pop("commit_info", None)  # of ManiSkill's checkout, or of whatever repository the user stands in
        base_env: Any = self.base_env
        data["robocas"] = {"control_freq": base_env.control_freq, "sim_freq": base_env.sim_freq, "versions": versions()}
        data["episodes"][0]["robocas"] = episode
        write_json(self._paths[1], data)

    def discard(self) -> None:
        """Close and remove the file; the environment stays open."""
        self._h5_file.close()
        for path in self._paths:
            path.unlink(missing_ok=True)


def versions() -> dict[str, str]:
    """Versions an episode depends on."""
    return {name: version(name) for name in ("robocas-ms3", "mani_skill", "sapien", "mplib", "torch", "numpy")}


def merge(shards: list[Path], out: Path) -> None:
    """Merge trajectory files into one, episodes numbered in the order given; unknown keys of the JSON are kept.

    Args:
        shards: HDF5 files, each with its JSON beside it.
        out: HDF5 file to write; its JSON is written beside it.

    Raises:
        DatasetError: a file can't be read.
    """
    merged: dict[str, Any] = {}
    episodes: list[dict[str, Any]] = []
    with replacing(out) as tmp:
        with h5py.File(tmp, "w") as target:
            for shard in shards:
                data = read_json(shard)
                merged = merged or {key: value for key, value in data.items() if key != "episodes"}
                with open_trajectory(shard) as source:
                    for episode in data["episodes"]:
                        number = len(episodes)
                        source.copy(f"traj_{episode['episode_id']}", target, name=f"traj_{number}")
                        episodes.append({**episode, "episode_id": number})
        # the JSON first: an HDF5 file that is there always has its JSON
        write_json(out.with_suffix(".json"), {**merged, "episodes": episodes})


def open_trajectory(path: Path) -> h5py.File:
    """Open an HDF5 trajectory for reading.

    Raises:
        DatasetError: it is missing, damaged or no HDF5 file.
    """
    try:
        return h5py.File(path, "r")
    except FileNotFoundError as error:
        raise DatasetError("no such trajectory file", where=path) from error
    except OSError as error:
        raise DatasetError(
            "this is no readable HDF5 file; it may have been cut short", where=path, fix="Generate it again."
        ) from error


def read_json(trajectory: Path) -> dict[str, Any]:
    """Read the JSON beside a trajectory.

    Raises:
        DatasetError: it is missing or damaged.
    """
    path = trajectory.with_suffix(".json")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DatasetError("the trajectory's JSON is missing", where=path) from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DatasetError("the trajectory's JSON is damaged", where=path, found=error) from error
