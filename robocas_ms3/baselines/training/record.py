"""Files of a training run, and its record ``run.json``.

::

    run.json                 baseline and version, configuration, facts and hash of the data, package versions, device
    metrics.csv              lines of training and validation
    tensorboard/             the same
    checkpoint.safetensors   the state of the training, see `checkpoints`
    weights.safetensors      weights of the policy
"""

from __future__ import annotations

import hashlib
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.strict_model import StrictModel, parse

RUN, METRICS, TENSORBOARD = "run.json", "metrics.csv", "tensorboard"
CHECKPOINT, WEIGHTS = "checkpoint.safetensors", "weights.safetensors"
BUNDLED = Path(__file__).parents[2] / "data" / "runs"
"""Runs with bundled weights, which have no checkpoints."""
_PACKAGES = ("robocas-ms3", "torch", "accelerate", "safetensors", "transformers", "numpy")
_BLOCK = 1 << 20


class DataRecord(StrictModel):
    """The data of a run.

    Attributes:
        name: of the folder, the file or the scenes.
        hash: see `hash_dataset`.
        episodes, samples: of the training split.
    """

    name: str
    hash: str
    episodes: int
    samples: int


class RunRecord(StrictModel):
    """``run.json``.

    Attributes:
        kind: always this.
        baseline, version: what was trained.
        config: its whole configuration.
        facts: of the data, see `Samples`.
        data: that it was trained on.
        versions: of packages.
        device, precision: of the training; others round differently.
        threads: of the CPU; as many add in the same order. 0: a GPU, or not known.
        resumed: lines on continuations with another device, precision or number of threads.
        start: the run whose weights it started from: folder name and hash; empty: random weights.
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
    resumed: list[str] = []
    start: str = ""

    @property
    def metadata(self) -> dict[str, str]:
        """Metadata of the files with tensors, by which they are of this run."""
        return {"baseline": self.baseline, "version": str(self.version), "dataset": self.data.hash}


def find_run(run: Path) -> Path:
    """Return the folder of a run: a single name is that of bundled weights, if there are such."""
    return BUNDLED / run if len(run.parts) == 1 and (BUNDLED / run).is_dir() else run


def read_run(folder: Path) -> RunRecord:
    """Read the record of a training run, `run.json` in its folder; raise TrainingError if there is none."""
    path = folder / RUN
    if not path.is_file():
        fix = "Name the --out of a `robocas train`."
        raise TrainingError("no run of robocas train", where=folder, expected=RUN, fix=fix)
    try:
        record = load_json(path)
    except ValueError as error:
        raise TrainingError("not readable", where=path, found=error) from error
    if not isinstance(record, dict) or record.get("kind") != RunRecord.model_fields["kind"].default:
        raise TrainingError("no run of robocas train", where=path, expected="kind robocas training run")
    return parse(RunRecord, record, TrainingError, where=path)


def package_versions() -> dict[str, str]:
    return {name: version(name) for name in _PACKAGES}


def hash_dataset(data: Path) -> str:
    """Return a SHA-256 hash of a dataset.

    Hashed are the bytes of a trajectory and of the JSON next to it; of a folder the JSON files, tables, arrays and the
    sizes of all files.
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
        raise TrainingError("no dataset here", where=data, expected="a dataset's folder or trajectory.h5")
    return digest.hexdigest()


def hash_weights(folder: Path) -> str:
    """Return a SHA-256 hash of the weights of a run; empty: there are none yet."""
    path, digest = folder / WEIGHTS, hashlib.sha256()
    if not path.is_file():
        return ""
    _hash_file(digest, path)
    return digest.hexdigest()


def _hash_file(digest: Any, path: Path) -> None:
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
