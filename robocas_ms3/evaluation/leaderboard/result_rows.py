"""Rows of the leaderboard from results of `robocas eval`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.strict_model import parse
from robocas_ms3.evaluation.leaderboard.rows import LeaderboardRow
from robocas_ms3.evaluation.policies import POLICIES
from robocas_ms3.evaluation.protocols.protocol import LoadedProtocol
from robocas_ms3.evaluation.report.tables import describe_action_noise, get_stage_names
from robocas_ms3.evaluation.results.outcomes import Outcome
from robocas_ms3.evaluation.results.result_files import Result
from robocas_ms3.evaluation.results.run_record import RunRecord

_DIGITS = 6  # of rates


def make_rows(result: Result, protocol: LoadedProtocol | None = None) -> list[LeaderboardRow]:
    """Return one row per task and split of a result.

    Args:
        result: the result.
        protocol: protocol of the result, for the number of episodes; None: unknown.

    Raises:
        EvaluationError: a value in ``run.json`` is invalid, such as the track.
    """
    groups: dict[tuple[str, str], list[Outcome]] = {}
    for outcome in result.outcomes.values():
        groups.setdefault((outcome.task, outcome.split), []).append(outcome)
    shared = _describe_run(result.run)
    rows = []
    for (task, split), outcomes in groups.items():
        played_as = result.run.played_as.get(task, task)
        count = None
        if protocol is not None:
            count = sum((one.task, one.split) == (played_as, split) for one in protocol.episodes) or None
        values = {**shared, "task": task, "split": split, "n_protocol": count, **_measure(result, task, outcomes)}
        rows.append(
            parse(LeaderboardRow, values, EvaluationError, where=result.folder, about="cannot make a leaderboard row")
        )
    return rows


def _measure(result: Result, task: str, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return the fields of a row that depend on the outcomes of its episodes."""
    success = result.compute_rate("success", outcomes)
    flags = {flag for one in outcomes for flag in one.flags}
    lacking = result.run.training_differences or {}
    configs = {one.config for one in outcomes}

    def compute_rate(flag: str) -> float:
        return round(result.compute_rate(flag, outcomes).rate, _DIGITS)

    return {
        "n": success.n,
        "errors": sum(bool(one.error) for one in outcomes),
        "successes": success.k,
        "rate": round(success.rate, _DIGITS),
        "interval": [round(success.low, _DIGITS), round(success.high, _DIGITS)],
        "rate_v0": compute_rate("success_v0") if "success_v0" in flags else None,
        "stages": {stage: compute_rate(stage) for stage in get_stage_names(task) if stage in flags - {"success"}},
        "training_matches": not any(lacking[name] for name in configs) if configs <= lacking.keys() else None,
    }


def _describe_run(run: RunRecord) -> dict[str, Any]:
    """Return the fields of a row that are equal for all rows of a result."""
    policy = run.policy
    description: dict[str, Any] = {**(policy.server or {}), **policy.model_dump(exclude={"name", "server"})}
    noise = describe_action_noise(run)
    return {
        "policy": policy.name if policy.name in POLICIES.entry_points else description.get("baseline", policy.name),
        "track": policy.track,
        "protocol": run.protocol,
        "protocol_hash": run.protocol_hash,
        "training": _describe_training(description),
        "parameters": description.get("parameters"),
        "calibration": policy.spec.get("calibration", "nominal") if policy.spec.get("cameras") else None,
        "differences": [*(["RoboCAS-v0's weld"] if run.weld else []), *([noise] if noise else [])],
        "weights": description.get("weights", ""),
        "backend": run.backend,
        "versions": run.versions,
        "source_hash": run.source_hash,
    }


def _describe_training(description: dict[str, Any]) -> dict[str, Any] | None:
    """Return the fields of `Training` from the description of a policy (`RunPolicy.describe`); None: not trained."""
    data = description.get("data")
    if not isinstance(data, dict):
        return None
    return {
        "data": data.get("name", ""),
        "episodes": data.get("episodes"),
        "scenes": description.get("trained_in", ""),
        "init_from": description.get("init_from", ""),
        "steps": description.get("steps"),
        "seconds": description.get("training_seconds"),
        "hardware": description.get("hardware", ""),
    }
