"""Run work units as tasks of Ray, which restarts tasks whose worker or node fails."""

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
from robocas_ms3.core.signals import defer_interrupts
from robocas_ms3.core.strict_model import StrictModel
from robocas_ms3.core.text import one_line
from robocas_ms3.plans.executors import ThreadExecutor
from robocas_ms3.plans.folder import OUTCOME, PLAN, Outcome, PlanFolder, SeedFiles, WorkUnit
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.worker import WorkUnitWorker

require_extra("ray", "plans on Ray", "ray")
ray: Any = import_module("ray")

RETRIES = 2
"""How often Ray restarts a task whose worker or node fails."""
CHUNK_BYTES = 16 * 2**20  # largest size of a chunk
_MAX_STORED_CHUNKS = 4  # per task, in the object store
_FOLDER_TIMEOUT = 20.0  # s until a new file is visible on another node
_CONNECT_TIMEOUT = 10.0  # s
_CANCEL_TIMEOUT = 5.0  # s until cancelled tasks have ended
_TEMPORARY = "robocas-ray-"
_log = logging.getLogger(__name__)
FileChunk = tuple[tuple[WorkUnit, int], str, bytes]
"""(work unit, seed), name of a file in the folder of the seed, next bytes of this file."""


class RayOptions(StrictModel):
    """Options of `RayExecutor`, the values of ``--executor-option``."""

    address: str | None = Field(
        default=None,
        description="address of the cluster; default: RAY_ADDRESS, else a cluster is started on this machine",
    )
    num_cpus: Annotated[float, Field(gt=0)] = Field(default=1.0, description="CPUs of a task")
    num_gpus: Annotated[float, Field(ge=0)] = Field(default=0.0, description="GPUs of a task")
    units_per_job: Annotated[int, Field(ge=1)] = Field(
        default=4, description="work units of a task, run one after the other"
    )
    gather: bool = Field(
        default=False,
        description="whether nodes send their files to this machine, because they have no access to the output folder",
    )


class RayExecutor(ThreadExecutor):
    """Run work units as tasks of Ray."""

    options_type = RayOptions

    def __enter__(self) -> RayExecutor:
        self._disconnects = not ray.is_initialized()
        if self._disconnects:
            _connect_to_cluster(self.options, self.jobs)
        self._tasks: set[Any] = set()
        super().__enter__()
        return self

    def run(self, units: Sequence[WorkUnit]) -> None:
        """Run work units in a task of Ray, and wait for the task; if Ray loses the task, they stay incomplete."""
        options = {"num_cpus": self.options.num_cpus, "num_gpus": self.options.num_gpus}
        if self.options.gather:
            done = [self.folder.read_partial_outcomes(unit) for unit in units]
            # a retry would need other outcomes: the task sends the files of the other seeds
            options |= {
                "max_retries": 0,
                "num_returns": "streaming",
                "_generator_backpressure_num_objects": _MAX_STORED_CHUNKS,
            }
            send = ray.remote(**options)(run_and_send_units)
            task = send.remote(self.folder.plan, self.folder.make_record(), units, done)
        else:
            do = ray.remote(**options, max_retries=RETRIES)(run_units)
            task = do.remote(self.folder, units)
        self._tasks.add(task)
        try:
            self._receive(task, units) if self.options.gather else ray.get(task)
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, RobocasError | OSError):
                raise error.cause from error
            fix = "Check that all nodes have the same versions of robocas-ms3 and Python."
            found = one_line(error)[-300:]
            raise PlanError("a task of Ray failed", where="Ray", found=found, fix=fix) from error
        except ray.exceptions.RayError as error:
            _log.warning("Ray has lost a task, which is submitted again: %s", one_line(error)[-300:])
        finally:
            self._tasks.discard(task)

    def _receive(self, task: Any, units: Sequence[WorkUnit]) -> None:
        """Write the files that a task sends from a node without access to the output folder."""
        chunks = (ray.get(reference) for reference in task)
        for (unit, seed), files in groupby(chunks, lambda chunk: chunk[0]):
            with self.folder.seed_files(unit, seed).temporary_files() as tmp:
                for _, name, data in files:
                    path = tmp.folder / name
                    path.parent.mkdir(parents=True, exist_ok=True)
                    with path.open("ab") as file:
                        file.write(data)
        for unit in units:
            self.folder.write_outcomes(unit)

    def describe_log(self, job: Any) -> str:
        """Return where to find the log of a task, for an error message."""
        return "the log of Ray on the node of the task"

    def __exit__(self, *error: object) -> None:
        with defer_interrupts(second_ends=False):
            self.threads.shutdown(wait=False, cancel_futures=True)
            until = time.monotonic() + _CANCEL_TIMEOUT
            while self._tasks and time.monotonic() < until:  # Ray crashes if a thread still waits for a task
                for task in list(self._tasks):
                    with suppress(Exception):  # the task may have ended
                        ray.cancel(task, force=True)
                time.sleep(0.1)
            if self._disconnects:
                ray.shutdown()


