"""A first look at models before they are imported: can they be read, how large are they, of which files are they."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeAlias

from asset_tools.readers.limits import MAX_SECONDS, reading_limits
from asset_tools.readers.model import read_model
from robocas_ms3.core.errors import AssetError, RobocasError
from robocas_ms3.core.workers import FunctionWorker, Limits, WorkerPool

Inspect: TypeAlias = "Callable[[Mapping[str, ModelSource]], Mapping[str, Inspection]]"

log = logging.getLogger(__name__)

GRACE = 5.0  # s after the limit of time, until a process that is stuck in native code is ended
MEMORY_GB = 4.0  # of the process, with all that is imported


@dataclass(frozen=True)
class ModelSource:
    """Where a model is.

    Attributes:
        paths: its folder, its file, or its files where there are several versions.
        root: the imported folder.
    """

    paths: tuple[Path, ...]
    root: Path


@dataclass(frozen=True)
class Inspection:
    """What a first look found.

    Attributes:
        longest: longest side, in the unit of the file; 0 where it can't be read.
        files: that were read.
        error: why it can't be read; None: it can.
    """

    longest: float = 0.0
    files: tuple[Path, ...] = ()
    error: AssetError | None = None


def inspect_models(
    models: Mapping[str, ModelSource], processes: int = 0, on_inspected: Callable[[], None] = lambda: None
) -> dict[str, Inspection]:
    """Look at models, each within 30 s and 2 GB of memory.

    Args:
        models: by id.
        processes: how many look at a time; 0: this process does, and a crash of native code ends it.
        on_inspected: called after each model.

    Returns:
        What was found, by id; models that can't be read have an error.
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
        with reading_limits(source.paths[0]):
            model = read_model(list(source.paths), source.root)
            return id_, Inspection(float(model.mesh.extents.max()), model.files)
    except RobocasError as error:
        return id_, Inspection(error=AssetError(str(error)))
    except Exception as error:  # whatever a parser trips over: one model fails, not the import
        log.debug("%s can't be read", source.paths[0], exc_info=True)
        found = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return id_, Inspection(error=AssetError("can't read this model", where=source.paths[0], found=found))


def _crashed(task: tuple[str, ModelSource], why: str) -> tuple[str, Inspection]:
    id_, source = task
    return id_, Inspection(error=AssetError("the process that read the model died", where=source.paths[0], found=why))
