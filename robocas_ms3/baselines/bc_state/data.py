"""What a simulator knew at each step of recorded episodes: their environment is put into these states, and asked.

That takes some minutes for a thousand episodes; what came of it is kept among the caches.
"""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.baselines.baseline import Batch, OnRead, Split
from robocas_ms3.baselines.bc_state.config import BcStateConfig
from robocas_ms3.baselines.chunks.poses import encode, next_keys, spread, state_of
from robocas_ms3.baselines.dataset_checks import check_base_stands
from robocas_ms3.baselines.training.record import hash_dataset
from robocas_ms3.core.documents import DAMAGED
from robocas_ms3.core.errors import DatasetError, EmptySplitError
from robocas_ms3.core.files import replacing
from robocas_ms3.core.paths import cache_dir
from robocas_ms3.datasets.sources.split import split_by_seed
from robocas_ms3.demos.recordings.motion import sample_states, sample_stride
from robocas_ms3.demos.recordings.reading import TrajectoryFile
from robocas_ms3.demos.recordings.versions import versions
from robocas_ms3.evaluation.policy import privileged
from robocas_ms3.robots.description import RobotDescription

_VERSION = 2  # of what is kept
_PACKAGES = ("robocas-ms3", "mani_skill", "sapien")
_LEAST = 1e-2  # deviation; what hardly ever changes says little, and must not be blown up


class StateSamples:
    """Samples of `bc-state`, one of every step.

    Args:
        config: what is predicted.
        path: ``trajectory.h5``.
        split: of its seeds, as a conversion has them.
        on_read: see `Baseline.data`.

    Raises:
        DatasetError: it is no trajectory file, its scenes hold different numbers of things, or its base drives.
    """

    def __init__(
        self, config: BcStateConfig, path: Path, split: Split, on_read: OnRead = lambda done, of: None
    ) -> None:
        told = _told(path, config.rate_hz, on_read)
        seeds = told["seeds"].tolist()
        sides = split_by_seed({number: seed for number, seed in enumerate(seeds)})
        numbers = sides[0 if split == "train" else 1]
        self.episodes = len(numbers)
        if not numbers:
            fix = "Add episodes: a tenth of them validates."
            raise EmptySplitError("this split holds no episodes", where=path, expected=f"some in {split}", fix=fix)
        first = np.concatenate([[0], np.cumsum(told["lengths"])])
        rows = [slice(int(first[number]), int(first[number + 1])) for number in numbers]
        poses, opened = told["poses"], told["opened"]
        self._chunks = _joined([encode(poses[row], opened[row], config.chunk) for row in rows])
        self._keys = _joined([next_keys(poses[row], opened[row]) for row in rows])
        self._told = _joined([inputs(told["told"][row], poses[row], told["widths"][row]) for row in rows])
        values = self._told.numpy()
        self.facts: dict[str, Any] = {
            "rate_hz": config.rate_hz,
            "inputs": {
                "mean": values.mean(0).tolist(),
                "deviation": np.maximum(values.std(0), _LEAST).tolist(),
            },
            "chunk": spread(self._chunks[..., :9].numpy()),
            "keys": spread(self._keys.numpy()),
        }

    def __len__(self) -> int:
        return len(self._told)

    def __getitems__(self, indices: list[int]) -> Batch:
        """A batch: ``told``, and what is to be predicted: ``chunk``, ``key``."""
        rows = torch.tensor(indices)
        return {"told": self._told[rows], "chunk": self._chunks[rows], "key": self._keys[rows]}


def inputs(
    told: NDArray[np.floating], poses: NDArray[np.floating], widths: NDArray[np.floating]
) -> NDArray[np.float32]:
    """(N, D + 10) what a simulator knows (N, D), and what the arm feels (`state_of`)."""
    return np.concatenate([told, state_of(poses, widths)], axis=1).astype(np.float32)


def _joined(parts: list[NDArray[np.float32]]) -> torch.Tensor:
    return torch.from_numpy(np.concatenate(parts))


def _told(path: Path, rate_hz: float, on_read: OnRead) -> dict[str, NDArray[Any]]:
    """What is kept of a trajectory file, or what it says now."""
    if path.is_dir() or path.suffix != ".h5":
        fix = "Name the trajectory.h5 of robocas generate."
        raise DatasetError("bc-state learns from recorded states", where=path, expected="a trajectory.h5", fix=fix)
    kept = _kept(path, rate_hz)
    if kept.is_file():
        with suppress(*DAMAGED), np.load(kept) as arrays:  # what is damaged is made anew
            return dict(arrays)
    told = _ask(path, rate_hz, on_read)
    with replacing(kept) as tmp:
        np.savez(tmp, **told)  # pyright: ignore[reportArgumentType]  (its stub takes no mapping)
    return told


def _kept(path: Path, rate_hz: float) -> Path:
    """Where it is kept, named by all that it follows from; runs that make it at once write the same."""
    digest = hashlib.sha256(f"{_VERSION} {rate_hz!r}\n".encode())
    for file in (path, path.with_suffix(".json")):  # states; environment, seeds, options of resets
        digest.update(f"{hash_dataset(file) if file.is_file() else None}\n".encode())
    for package in _PACKAGES:
        digest.update(f"{package} {versions()[package]}\n".encode())
    return cache_dir() / "bc-state" / f"{digest.hexdigest()[:32]}.npz"


def _ask(path: Path, rate_hz: float, on_read: OnRead) -> dict[str, NDArray[Any]]:
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in ("told", "poses", "opened", "widths")}
    lengths, seeds, env = [], [], None
    with TrajectoryFile(path) as file:
        stride = sample_stride(file.control_freq, rate_hz)
        try:
            for index, entry in enumerate(file.episodes):
                on_read(index, len(file.episodes))
                if not entry.get("success", True):
                    continue
                recording = file.recording(index)
                samples = sample_states(recording.control_steps, stride)
                motion = recording.motion(samples)
                driven = np.diff(motion.qpos[:, RobotDescription.base_slice], axis=0)
                check_base_stands(driven, f"{path}, episode {recording.episode_id}")
                if env is None:
                    env = file.env.make(obs_mode="state_dict", render_backend="none", reward_mode="none")
                env.reset(seed=recording.seed, options=dict(recording.reset_options))
                base: Any = env.unwrapped
                rows = [_row(base, recording.state(int(sample))) for sample in samples]
                if parts["told"] and parts["told"][0].shape[1] != len(rows[0]):
                    expected, found = parts["told"][0].shape[1], len(rows[0])
                    where = f"{path}, episode {recording.episode_id}"
                    raise DatasetError("other things stand in this scene", where=where, expected=expected, found=found)
                parts["told"].append(np.stack(rows))
                parts["poses"].append(motion.tcp_in_base)
                parts["opened"].append(motion.gripper_open)
                parts["widths"].append(motion.qpos[:, -2:].sum(1))
                lengths.append(len(samples))
                seeds.append(recording.seed)
        finally:
            if env is not None:
                env.close()
    if not lengths:
        raise DatasetError("no successful episodes", where=path)
    joined = {name: np.concatenate(part) for name, part in parts.items()}
    for name, array in joined.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise DatasetError("not a number", where=f"{path}, {name}", fix="robocas validate says more.")
    return {**joined, "lengths": np.array(lengths), "seeds": np.array(seeds)}


def _row(env: Any, state: dict[str, dict[str, NDArray[np.float32]]]) -> NDArray[np.float32]:
    env.set_state_dict({kind: {k: torch.from_numpy(v) for k, v in arrays.items()} for kind, arrays in state.items()})
    return privileged(env.get_obs({})["extra"])[0]
