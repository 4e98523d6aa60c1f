"""Where units are done: one small interface of futures."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Protocol

from robocas_ms3.core.errors import PlanError
from robocas_ms3.core.extensions import load
from robocas_ms3.plans.claims import refuse_claimed
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.units import CLAIMS, Outcome, Unit

ENGINES = {
    "local": "robocas_ms3.plans.engines.local:LocalEngine",
    "slurm": "robocas_ms3.plans.engines.slurm:SlurmEngine",
    "ray": "robocas_ms3.plans.engines.ray:RayEngine",
}
"""Name -> class; what it needs is imported when it is asked for."""


class Engine(Protocol):
    """Does units, some at a time.

    Attributes:
        slots: how many it does at once.
        lingers: s that what does units may go on, and claim none of them, after this process was killed.
    """

    slots: int
    lingers: float

    def submit(self, unit: Unit) -> Future[list[Outcome]]:
        """Have a unit done; of one folder no two at a time."""
        ...

    def close(self) -> None:
        """End what is under way at once, and forget the rest; what the folder holds is whole."""
        ...


def check_engine(name: str, options: Mapping[str, str]) -> None:
    """See that an engine could be opened, before anything of an older run is deleted.

    Raises:
        PlanError: it has no such option.
        MissingExtraError: what it needs is not installed.
    """
    load(ENGINES[name]).check(options)


def open_engine(name: str, plan: Plan, out: Path, jobs: int, options: Mapping[str, str]) -> Engine:
    """Open an engine.

    Args:
        name: of `ENGINES`.
        plan: whose units it does.
        out: the plan's folder.
        jobs: how many units it does at once.
        options: of the engine alone.

    Raises:
        PlanError: it has no such option, or can't be used here; or jobs of Slurm are at the plan, and it is not theirs.
        MissingExtraError: what it needs is not installed.
    """
    if name != "slurm":
        refuse_claimed(out / CLAIMS)
    return load(ENGINES[name])(plan, out, jobs, options)


def refuse_options(engine: str, options: Mapping[str, str], known: tuple[str, ...] = ()) -> None:
    """Refuse what an engine does not know.

    Raises:
        PlanError: there is such an option.
    """
    unknown = sorted(set(options) - set(known))
    if unknown:
        expected = ", ".join(known) or "none"
        raise PlanError(
            f"no options of the engine {engine}", where="--executor-option", expected=expected, found=unknown
        )
