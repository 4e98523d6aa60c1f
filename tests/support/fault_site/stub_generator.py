"""Replacement of `robocas_ms3.demos.generator`: empty episodes, without a simulator."""

import json

import h5py

from robocas_ms3.demos.failures import EpisodeResult


class EpisodeGenerator:
    def __init__(self, settings, *, fork=True):
        pass

    def generate(self, seed, folder, name, intervention=None):
        path = folder / f"{name}.h5"
        with h5py.File(path, "w") as file:
            file.create_group("traj_0").attrs["seed"] = seed
        record = {"attempts": 1, "failed_attempts": [], "seconds": {}}
        episode = {"episode_id": 0, "episode_seed": seed, "elapsed_steps": 10, "robocas": record}
        about = {"env_info": {"env_id": "X-v1", "env_kwargs": {}}, "episodes": [episode]}
        path.with_suffix(".json").write_text(json.dumps(about))
        return EpisodeResult(seed, True, 10, 1)

    def close(self):
        pass
