"""Layouts made in a process of its own, for one whose PhysX would make others."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import weakref
from contextlib import suppress
from typing import Any

from robocas_ms3.errors import LayoutError, SimulationError
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.scenes.model import SceneModel

# What libraries print must not get among the answers. No `multiprocessing`: it would run the program's main part again.
_PROGRAM = """
import os, pickle, sys
answers = os.fdopen(os.dup(1), "wb")
os.dup2(2, 1)
from robocas_ms3.errors import LayoutError
from robocas_ms3.scenes.sample import sample_layout
model = pickle.load(sys.stdin.buffer)
while True:
    try:
        seeds = pickle.load(sys.stdin.buffer)
    except EOFError:
        break
    try:
        answer = sample_layout(model, *seeds)
    except LayoutError as error:
        answer = error
    pickle.dump(answer, answers)
    answers.flush()
"""


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
            env={**os.environ, "PYTHONPATH": path, "ROBOCAS_DEFER_REGISTRATION": "1"},
        )
        weakref.finalize(self, _stop, self._process)
        with suppress(BrokenPipeError):  # it died at once, as the first layout will tell
            self._send(model)

    def layout(self, objects_seed: int, seed: int) -> Layout:
        """The layout of two seeds; see `sample.sample_layout`.

        Raises:
            LayoutError: there is none.
            SimulationError: the process died.
        """
        assert self._process.stdout is not None
        try:
            self._send((objects_seed, seed))
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
    process.wait()