def _connect_to_cluster(options: RayOptions, jobs: int) -> None:
    """Connect to a Ray cluster, or start one on this machine with the resources of ``jobs`` tasks."""
    address = options.address or os.environ.get("RAY_ADDRESS") or "local"
    if address.startswith("ray://"):
        fix = "Run the command on a node of the cluster (`ray job submit`), with address=auto."
        raise PlanError(
            "Ray Client (ray://) is not supported", where="--executor-option address", found=address, fix=fix
        )
    host, _, port = address.rpartition(":")
    chosen: dict[str, Any] = {}
    if address == "local":
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        chosen = {"num_cpus": math.ceil(jobs * options.num_cpus), "include_dashboard": False}
    try:
        if host and port.isdecimal():  # Ray would retry for minutes, and then end the process
            socket.create_connection((host, int(port)), _CONNECT_TIMEOUT).close()
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **chosen)
    except (ray.exceptions.RayError, OSError, OverflowError, RuntimeError, ValueError) as error:
        fix = "Check the address with `ray status`."
        raise PlanError(
            "cannot connect to the Ray cluster", where=address, found=one_line(error)[-300:], fix=fix
        ) from error
    needed = {"CPU": options.num_cpus, "GPU": options.num_gpus}
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if not any(all(node.get(kind, 0) >= count for kind, count in needed.items()) for node in nodes):
        what, expected = (
            "no node of the Ray cluster has the resources of a task",
            ", ".join(f"{kind} {n:g}" for kind, n in needed.items()),
        )
        error = PlanError(what, where="--executor-option", expected=expected)
        if address == "local":
            ray.shutdown()
            raise error
        _log.warning("%s; waiting for such a node", error)


def run_units(folder: PlanFolder, units: Sequence[WorkUnit]) -> None:
    """Run work units in the output folder of the plan; runs on a node, as a task of Ray."""
    until = time.monotonic() + _FOLDER_TIMEOUT
    while not (folder.path / PLAN).is_file():
        if time.monotonic() > until:
            fix = "Choose an --out folder that all nodes share, or --executor-option gather=yes."
            where, what = f"node {socket.gethostname()}", "this node has no access to the output folder of the plan"
            raise PlanError(what, where=where, expected=folder.path, fix=fix)
        time.sleep(0.5)
    with closing(WorkUnitWorker(folder)) as worker:
        for unit in units:
            worker.run(unit)


def run_and_send_units(
    plan: Plan, record: Mapping[str, Any], units: Sequence[WorkUnit], done: Sequence[Sequence[Outcome]]
) -> Iterator[FileChunk]:
    """Run work units in a temporary folder of the node, and yield the files of each seed as a task of Ray.

    Args:
        plan: the plan.
        record: content of ``plan.json``.
        units: work units to run.
        done: outcomes of the seeds of each work unit that are complete already.
    """
    with _temporary_folder() as out:
        folder = PlanFolder(plan, out)
        write_json(out / PLAN, record)
        for unit, outcomes in zip(units, done, strict=True):
            for outcome in outcomes:
                files = folder.seed_files(unit, outcome.seed)
                make_folder(files.folder)
                files.write_outcome(outcome)
        with closing(WorkUnitWorker(folder)) as worker:
            for unit in units:
                for files in worker.run_seeds(unit):
                    yield from _read_chunks(unit, files)


def _read_chunks(unit: WorkUnit, files: SeedFiles) -> Iterator[FileChunk]:
    """Yield the files of a seed in chunks; delete each file after it was sent, except ``outcome.json``."""
    for path in sorted(path for path in files.folder.rglob("*") if path.is_file()):
        with path.open("rb") as file:
            name = path.relative_to(files.folder).as_posix()
            yield (unit, files.seed), name, file.read(CHUNK_BYTES)
            while data := file.read(CHUNK_BYTES):
                yield (unit, files.seed), name, data
        if path.name != OUTCOME:
            path.unlink()


@contextmanager
def _temporary_folder() -> Iterator[Path]:
    """Yield a temporary folder of this node; also delete folders of killed tasks that are older than a day."""
    for path in Path(tempfile.gettempdir()).glob(f"{_TEMPORARY}*"):
        with suppress(OSError):
            if time.time() - path.stat().st_mtime > LEFTOVER_AGE:
                shutil.rmtree(path, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix=_TEMPORARY, ignore_cleanup_errors=True) as folder:
        yield Path(folder)
