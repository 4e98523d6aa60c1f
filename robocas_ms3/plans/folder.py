"""The output folder of a plan: `plan.json`, the plan and the versions that it was started with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from robocas_ms3.core.documents import DocumentError, load_json
from robocas_ms3.core.errors import PlanError
from robocas_ms3.core.outputs import FolderKind, setting_changes
from robocas_ms3.core.strict import parse
from robocas_ms3.demos.recordings.entries import versions
from robocas_ms3.plans.plan import Plan

PLAN, REPORT, UNITS = "plan.json", "report.json", "units"
FREE = frozenset({"description", "limits"})
"""Keys of a plan that may change between runs: no episode depends on them."""


def plan_record(plan: Plan) -> dict[str, Any]:
    """Return the content of `plan.json`."""
    return {"plan": plan.model_dump(mode="json"), "versions": versions()}


def settings_of(record: dict[str, Any]) -> dict[str, Any]:
    """Return what must not change of the content of `plan.json`."""
    plan = record["plan"]
    return {**record, "plan": {k: v for k, v in plan.items() if k not in FREE} if isinstance(plan, dict) else plan}


KIND = FolderKind("robocas plan run", (PLAN,), "plan", upgrade=settings_of)


def read_plan_record(out: Path) -> dict[str, Any]:
    """Read `plan.json`; raise PlanError if it is missing or damaged."""
    path = out / PLAN
    try:
        record = load_json(path)
    except (OSError, DocumentError) as error:
        found = error.strerror if isinstance(error, OSError) else error
        raise PlanError("no plan was started here", where=path, found=found) from error
    if not isinstance(record, dict) or not all(isinstance(record.get(key), dict) for key in ("plan", "versions")):
        raise PlanError("no plan was started here", where=path, expected="plan and versions")
    return record


def read_plan(out: Path) -> Plan:
    """Read the plan that a folder was started with; raise PlanError if there is none."""
    return parse(Plan, read_plan_record(out)["plan"], PlanError, where=out / PLAN, about="not a valid plan")


def check_plan_record(out: Path, plan: Plan) -> None:
    """Raise PlanError if a folder was started with another plan, except for the keys in `FREE`, or other versions."""
    before, now = settings_of(read_plan_record(out)), settings_of(plan_record(plan))
    if changes := [change for key in now for change in setting_changes(before[key], now[key], key)]:
        fix = "Use the same plan and versions on every machine, another --out, or --overwrite."
        what = "this folder was started with another plan or other versions"
        raise PlanError(what, where=out / PLAN, found="; ".join(changes[:8]), fix=fix)
