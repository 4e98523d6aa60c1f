"""Conditions under which the episodes of a result can be replayed."""

from __future__ import annotations

from collections.abc import Collection

from robocas_ms3.evaluation.audit.sample import choose_episodes
from robocas_ms3.evaluation.results.result_files import Result
from robocas_ms3.evaluation.results.run_record import get_package_versions, is_same_processor


def list_other_processors(result: Result) -> list[str]:
    """Return the models of other processors than that of this machine that made a result."""
    machines = [part.machine for part in result.run.merged_from] or [result.run.machine]
    return sorted({str((machine or {}).get("model")) for machine in machines if not is_same_processor(machine or {})})


def find_audit_obstacle(result: Result, stored: Collection[int] | None = None) -> str:
    """Return why the episodes of a result cannot be replayed; empty if they can.

    Versions of packages must be equal, without their local part, such as ``+cpu``. The version of robocas_ms3 may
    differ: then the outcomes decide.

    Args:
        result: the result.
        stored: numbers of the episodes whose actions are stored; None: all.
    """
    if result.run.backend != "processes":
        return f"its backend is {result.run.backend}, whose physics is not repeatable; expected processes"
    if not choose_episodes(result, stored=stored):
        return "it has no episode that can be replayed"
    recorded = {name: version.partition("+")[0] for name, version in result.run.versions.items()}
    installed = {name: version.partition("+")[0] for name, version in get_package_versions().items()}
    del installed["robocas_ms3"]
    if differing := [name for name in installed if recorded.get(name) != installed[name]]:
        names = ", ".join(f"{name} {recorded.get(name, 'unknown')}" for name in differing)
        return f"it was made with other versions: {names}. Install these versions"
    return ""
