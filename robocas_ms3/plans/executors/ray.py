"""Work units by tasks of Ray, which Ray starts again where a worker or a node dies."""

from __future__ import annotations

import logging
import math
import os
import shutil
import socket
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from importlib import import_module
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from robocas_ms3.core.errors import PlanError, RobocasError, require_extra
from robocas_ms3.core.files import LEFTOVER_AGE, make_folder, write_json
from robocas_ms3.core.signals import deferred_interrupts
from robocas_ms3.core.strict_model import StrictModel
from robocas_ms3.core.text import one_line
from robocas_ms3.plans.executors import ThreadExecutor
from robocas_ms3.plans.folder import OUTCOME, PLAN, Outcome, PlanFolder, SeedFiles, WorkUnit
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.worker import WorkUnitWorker

require_extra("ray", "plans on Ray", "ray")
ray: Any = import_module("ray")

RETRIES = 2
"""How often Ray starts a task again whose worker or node dies."""
PIECE = 16 * 2**20  # bytes that are sent at once
_PIECES = 4  # that wait in the object store, of each task
_APPEARS = 20.0  # s until a file is seen on another node
_CONNECT = 10.0  # s
_CANCEL = 5.0  # s until tasks have ended
_TEMPORARY = "robocas-ray-"
_log = logging.getLogger(__name__)
Piece = tuple[tuple[WorkUnit, int], str, bytes]
"""(unit, seed), name of a file in the seed's folder, what follows in it."""


class RayOptions(StrictModel):
    """Values of ``--executor-option``."""

    address: str | None = Field(
        default=None, description="of the cluster; default: RAY_ADDRESS, or a cluster that is started on this machine"
    )
    num_cpus: Annotated[float, Field(gt=0)] = Field(default=1.0, description="of a task")
    num_gpus: Annotated[float, Field(ge=0)] = Field(default=0.0, description="of a task")
    units_per_job: Annotated[int, Field(ge=1)] = Field(default=4, description="that a task does one after the other")
    gather: bool = Field(default=False, description="nodes do not see the folder, and send their files")


class RayExecutor(ThreadExecutor):
    """See `Executor`; a thread per task."""

    options_type = RayOptions

    def __enter__(self) -> RayExecutor:
        self._disconnects = not ray.is_initialized()
        if self._disconnects:
            _connect(self.options, self.jobs)
        self._tasks: set[Any] = set()
        super().__enter__()
        return self

    def run(self, units: Sequence[WorkUnit]) -> None:
        """Wait for a task; one that Ray has lost leaves units that are not done."""
        options = {"num_cpus": self.options.num_cpus, "num_gpus": self.options.num_gpus}
        if self.options.gather:
            done = [self.folder.partial_outcomes(unit) for unit in units]
            # the outcomes decide what a task sends, so a retry needs other arguments
            options |= {"max_retries": 0, "num_returns": "streaming", "_generator_backpressure_num_objects": _PIECES}
            send = ray.remote(**options)(send_units)
            task = send.remote(self.folder.plan, self.folder.record(), units, done)
        else:
            do = ray.remote(**options, max_retries=RETRIES)(run_units)
            task = do.remote(self.folder, units)
        self._tasks.add(task)
        try:
            self._receive(task, units) if self.options.gather else ray.get(task)
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, RobocasError | OSError):
                raise error.cause from error
            found, fix = one_line(error)[-300:], "Do all nodes have robocas-ms3, in the same Python?"
            raise PlanError("a task of Ray failed", where="Ray", found=found, fix=fix) from error
        except ray.exceptions.RayError as error:
            _log.warning("a task of Ray was lost: %s", one_line(error)[-300:])
        finally:
            self._tasks.discard(task)

    def _receive(self, task: Any, units: Sequence[WorkUnit]) -> None:
        """Receive the files of a task whose node does not see the plan's folder."""
        pieces = (ray.get(reference) for reference in task)
        for (unit, seed), files in groupby(pieces, lambda piece: piece[0]):
            with self.folder.files(unit, seed).temporary() as tmp:
                for _, name, data in files:
                    path = tmp.folder / name
                    path.parent.mkdir(parents=True, exist_ok=True)
                    with path.open("ab") as file:
                        file.write(data)
        for unit in units:
            self.folder.complete(unit)

    def log_of(self, job: Any) -> str:
        """Return where Ray says why a task died."""
        return "the log of Ray on its node"

    def __exit__(self, *error: object) -> None:
        with deferred_interrupts(second_ends=False):
            self.threads.shutdown(wait=False, cancel_futures=True)
            until = time.monotonic() + _CANCEL
            while self._tasks and time.monotonic() < until:  # Ray crashes where a thread waits for a task meanwhile
                for task in list(self._tasks):
                    with suppress(Exception):  # it has just ended
                        ray.cancel(task, force=True)
                time.sleep(0.1)
            if self._disconnects:
                ray.shutdown()


