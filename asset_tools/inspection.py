"""Inspect models before an import: readability, size and files."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeAlias

from asset_tools.readers.limits import MAX_SECONDS, limit_time_and_memory
from asset_tools.readers.model import read_model
from robocas_ms3.core.errors import AssetError, RobocasError
from robocas_ms3.core.workers import FunctionWorker, Limits, WorkerPool

Inspect: TypeAlias = "Callable[[Mapping[str, ModelSource]], Mapping[str, Inspection]]"

log = logging.getLogger(__name__)

GRACE = 5.0  # s after the time limit until a process that hangs in native code is killed
MEMORY_GB = 4.0  # of the whole process, including imported libraries
EXPORT = "Export the mesh again, or skip the model."


@dataclass(frozen=True)
class ModelSource:
    """Paths of a model.

    Attributes:
        paths: one folder, one file, or several files that are versions of one model.
        root: the imported folder, which contains all paths.
    """

    paths: tuple[Path, ...]
    root: Path


@dataclass(frozen=True)
class Inspection:
    """Result of the inspection of a model.

    Attributes:
        longest: longest side of the bounding box in the unit of the file; 0 after an error.
        files: files that were read.
        error: error of reading the model, or None.
    """

    longest: float = 0.0
    files: tuple[Path, ...] = ()
    error: AssetError | None = None


def inspect_models(
    models: Mapping[str, ModelSource], processes: int = 0, on_inspected: Callable[[], None] = lambda: None
) -> dict[str, Inspection]:
    """Read models and measure their size, with limits of 30 s and 2 GB of memory per model.

    Args:
        models: object id -> paths of the model.
        processes: number of worker processes; 0: read in this process, which a crash of native code would end.
        on_inspected: called after each model.

    Returns:
        Object id -> result; the result of an unreadable model has an error.
    """
    limits, found = Limits(MAX_SECONDS + GRACE, MEMORY_GB), {}
    with WorkerPool(partial(FunctionWorker, _inspect), processes, limits=limits, on_crash=_crashed) as pool:
        for id_, inspection in pool.map(models.items(), ordered=False):
            found[id_] = inspection
            on_inspected()
    return {id_: found[id_] for id_ in models}


def _inspect(task: tuple[str, ModelSource]) -> tuple[str, Inspection]:
    id_, source = task
    try:
        with limit_time_and_memory(source.paths[0]):
            model = read_model(list(source.paths), source.root)
            return id_, Inspection(float(model.mesh.extents.max()), model.files)
    except RobocasError as error:
        return id_, Inspection(error=AssetError(str(error)))
    except Exception as error:  # parsers may raise any error; only this model fails
        log.debug("cannot read %s", source.paths[0], exc_info=True)
        found = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return id_, Inspection(error=AssetError("cannot read this model", where=source.paths[0], found=found))


def _crashed(task: tuple[str, ModelSource], reason: str) -> tuple[str, Inspection]:
    id_, source = task
    return id_, Inspection(
        error=AssetError("the process that read the model crashed", where=source.paths[0], found=reason, fix=EXPORT)
    )
