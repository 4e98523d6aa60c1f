"""Layouts made anew: here, or in a process of its own where PhysX would make others here."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import weakref
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from sapien import physx

from robocas_ms3.core.errors import LayoutError, SimulationError
from robocas_ms3.scenes.layout import Layout, ObjectIds
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.sample import sample_layout

LayoutSource = Callable[[int, int], Layout]
"""(objects seed, seed) -> layout."""

_GRACE = 0.5  # s to leave in

# What libraries print must not get among the answers. No `multiprocessing`: it would run the program's main part again.
_PROGRAM = """
import os, pickle, sys
answers = os.fdopen(os.dup(1), "wb")
os.dup2(2, 1)
from robocas_ms3.core.errors import LayoutError
from robocas_ms3.scenes.sample import sample_layout
model = pickle.load(sys.stdin.buffer)
while True:
    try:
        order = pickle.load(sys.stdin.buffer)
    except EOFError:
        break
    try:
        answer = sample_layout(model, *order)
    except LayoutError as error:
        answer = error
    pickle.dump(answer, answers)
    answers.flush()
os._exit(0)  # without what torch and SAPIEN do in the end, which takes longer than it is given
"""


class Sampler:
    """Makes layouts anew, the same ones in every process.

    Where PhysX has a GPU it cooks hulls otherwise, on a CPU too, and heaps come to rest elsewhere. So such a process
    has another one make them.

    Args:
        model: the scene's assets.
    """

    def __init__(self, model: SceneModel) -> None:
        self._model = model
        self._elsewhere: OtherProcess | None = None
        self._object_ids: dict[int, ObjectIds] = {}

    def __call__(self, objects_seed: int, seed: int) -> Layout:
        """The layout of two seeds; see `sample_layout`."""
        if objects_seed == seed:
            return self.make(seed, seed)
        if objects_seed not in self._object_ids:
            self._object_ids[objects_seed] = self.make(objects_seed, objects_seed).object_ids
        return self.make(objects_seed, seed, self._object_ids[objects_seed])

    def make(self, objects_seed: int, seed: int, object_ids: ObjectIds | None = None) -> Layout:
        """The same, of objects that are known if the seeds differ."""
        if not physx.is_gpu_enabled():
            return sample_layout(self._model, objects_seed, seed, object_ids)
        if self._elsewhere is None:
            self._elsewhere = OtherProcess(self._model)
        try:
            return self._elsewhere.layout(objects_seed, seed, object_ids)
        except LayoutError:
            raise
        except BaseException:  # such as an interrupt: its answer would be taken for that to the next question
            self._elsewhere = None
            raise

    def __getstate__(self) -> dict[str, Any]:
        """Without the other process."""
        return {**self.__dict__, "_elsewhere": None}


class OtherProcess:
    """Makes layouts of a model in a process that is started once and ends with this object.

    Args:
        model: the scene's assets.
    """

    def __init__(self, model: SceneModel) -> None:
        path = os.pathsep.join(filter(None, sys.path))
        self._process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # an interrupt from the keyboard is not its to deal with
            env={**os.environ, "PYTHONPATH": path},
        )
        weakref.finalize(self, _stop, self._process)
        with suppress(BrokenPipeError):  # it died at once, as the first layout will tell
            self._send(model)

    def layout(self, objects_seed: int, seed: int, object_ids: ObjectIds | None = None) -> Layout:
        """The layout of two seeds; see `sample.sample_layout`.

        Raises:
            LayoutError: there is none.
            SimulationError: the process died.
        """
        assert self._process.stdout is not None
        try:
            self._send((objects_seed, seed, object_ids))
            answer: Any = pickle.load(self._process.stdout)
        except (EOFError, OSError) as error:  # not a `LayoutError`: another seed would not help
            found = f"exit code {self._process.wait()}"
            raise SimulationError("the process that makes layouts died", where=f"seed {seed}", found=found) from error
        if isinstance(answer, LayoutError):
            raise answer
        return answer

    def _send(self, thing: object) -> None:
        assert self._process.stdin is not None
        pickle.dump(thing, self._process.stdin)
        self._process.stdin.flush()


def _stop(process: subprocess.Popen[bytes]) -> None:
    for pipe in (process.stdin, process.stdout):
        assert pipe is not None
        with suppress(BrokenPipeError):  # what a dead process was not told
            pipe.close()
    try:
        process.wait(_GRACE)
    except subprocess.TimeoutExpired:  # in the middle of a layout that nobody waits for
        process.kill()
        process.wait()