def _connect(options: RayOptions, jobs: int) -> None:
    """Connect to the cluster, or start one on this machine for some jobs."""
    address = options.address or os.environ.get("RAY_ADDRESS") or "local"
    if address.startswith("ray://"):
        fix = "Run this on a node of the cluster, as `ray job submit` does, with address=auto."
        raise PlanError("Ray's client is not supported", where="--executor-option address", found=address, fix=fix)
    host, _, port = address.rpartition(":")
    chosen: dict[str, Any] = {}
    if address == "local":
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        chosen = {"num_cpus": math.ceil(jobs * options.num_cpus), "include_dashboard": False}
    try:
        if host and port.isdecimal():  # Ray would try for minutes, and then end the process
            socket.create_connection((host, int(port)), _CONNECT).close()
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **chosen)
    except (ray.exceptions.RayError, OSError, OverflowError, RuntimeError, ValueError) as error:
        fix = "See `ray status` there."
        raise PlanError("no cluster of Ray answers", where=address, found=one_line(error)[-300:], fix=fix) from error
    wanted = {"CPU": options.num_cpus, "GPU": options.num_gpus}
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if not any(all(node.get(kind, 0) >= count for kind, count in wanted.items()) for node in nodes):
        error = PlanError("no node of Ray has room for a task", where="--executor-option", expected=wanted)
        if address == "local":
            ray.shutdown()
            raise error
        _log.warning("%s; waiting for one", error)


def run_units(folder: PlanFolder, units: Sequence[WorkUnit]) -> None:
    """Do units in the plan's folder, as a task."""
    until = time.monotonic() + _APPEARS
    while not (folder.path / PLAN).is_file():
        if time.monotonic() > until:
            where, fix = f"node {socket.gethostname()}", "Choose an --out that all nodes share, or gather=yes."
            raise PlanError("this node does not see the output folder", where=where, expected=folder.path, fix=fix)
        time.sleep(0.5)
    with closing(WorkUnitWorker(folder)) as worker:
        for unit in units:
            worker.do(unit)


def send_units(
    plan: Plan, record: Mapping[str, Any], units: Sequence[WorkUnit], done: Sequence[Sequence[Outcome]]
) -> Iterator[Piece]:
    """Do units in a temporary folder of the node, as a task, and send the files seed by seed.

    ``record`` is the content of ``plan.json``, ``done`` has the outcomes of the seeds that are done of each unit.
    """
    with _temporary_folder() as out:
        folder = PlanFolder(plan, out)
        write_json(out / PLAN, record)
        for unit, outcomes in zip(units, done, strict=True):
            for outcome in outcomes:
                files = folder.files(unit, outcome.seed)
                make_folder(files.folder)
                files.write(outcome)
        with closing(WorkUnitWorker(folder)) as worker:
            for unit in units:
                for files in worker.seeds(unit):
                    yield from _pieces(unit, files)


def _pieces(unit: WorkUnit, files: SeedFiles) -> Iterator[Piece]:
    """Yield the files of a seed, and delete all but its outcome."""
    for path in sorted(path for path in files.folder.rglob("*") if path.is_file()):
        with path.open("rb") as file:
            name = path.relative_to(files.folder).as_posix()
            yield (unit, files.seed), name, file.read(PIECE)
            while data := file.read(PIECE):
                yield (unit, files.seed), name, data
        if path.name != OUTCOME:
            path.unlink()


@contextmanager
def _temporary_folder() -> Iterator[Path]:
    """Yield a temporary folder of this node; delete those of tasks that were killed a day ago."""
    for path in Path(tempfile.gettempdir()).glob(f"{_TEMPORARY}*"):
        with suppress(OSError):
            if time.time() - path.stat().st_mtime > LEFTOVER_AGE:
                shutil.rmtree(path, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix=_TEMPORARY, ignore_cleanup_errors=True) as folder:
        yield Path(folder)
