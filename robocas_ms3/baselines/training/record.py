"""Files of a training run, and its record ``run.json``.

::

    run.json                 record of the run, see `RunRecord`
    metrics.csv              training and validation metrics
    tensorboard/             the same metrics as TensorBoard events
    checkpoint.safetensors   state of the training, see `checkpoints`
    weights.safetensors      weights of the policy
"""

from __future__ import annotations

import hashlib
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from robocas_ms3.baselines.training.scenes import TrainingScenes
from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.strict_model import StrictModel, parse

RUN, METRICS, TENSORBOARD = "run.json", "metrics.csv", "tensorboard"
CHECKPOINT, WEIGHTS = "checkpoint.safetensors", "weights.safetensors"
BUNDLED = Path(__file__).parents[2] / "data" / "runs"
"""Folder of the bundled runs, which have weights and no checkpoint."""
_PACKAGES = ("robocas-ms3", "torch", "accelerate", "safetensors", "transformers", "numpy")
_BLOCK = 1 << 20


class DataRecord(StrictModel):
    """Training data of a run.

    Attributes:
        name: name of the folder, file or scenes.
        hash: hash of the data, see `hash_dataset`.
        episodes, samples: size of the training split.
        scenes: tasks, objects and scene settings of the training split.
    """

    name: str
    hash: str
    episodes: int
    samples: int
    scenes: TrainingScenes = TrainingScenes()


class RunRecord(StrictModel):
    """Content of ``run.json``.

    Attributes:
        kind: constant that identifies the file.
        baseline, version: the baseline and the version of its weights.
        config: the complete configuration.
        facts: facts of the training data, see `Samples`.
        data: the training data.
        versions: versions of packages.
        device, precision: device and precision of the training, which determine rounding.
        threads: number of CPU threads, which determines the order of sums; 0: a GPU, or not known.
        hardware_changes: one line per continuation with another device, precision or number of threads.
        init_from: run of the initial weights: folder name and hash; empty: random weights.
    """

    kind: Literal["robocas training run"] = "robocas training run"
    baseline: str
    version: int
    config: dict[str, Any]
    facts: dict[str, Any]
    data: DataRecord
    versions: dict[str, str]
    device: str
    precision: str
    threads: int = 0
    hardware_changes: list[str] = []
    init_from: str = ""

    @property
    def metadata(self) -> dict[str, str]:
        """Return the metadata that its tensor files must have."""
        return {"baseline": self.baseline, "version": str(self.version), "dataset": self.data.hash}


def find_run(run: Path) -> Path:
    """Return the folder of a run; the name of a bundled run means the bundled run."""
    return BUNDLED / run if len(run.parts) == 1 and (BUNDLED / run).is_dir() else run


def read_run(folder: Path) -> RunRecord:
    """Read the record of a training run, `run.json` in its folder; raise TrainingError if there is none."""
    path = folder / RUN
    if not path.is_file():
        fix = "Pass the --out folder of `robocas train`."
        raise TrainingError("not a training run", where=folder, expected=RUN, fix=fix, usage=True)
    try:
        record = load_json(path)
    except ValueError as error:
        raise TrainingError("unreadable file", where=path, found=error) from error
    if not isinstance(record, dict) or record.get("kind") != RunRecord.model_fields["kind"].default:
        raise TrainingError("not a training run", where=path, expected="kind robocas training run")
    return parse(RunRecord, record, TrainingError, where=path)


def package_versions() -> dict[str, str]:
    """Return the versions of the packages that a training depends on."""
    return {name: version(name) for name in _PACKAGES}


def hash_dataset(data: Path) -> str:
    """Return the hex SHA-256 of a dataset.

    For a trajectory: of the bytes of the file and of the JSON next to it. For a folder: of JSON files, tables, arrays,
    and the sizes of all files.
    """
    digest = hashlib.sha256()
    if data.is_file():
        _hash_file(digest, data)
        if (description := data.with_suffix(".json")).is_file():
            _hash_file(digest, description)
    elif data.is_dir():
        for path in sorted(path for path in data.rglob("*") if path.is_file()):
            name = path.relative_to(data).as_posix()
            if name.startswith("preview/") or path.name.startswith("."):
                continue
            digest.update(f"{name} {path.stat().st_size}\n".encode())
            if path.suffix in {".json", ".npz", ".npy", ".parquet"}:
                _hash_file(digest, path)
    else:
        raise TrainingError("no such dataset", where=data, expected="a dataset folder or a trajectory.h5", usage=True)
    return digest.hexdigest()


def hash_weights(folder: Path) -> str:
    """Return the hex SHA-256 of the weights of a run; empty if there are none yet."""
    path, digest = folder / WEIGHTS, hashlib.sha256()
    if not path.is_file():
        return ""
    _hash_file(digest, path)
    return digest.hexdigest()


def _hash_file(digest: Any, path: Path) -> None:
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
