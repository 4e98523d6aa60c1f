"""`bc-state`: behaviour cloning of action chunks from privileged state, without images."""

from __future__ import annotations

import hashlib
from contextlib import closing, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import nn

from robocas_ms3.baselines.baseline import (
    Baseline,
    BaselineConfig,
    Batch,
    OnRead,
    Split,
    TrainSettings,
    make_empty_split_error,
)
from robocas_ms3.baselines.chunks import (
    ROW,
    ChunkPolicy,
    Normalizer,
    compute_chunk_losses,
    compute_normalizer_statistics,
    encode_chunks,
    encode_next_key_poses,
    encode_proprioception,
)
from robocas_ms3.baselines.dataset_checks import check_base_is_fixed
from robocas_ms3.baselines.training.record import hash_dataset
from robocas_ms3.baselines.training.scenes import read_training_scenes
from robocas_ms3.core.documents import DAMAGED_FILE_ERRORS
from robocas_ms3.core.errors import DatasetError, EvaluationError
from robocas_ms3.core.files import atomic_file
from robocas_ms3.core.paths import cache_dir
from robocas_ms3.core.poses import from_wxyz
from robocas_ms3.datasets.formats import open_source
from robocas_ms3.datasets.sources.split import split_by_seed
from robocas_ms3.demos.recordings.motion import sample_states, sample_stride
from robocas_ms3.demos.recordings.trajectory_file import TrajectoryFile
from robocas_ms3.evaluation.policy import Observations, PolicySpec, concatenate_privileged_state
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.robots.quantities import GRIPPER_WIDTH

_CACHE_VERSION = 4
_PACKAGES = ("robocas-ms3", "mani_skill", "sapien")
_MIN_DEVIATION = 1e-2  # smallest deviation of an input: nearly constant inputs must not be scaled up


class BcStateConfig(BaselineConfig):
    """Configuration of `bc-state`.

    Attributes:
        rate_hz: policy steps per second.
        chunk: number of predicted policy steps.
        width: size of the hidden layers.
        blocks: number of residual blocks; each has two linear layers.
        dropout: dropout rate in the blocks.
        noise: standard deviation of the noise that training adds to the normalised inputs.
        keys_weight, gripper_weight: loss weights of the next key pose and of the gripper commands.
        near_distance: distance in m at which the loss weight of a pose is half of its weight at 0 m, see
            `compute_chunk_losses`; 0: equal weights.
        n_action_steps: policy steps of a chunk that are executed before the next prediction.
        temporal_ensemble_coeff: decay of the weight of older predictions per policy step, see `ChunkPolicy`.
        train: see `TrainSettings`.
    """

    rate_hz: float = Field(default=5.0, gt=0, le=100)
    chunk: int = Field(default=8, ge=1, le=1000)
    width: int = Field(default=384, ge=8, le=16384)
    blocks: int = Field(default=4, ge=1, le=1000)
    dropout: float = Field(default=0.1, ge=0, lt=1)
    noise: float = Field(default=0.02, ge=0)
    keys_weight: float = Field(default=0.5, ge=0)
    gripper_weight: float = Field(default=0.5, ge=0)
    near_distance: float = Field(default=0.0, ge=0)
    n_action_steps: int = Field(default=1, ge=1, le=1000)
    temporal_ensemble_coeff: float = Field(default=0.5, ge=0)
    train: TrainSettings = TrainSettings(
        steps=20_000, batch_size=256, learning_rate=1e-3, weight_decay=0.01, precision="fp32"
    )


class StateSamples:
    """Training samples of `bc-state`, one per policy step of a split of a trajectory file.

    A batch has ``inputs`` (B, D) of `make_inputs`, and the labels ``chunk`` (B, K, 10) and ``key`` (B, 9) of `chunks`.
    """

    def __init__(self, config: BcStateConfig, path: Path, split: Split, on_read: OnRead) -> None:
        arrays = load_cached_states(path, config.rate_hz, on_read)
        train, val = split_by_seed(dict(enumerate(arrays["seeds"].tolist())))
        numbers = train if split == "train" else val
        self.episodes = len(numbers)
        if not numbers:
            raise make_empty_split_error(path, split)
        with closing(open_source(path)) as source:
            self.scenes = read_training_scenes(source, source.numbers)
        ends = np.cumsum(arrays["lengths"])
        rows = [slice(int(ends[number] - arrays["lengths"][number]), int(ends[number])) for number in numbers]
        poses, opened, intended = arrays["poses"], arrays["opened"], arrays["intended_poses"]
        self._chunks = _concatenate(
            [encode_chunks(poses[row], opened[row], config.chunk, intended[row]) for row in rows]
        )
        self._keys = _concatenate([encode_next_key_poses(poses[row], opened[row], intended[row]) for row in rows])
        self._inputs = _concatenate(
            [make_inputs(arrays["state"][row], poses[row], arrays["widths"][row]) for row in rows]
        )
        values = self._inputs.numpy()
        deviation = np.maximum(values.std(0), _MIN_DEVIATION)
        self.facts: dict[str, Any] = {
            "rate_hz": config.rate_hz,
            "inputs": {"mean": values.mean(0).tolist(), "deviation": deviation.tolist()},
            "chunk": compute_normalizer_statistics(self._chunks[..., :9].numpy()),
            "keys": compute_normalizer_statistics(self._keys.numpy()),
        }

    def __len__(self) -> int:
        return len(self._inputs)

    def __getitems__(self, indices: list[int]) -> Batch:
        rows = torch.tensor(indices)
        return {"inputs": self._inputs[rows], "chunk": self._chunks[rows], "key": self._keys[rows]}


