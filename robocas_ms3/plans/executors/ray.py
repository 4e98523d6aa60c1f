"""Work units by tasks of Ray, which Ray starts again where a worker or a node dies."""

from __future__ import annotations

import logging
import shutil
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import PlanError
from robocas_ms3.core.exits import deferred_interrupts
from robocas_ms3.core.files import ABANDONED, make_folder, write_json
from robocas_ms3.core.remote_errors import RemoteError
from robocas_ms3.plans.executors import Setting, ended_futures, read_options
from robocas_ms3.plans.executors.ray_cluster import RayOptions, connect, require_ray
from robocas_ms3.plans.folder import PLAN, read_plan_record
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.units import OUTCOME, Outcome, SeedFiles, Unit
from robocas_ms3.plans.worker import UnitWorker

RETRIES = 2
"""How often Ray starts a task again whose worker or node dies."""
PIECE = 16 * 2**20  # bytes that are sent at once
_PIECES = 4  # that wait in the object store, of each task
_APPEARS = 20.0  # s until a file is seen on another node
_HOME = "robocas-ray-"
_log = logging.getLogger(__name__)
OpenWorker = Callable[[Plan, Path], UnitWorker]


class RayExecutor:
    """See `executors.Executor`; a thread per task."""

    def __init__(self, setting: Setting) -> None:
        self._options, self._setting = read_options("ray", RayOptions, setting.options), setting
        self.jobs, self.units_per_job = setting.jobs, self._options.units_per_job
        self._out = setting.out.absolute()
        self._ray = require_ray()
        self._disconnects = connect(self._options, setting.jobs)
        remote = self._ray.remote(num_cpus=self._options.num_cpus, num_gpus=self._options.num_gpus, max_retries=RETRIES)
        self._do_units, self._send_units = remote(do_units), remote(send_units)
        self._tasks: set[Any] = set()
        self._threads = ThreadPoolExecutor(setting.jobs, thread_name_prefix="ray")

    @staticmethod
    def check(options: Mapping[str, str]) -> None:
        """Check the options, and that Ray is installed."""
        require_ray()
        read_options("ray", RayOptions, options)

    def submit(self, groups: Sequence[Sequence[Unit]]) -> list[Future[None]]:
        """Start a task for each group."""
        job = self._gather if self._options.gather else self._do
        return [self._threads.submit(job, group) for group in groups]

    def ended(self, jobs: Sequence[Future[None]], seconds: float) -> list[Future[None]]:
        """Wait for a task."""
        return ended_futures(jobs, seconds)

    def log_of(self, job: Future[None]) -> str:
        """Return where Ray says why a task died."""
        return "the log of Ray on its node"

    def close(self) -> None:
        """Cancel the tasks, and end the cluster if it was started here."""
        with deferred_interrupts(second_ends=False):
            self._threads.shutdown(wait=False, cancel_futures=True)
            for task in list(self._tasks):
                with suppress(Exception):  # it has just ended
                    self._ray.cancel(task, force=True)
            if self._disconnects:
                self._ray.shutdown()

    def _do(self, units: Sequence[Unit]) -> None:
        """Wait for a task that writes into the plan's folder."""
        task = self._do_units.remote(self._setting.plan, self._out, units, self._setting.open_worker)
        with self._running(task):
            error = self._ray.get(task)
            if error is not None:
                error.reraise()

    def _gather(self, units: Sequence[Unit]) -> None:
        """Receive the files of a task whose node does not see the plan's folder."""
        plan, out = self._setting.plan, self._out
        done = [unit.partial_outcomes(plan, out) for unit in units]
        # what this folder has when it starts decides what a task sends, so another one has to be submitted
        send = self._send_units.options(
            num_returns="streaming", _generator_backpressure_num_objects=_PIECES, max_retries=0
        )
        task = send.remote(plan, read_plan_record(out), units, done, self._setting.open_worker)
        with self._running(task):
            for (unit, seed), messages in groupby(self._messages(task), lambda message: (message.unit, message.seed)):
                with unit.files(plan, out, seed).temporary() as tmp:
                    for message in messages:
                        path = tmp.folder / message.name
                        path.parent.mkdir(parents=True, exist_ok=True)
                        with path.open("ab") as file:
                            file.write(message.data)
            for unit in units:
                unit.complete(plan, out)

    def _messages(self, task: Any) -> Iterator[Piece]:
        for reference in task:
            message = self._ray.get(reference)
            if isinstance(message, RemoteError):
                message.reraise()
            yield message

    @contextmanager
    def _running(self, task: Any) -> Iterator[None]:
        """Turn a task that Ray has lost into one that has ended, whose units are not done."""
        self._tasks.add(task)
        try:
            yield
        except self._ray.exceptions.RayTaskError as error:
            fix = "Do all nodes have robocas-ms3, in the same Python?"
            raise PlanError("a task of Ray failed", where="--executor ray", found=_line(error), fix=fix) from error
        except self._ray.exceptions.RayError as error:
            _log.warning("a task of Ray was lost: %s", _line(error))
        finally:
            self._tasks.discard(task)


