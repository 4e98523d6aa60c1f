"""``plan.json``: what a folder was begun with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from robocas_ms3.core.documents import DocumentError, load_json
from robocas_ms3.core.errors import PlanError
from robocas_ms3.core.outputs import check_same
from robocas_ms3.core.strict import parse
from robocas_ms3.demos.recordings.versions import versions
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.units import PLAN

FREE = frozenset({"description", "limits"})
"""Keys of a plan that may be others when it goes on: no episode depends on them."""
_SHOWN = 3  # changes


def content_of(plan: Plan) -> dict[str, Any]:
    """What is written of a plan that begins here and now."""
    return {"plan": plan.model_dump(mode="json"), "versions": versions()}


def read_begun(out: Path) -> dict[str, Any]:
    """What a folder was begun with.

    Raises:
        PlanError: nothing was, or the file is damaged.
    """
    path = out / PLAN
    try:
        about = load_json(path)
    except (OSError, DocumentError) as error:
        found = error.strerror if isinstance(error, OSError) else error
        raise PlanError("no plan was begun here", where=path, found=found) from error
    if not isinstance(about, dict) or not all(isinstance(about.get(key), dict) for key in ("plan", "versions")):
        raise PlanError("no plan was begun here", where=path, expected="plan and versions")
    return about


def read_plan(out: Path) -> Plan:
    """The plan that a folder was begun with; errors of `read_begun`."""
    return parse(Plan, read_begun(out)["plan"], PlanError, where=out / PLAN, about="not a valid plan")


def check_versions(out: Path) -> None:
    """See that this machine has what the plan was begun with: that of a worker may be another.

    Raises:
        PlanError: it has something else.
    """
    what, fix = "this machine has other versions", "Install the same versions wherever units are done."
    check_same(read_begun(out)["versions"], versions(), what, where=out / PLAN, fix=fix, error=PlanError)


def check_plan_of(out: Path, plan: Plan) -> None:
    """See that a folder was begun with this plan, but for keys that are `FREE`, by these versions.

    Raises:
        PlanError: it wasn't.
    """
    before, now = read_begun(out), content_of(plan)
    different = [key for key, value in now["plan"].items() if key not in FREE and before["plan"].get(key) != value]
    if different:
        changes = [one for key in different for one in _changes(before["plan"].get(key), now["plan"][key], key)]
        found = "; ".join(changes[:_SHOWN]) + "; ..." * (len(changes) > _SHOWN)
        fix = "Use the same, another --out, or --overwrite."
        raise PlanError("begun with another plan", where=out / PLAN, found=found, fix=fix)
    check_versions(out)


def _changes(before: Any, now: Any, path: str) -> list[str]:
    """What is another value now, by its path."""
    if isinstance(before, dict) and isinstance(now, dict):
        keys = [*before, *(key for key in now if key not in before)]
        return [one for key in keys for one in _changes(before.get(key), now.get(key), f"{path}.{key}")]
    if isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        pairs = enumerate(zip(before, now, strict=True))
        return [one for place, (was, one_now) in pairs for one in _changes(was, one_now, f"{path}.{place}")]
    return [] if before == now else [f"{path}: {_short(before)}, now {_short(now)}"]


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