def make_inputs(
    state: NDArray[np.floating], poses: NDArray[np.floating], widths: NDArray[np.floating]
) -> NDArray[np.float32]:
    """Return the inputs of the network (N, D + 10): privileged state (N, D), then proprioception (N, 10).

    poses: (N, 4, 4) TCP poses in the arm's base frame. widths: (N,) gripper widths, m.
    """
    return np.concatenate([state, encode_proprioception(poses, widths)], axis=1).astype(np.float32)


def _concatenate(parts: list[NDArray[np.float32]]) -> torch.Tensor:
    return torch.from_numpy(np.concatenate(parts))


def load_cached_states(path: Path, rate_hz: float, on_read: OnRead) -> dict[str, NDArray[Any]]:
    """Return the arrays of `read_states`, from the cache if it has them; otherwise read and cache them.

    Reading 1000 episodes takes minutes.
    """
    if path.is_dir() or path.suffix != ".h5":
        fix = "Pass the trajectory.h5 of `robocas generate`."
        found = "a folder" if path.is_dir() else path.name
        raise DatasetError("wrong input of bc-state", where=path, expected="a trajectory.h5", found=found, fix=fix)
    cached = _cache_path(path, rate_hz)
    if cached.is_file():
        with suppress(*DAMAGED_FILE_ERRORS), np.load(cached) as arrays:
            return dict(arrays)
    arrays = read_states(path, rate_hz, on_read)
    with atomic_file(cached) as tmp:
        np.savez(tmp, **arrays)  # pyright: ignore[reportArgumentType]  (its stub takes no mapping)
    return arrays


def _cache_path(path: Path, rate_hz: float) -> Path:
    digest = hashlib.sha256(f"{_CACHE_VERSION} {rate_hz!r}\n".encode())
    for file in (path, path.with_suffix(".json")):
        digest.update(f"{hash_dataset(file) if file.is_file() else None}\n".encode())
    for package in _PACKAGES:
        digest.update(f"{package} {version(package)}\n".encode())
    return cache_dir() / "bc-state" / f"{digest.hexdigest()[:32]}.npz"


def read_states(path: Path, rate_hz: float, on_read: OnRead) -> dict[str, NDArray[Any]]:
    """Read the privileged state of each policy step of the successful episodes of a trajectory file.

    The recorded state of a step is set in the environment of the recording, which computes the privileged state.

    Returns:
        Per policy step: ``state`` (N, D), ``poses`` (N, 4, 4) of the TCP in the arm's base frame, ``intended_poses``
        (N, 4, 4) without action noise, ``opened`` (N,) gripper commands (1 = open), ``widths`` (N,) of the gripper in
        m. Per episode: ``lengths`` in policy steps, ``seeds``.
    """
    names = ("state", "poses", "intended_poses", "opened", "widths")
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in names}
    lengths, seeds, env = [], [], None
    with TrajectoryFile(path) as file:
        stride = sample_stride(file.control_freq, rate_hz)
        try:
            for index, entry in enumerate(file.episodes):
                on_read(index, len(file.episodes))
                if not entry.get("success", True):
                    continue
                recording = file.read_recording(index)
                where = f"{path}, episode {recording.episode_id}"
                samples = sample_states(recording.control_steps, stride)
                motion = recording.compute_motion(samples)
                check_base_is_fixed(np.diff(motion.qpos[:, RobotDescription.base_slice], axis=0), where)
                if env is None:
                    env = file.env.make(obs_mode="state_dict", render_backend="none", reward_mode="none")
                env.reset(seed=recording.seed, options=dict(recording.reset_options))
                rows = [_read_privileged_state(env.unwrapped, recording.state(int(sample))) for sample in samples]
                if parts["state"] and parts["state"][0].shape[1] != len(rows[0]):
                    expected, found = (f"{size} numbers" for size in (parts["state"][0].shape[1], len(rows[0])))
                    what, fix = (
                        "privileged states of different sizes",
                        "Record all episodes with one task configuration.",
                    )
                    raise DatasetError(what, where=where, expected=expected, found=found, fix=fix)
                parts["state"].append(np.stack(rows))
                intended = motion.intended_tcp_in_base
                parts["poses"].append(motion.tcp_in_base)
                parts["intended_poses"].append(motion.tcp_in_base if intended is None else intended)
                parts["opened"].append(motion.gripper_open)
                parts["widths"].append(motion.qpos[:, -2:].sum(1))
                lengths.append(len(samples))
                seeds.append(recording.seed)
        finally:
            if env is not None:
                env.close()
    if not lengths:
        fix = "Record demonstrations: robocas generate TASK --out DIR."
        raise DatasetError("no successful episode in the trajectory file", where=path, fix=fix)
    arrays = {name: np.concatenate(part) for name, part in parts.items()}
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise DatasetError("NaN or infinite value", where=f"{path}, {name}", fix="Record the trajectory again.")
    return {**arrays, "lengths": np.array(lengths), "seeds": np.array(seeds)}


