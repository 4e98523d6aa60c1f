"""Sample layouts: in this process, or in a worker process where PhysX would let objects come to rest elsewhere."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from functools import partial
from typing import Any, NoReturn

from sapien import physx

from robocas_ms3.core.errors import SimulationError
from robocas_ms3.core.workers import FunctionWorker, WorkerPool
from robocas_ms3.scenes.layout import Layout, ObjectIds
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.sample import sample_layout

LayoutSource = Callable[[int, int], Layout]
"""(objects seed, seed) -> layout."""


class Sampler:
    """Samples layouts, the same ones in every process.

    Where PhysX has a GPU it cooks hulls otherwise, on a CPU too, and heaps come to rest elsewhere. There a worker
    process samples the layouts; it ends with this object.

    Args:
        model: the scene's assets.
    """

    def __init__(self, model: SceneModel) -> None:
        self._model = model
        self._pool: WorkerPool[tuple[int, int, ObjectIds | None], Layout] | None = None
        self._object_ids: dict[int, ObjectIds] = {}

    def __call__(self, objects_seed: int, seed: int) -> Layout:
        """The layout of two seeds; see `sample_layout`."""
        if objects_seed == seed:
            return self.make(seed, seed)
        if objects_seed not in self._object_ids:
            self._object_ids[objects_seed] = self.make(objects_seed, objects_seed).object_ids
        return self.make(objects_seed, seed, self._object_ids[objects_seed])

    def make(self, objects_seed: int, seed: int, object_ids: ObjectIds | None = None) -> Layout:
        """The same, of objects that are known if the seeds differ.

        Raises:
            LayoutError: there is none.
            SimulationError: the worker process died, and another one too.
        """
        if not physx.is_gpu_enabled():
            return sample_layout(self._model, objects_seed, seed, object_ids)
        if self._pool is None:
            make_worker = partial(FunctionWorker, partial(_sample, self._model))
            self._pool = WorkerPool(make_worker, 1, on_crash=_raise_crash)
            weakref.finalize(self, self._pool.stop)
        return self._pool.run((objects_seed, seed, object_ids))

    def __getstate__(self) -> dict[str, Any]:
        """Without the worker process."""
        return {**self.__dict__, "_pool": None}


def _sample(model: SceneModel, task: tuple[int, int, ObjectIds | None]) -> Layout:
    return sample_layout(model, *task)


def _raise_crash(task: tuple[int, int, ObjectIds | None], reason: str) -> NoReturn:
    # not a `LayoutError`: another seed would not help
    raise SimulationError("the process that samples layouts died", where=f"seed {task[1]}", found=reason)