@dataclass(frozen=True)
class Piece:
    """A piece of a file of a seed, on its way from a node.

    Attributes:
        unit, seed: the seed.
        name: of the file in the seed's folder.
        data: what follows in the file.
    """

    unit: Unit
    seed: int
    name: str
    data: bytes


def do_units(plan: Plan, out: Path, units: Sequence[Unit], open_worker: OpenWorker) -> RemoteError | None:
    """Do units in the plan's folder, as a task; return an error that every seed would meet."""
    node = socket.gethostname()
    worker = open_worker(plan, out)
    try:
        if not _appears(out / PLAN):
            fix = "Choose an --out that all nodes share, or pass --executor-option gather=yes."
            raise PlanError("this node does not see the output folder", where=f"node {node}", expected=out, fix=fix)
        for unit in units:
            worker.do(unit)
    except Exception as error:
        return RemoteError.of(error, f"a task on {node}")
    finally:
        worker.close()
    return None


def send_units(
    plan: Plan,
    record: Mapping[str, Any],
    units: Sequence[Unit],
    done: Sequence[Sequence[Outcome]],
    open_worker: OpenWorker,
) -> Iterator[Piece | RemoteError]:
    """Do units in a temporary folder of the node, as a task, and send the files seed by seed.

    Args:
        plan: the plan of the units.
        record: content of ``plan.json``.
        units: to be done.
        done: outcomes of the seeds of each unit that are done already.
        open_worker: makes what does the units.
    """
    with _home() as home:
        write_json(home / PLAN, record)
        for unit, outcomes in zip(units, done, strict=True):
            for outcome in outcomes:
                files = unit.files(plan, home, outcome.seed)
                make_folder(files.folder)
                files.write(outcome)
        worker = open_worker(plan, home)
        try:
            for unit in units:
                for files in worker.seeds(unit):
                    yield from _pieces(unit, files)
        except Exception as error:
            yield RemoteError.of(error, f"a task on {socket.gethostname()}")
        finally:
            worker.close()


def _pieces(unit: Unit, files: SeedFiles) -> Iterator[Piece]:
    """Yield the files of a seed, and delete all but its outcome."""
    for path in sorted(path for path in files.folder.rglob("*") if path.is_file()):
        with path.open("rb") as file:
            data = file.read(PIECE)
            while True:
                yield Piece(unit, files.seed, path.relative_to(files.folder).as_posix(), data)
                data = file.read(PIECE)
                if not data:
                    break
        if path.name != OUTCOME:
            path.unlink()


@contextmanager
def _home() -> Iterator[Path]:
    """Yield a temporary folder of this node; delete those of tasks that were killed a day ago."""
    for path in Path(tempfile.gettempdir()).glob(f"{_HOME}*"):
        with suppress(OSError):
            if time.time() - path.stat().st_mtime > ABANDONED:
                shutil.rmtree(path, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix=_HOME, ignore_cleanup_errors=True) as home:
        yield Path(home)


def _appears(path: Path) -> bool:
    until = time.monotonic() + _APPEARS
    while not path.is_file():
        if time.monotonic() > until:
            return False
        time.sleep(0.5)
    return True


def _line(error: Exception) -> str:
    return " ".join(f"{error}".split())[-300:]