def _read_privileged_state(env: Any, state: dict[str, dict[str, NDArray[np.float32]]]) -> NDArray[np.float32]:
    env.set_state_dict({kind: {k: torch.from_numpy(v) for k, v in arrays.items()} for kind, arrays in state.items()})
    return concatenate_privileged_state(env.get_obs({})["extra"])[0]


class BcStateModel(nn.Module):
    """Network of `bc-state`: a residual MLP that predicts a chunk and the next key pose from the inputs."""

    def __init__(self, config: BcStateConfig, facts: dict[str, Any]) -> None:
        super().__init__()
        self.config, width = config, config.width
        self.input_scale = Normalizer(**facts["inputs"])
        self.chunk_scale, self.key_scale = Normalizer(**facts["chunk"]), Normalizer(**facts["keys"])
        self.into = nn.Linear(len(facts["inputs"]["mean"]), width)
        self.blocks = nn.ModuleList(
            nn.Sequential(
                nn.LayerNorm(width),
                nn.Linear(width, 2 * width),
                nn.GELU(),
                nn.Dropout(config.dropout),
                nn.Linear(2 * width, width),
            )
            for _ in range(config.blocks)
        )
        self.out = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, config.chunk * ROW + 9))

    def predict(self, inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return predicted chunks (B, K, 10) and next key poses (B, 9) for inputs (B, D).

        Poses are normalised. The last column of a chunk has the logits of the command to open the gripper.
        """
        scaled = self.input_scale(inputs).clamp(-5, 5)
        if self.training and self.config.noise:
            scaled = scaled + self.config.noise * torch.randn_like(scaled)
        hidden = self.into(scaled)
        for block in self.blocks:
            hidden = hidden + block(hidden)
        out = self.out(hidden).float()
        return out[:, :-9].reshape(len(inputs), self.config.chunk, ROW), out[:, -9:]

    def forward(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Return the losses and metrics of `compute_chunk_losses` for a batch of `StateSamples`."""
        return compute_chunk_losses(self, batch, *self.predict(batch["inputs"]))

    def act(self, inputs: torch.Tensor) -> torch.Tensor:
        """Return predicted chunks (B, K, 10) for inputs (B, D).

        The last column has the probabilities of the command to open the gripper.
        """
        chunk, _ = self.predict(inputs)
        return torch.cat([self.chunk_scale.inverse(chunk[..., :9]), chunk[..., 9:].sigmoid()], dim=-1)


def make_policy(config: BcStateConfig, facts: dict[str, Any], model: BcStateModel) -> ChunkPolicy:
    """Make the policy of a trained network; it runs on the device of the weights."""
    device, size = next(model.parameters()).device, len(facts["inputs"]["mean"])

    def predict(observations: Observations, row: int) -> NDArray[np.floating]:
        assert observations.state is not None
        one = slice(row, row + 1)
        inputs = make_inputs(
            observations.state[one],
            from_wxyz(observations.tcp_in_base[one]),
            observations.robot[GRIPPER_WIDTH].reshape(-1)[one],
        )
        if inputs.shape[1] != size:
            what, fix = "wrong size of privileged state", "Evaluate in the task and configuration of the training data."
            raise EvaluationError(what, where="bc-state", expected=f"{size} numbers", found=inputs.shape[1], fix=fix)
        with torch.inference_mode():
            return model.act(torch.from_numpy(inputs).to(device))[0].cpu().numpy()

    spec = PolicySpec("robocas", reference="tcp", rate_hz=facts["rate_hz"], state=True, language="none")
    return ChunkPolicy(spec, predict, min(config.n_action_steps, config.chunk), config.temporal_ensemble_coeff)


BASELINE = Baseline("bc-state", 1, BcStateConfig, BcStateModel, make_policy, StateSamples)
