"""What an actor of Ray is: a slot on some node. It ends itself where the driver is not heard of any more.

The driver holds a lease on the actor. Each of its messages says the latest clock of the actor that it has got; the
lease ends ``lease`` seconds after that, on the actor's clock. So once the driver has waited for as long after the last
answer, the actor is no more, though nothing was heard of it, and another may go on in the folder of its unit.
"""

from __future__ import annotations

import os
import shutil
import socket
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

from robocas_ms3.core.errors import PlanError, RobocasError
from robocas_ms3.core.files import write_json
from robocas_ms3.core.locks import locked_folder
from robocas_ms3.core.outputs import check_same
from robocas_ms3.core.sent_errors import SentError
from robocas_ms3.demos.recordings.versions import versions
from robocas_ms3.plans.engines.pieces import Pieces, sent
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.slot import Slot, Stages
from robocas_ms3.plans.units import PLAN, Outcome, Unit

_LOOK = 0.5  # s between two looks at the lease
_SEEN = 20.0  # s that a file may take until another machine sees it
_HOME = "robocas-ray-"


@dataclass(frozen=True)
class Terms:
    """What an actor is told first.

    Attributes:
        plan: whose units it does.
        out: the plan's folder, which it has to see; None: it works in one of its own, and sends the files.
        lease: s.
        versions: that an episode depends on.
        stages: what does them.
    """

    plan: Plan
    out: Path | None
    lease: float
    versions: Mapping[str, str]
    stages: Stages | None = None


class RaySlot:
    """The actor; its methods may run at the same time, but for `do` and `send`."""

    def __init__(self, terms: Terms) -> None:
        self._terms = terms
        self._until = time.monotonic() + terms.lease
        self._held = ExitStack()
        self._out = terms.out or self._held.enter_context(_home())
        if terms.out is None:
            about = {"plan": terms.plan.model_dump(mode="json"), "versions": dict(terms.versions)}
            write_json(self._out / PLAN, about)
        self._slot = Slot(terms.plan, self._out, terms.stages)
        threading.Thread(target=self._watch, daemon=True).start()

    def check(self) -> SentError | None:
        """Say what is wrong with this node."""
        node = f"node {socket.gethostname()}"
        try:
            fix = "Install the same on all nodes."
            check_same(self._terms.versions, versions(), "other versions", where=Path(node), fix=fix, error=PlanError)
            if self._terms.out is not None and not _appears(self._terms.out / PLAN):
                fix = "Choose an --out that all nodes share, or pass --executor-option gather=yes."
                raise PlanError("this node does not see the folder", where=node, expected=self._out, fix=fix)
        except RobocasError as error:
            return SentError.of(error, node)
        return None

    def renew(self, known: float | None) -> float:
        """Renew the lease.

        Args:
            known: the latest clock of this actor that the driver knows.

        Returns:
            The clock now, s.
        """
        if known is not None:
            self._until = max(self._until, known + self._terms.lease)
        return time.monotonic()

    def do(self, unit: Unit) -> list[Outcome] | SentError:
        """Do what is left of a unit, in the folder that all see."""
        try:
            return self._slot.do(unit)
        except Exception as error:
            return SentError.of(error, f"an actor on {socket.gethostname()}")

    def send(self, unit: Unit, begun: Mapping[str, bytes]) -> Iterator[Pieces | Outcome | SentError]:
        """Do what is left of a unit, in a folder of this actor.

        Args:
            unit: it.
            begun: ledgers of it, by their names: what was done before.

        Yields:
            The files of a seed, then what came of it; in the end what belongs to none. Or an error that ends it.
        """
        folder = unit.folder(self._terms.plan, self._out)
        try:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            for name, content in begun.items():
                (folder / name).write_bytes(content)
            for outcome in self._slot.seeds(unit):
                yield from sent(folder)
                yield outcome
            yield from sent(folder)
        except Exception as error:
            yield SentError.of(error, f"an actor on {socket.gethostname()}")
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def close(self) -> None:
        """End the processes, whatever they are at, and delete what they left."""
        self._slot.close()
        self._held.close()

    def _watch(self) -> None:
        while time.monotonic() < self._until:
            time.sleep(_LOOK)
        try:
            self.close()
        finally:
            os._exit(1)


@contextmanager
def _home() -> Iterator[Path]:
    """A folder on this node; those of actors that were killed are deleted."""
    path = Path(tempfile.gettempdir()) / f"{_HOME}{uuid4().hex}"
    for other in path.parent.glob(f"{_HOME}*"):
        with suppress(OSError, RobocasError), locked_folder(other):
            shutil.rmtree(other)
    with locked_folder(path):  # before it is there: another actor deletes what is not locked
        path.mkdir()
        try:
            yield path
        finally:
            shutil.rmtree(path, ignore_errors=True)


def _appears(path: Path) -> bool:
    until = time.monotonic() + _SEEN
    while not path.is_file():
        if time.monotonic() > until:
            return False
        time.sleep(0.5)
    return True
