"""A run's folder: what was trained, on what, how it went, and the weights.

::

    run.json                 baseline and its version, configuration, facts and hash of the data, versions, device
    metrics.csv              a line every so many steps, of training and of validation
    tensorboard/             the same
    checkpoint.safetensors   all that it takes to go on: see `checkpoints`
    weights.safetensors      what a policy acts with
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, Literal

from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.strict import StrictModel, parse

RUN, METRICS, BOARD = "run.json", "metrics.csv", "tensorboard"
CHECKPOINT, WEIGHTS = "checkpoint.safetensors", "weights.safetensors"
SHIPPED = Path(__file__).parents[1] / "data" / "runs"
"""Runs that come with the package, without what it takes to go on with them."""
_BLOCK = 1 << 20


class DataRecord(StrictModel):
    """What a run was trained on.

    Attributes:
        name: of the folder or file.
        hash: see `hash_of`.
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
        config: its configuration, whole.
        facts: of the data, see `Samples`.
        data: it was trained on.
        versions: of packages.
        device, precision: it was trained on and in; another may round otherwise.
        threads: of the processor it was trained on; as many add up in the same order. 0: a GPU, or not known.
        resumed: lines on where it went on with others of these.
        start: the run whose weights it began with: its folder's name and their hash; empty: none.
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


def find_run(run: Path) -> Path:
    """The folder of a run; one that comes with the package goes by its name, as where policies are named.

    A folder of that name is meant by a path of more parts.
    """
    return SHIPPED / run if len(run.parts) == 1 and (SHIPPED / run).is_dir() else run


def read_run(folder: Path) -> RunRecord:
    """The record of a run.

    Raises:
        TrainingError: there is none, or it is damaged.
    """
    path = folder / RUN
    if not path.is_file():
        fix = "Name the --out of a `robocas train`."
        raise TrainingError("no run of robocas train", where=folder, expected=RUN, fix=fix)
    try:
        found = load_json(path)
    except ValueError as error:
        raise TrainingError("not readable", where=path, found=error) from error
    if not isinstance(found, dict) or found.get("kind") != RunRecord.model_fields["kind"].default:
        raise TrainingError("no run of robocas train", where=path, expected="kind robocas training run")
    return parse(RunRecord, found, TrainingError, where=path)


def hash_of(data: Path) -> str:
    """A hash (SHA-256) of a dataset.

    Of a trajectory its bytes and those of the JSON beside it; of a folder its overviews, arrays, calibrations, and
    pictures' sizes.

    Raises:
        TrainingError: there is nothing.
    """
    digest = hashlib.sha256()
    if data.is_file():
        _take(digest, data)
        if (beside := data.with_suffix(".json")).is_file():
            _take(digest, beside)
    elif data.is_dir():
        for path in sorted(path for path in data.rglob("*") if path.is_file()):
            name = path.relative_to(data).as_posix()
            if name.startswith("preview/") or path.name.startswith("."):
                continue
            digest.update(f"{name} {path.stat().st_size}\n".encode())
            if path.suffix in {".json", ".npz", ".npy", ".parquet"}:
                _take(digest, path)
    else:
        raise TrainingError("no dataset here", where=data, expected="a dataset's folder or trajectory.h5")
    return digest.hexdigest()


def hash_of_weights(folder: Path) -> str:
    """A hash (SHA-256) of what a run acts with; empty: there is nothing yet."""
    path, digest = folder / WEIGHTS, hashlib.sha256()
    if not path.is_file():
        return ""
    _take(digest, path)
    return digest.hexdigest()


def _take(digest: Any, path: Path) -> None:
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
