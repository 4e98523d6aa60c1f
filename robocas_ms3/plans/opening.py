"""Opening what the episodes of a part need: what fails there is no seed's fault, and ends the run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from robocas_ms3.core.errors import MissingExtraError, PlanError
from robocas_ms3.plans.plan import Plan, check_packs


@contextmanager
def opening(plan: Plan, part: int) -> Iterator[None]:
    """Open an environment, or whatever else all seeds of a part share.

    Raises:
        PlanError: it can't be opened on this machine, or the part's pack is another here.
        MissingExtraError: something is not installed.
        OSError: the disk, or the system, says something that tells enough.
    """
    one = plan.parts[part]
    try:
        check_packs(plan, one.pack)
        yield
    except (PlanError, MissingExtraError):
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno:
            raise
        found, fix = " ".join(f"{type(error).__name__}: {error}".split()), "Mend it where it was said, then --resume."
        raise PlanError(
            "what this part needs can't be opened", where=f"part {one.name}", found=found, fix=fix
        ) from error
