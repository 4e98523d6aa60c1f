"""What a result was measured with, for its page."""

from __future__ import annotations

import json
from html import escape

from robocas_ms3.evaluation.protocol import LoadedProtocol
from robocas_ms3.evaluation.report.marks import facts, section, table
from robocas_ms3.evaluation.results import Result


def measured_with(result: Result, protocol: LoadedProtocol | None) -> str:
    """A section of the page."""
    run, policy = result.run, result.run["policy"]
    pairs: list[tuple[str, object]] = [("protocol", run["protocol"]), ("its hash", run["protocol_hash"])]
    if protocol is not None:
        pairs += [("what it says", protocol.rules.description), ("its rules", _rules(protocol))]
    pairs += [("policy", policy["name"])]
    pairs += [(f"policy, {name}", _plain(value)) for name, value in policy.items() if name != "name"]
    pairs += [
        ("upstream's weld", "yes" if run["weld"] else "no"),
        ("backend", run["backend"]),
        ("versions", _plain(run["versions"])),
    ]
    pairs += [(f"pack {name}", value) for name, value in run["pack_hashes"].items()]
    machines = {_plain(part["machine"]) for part in run.get("parts", [])} or {_plain(run.get("machine", {}))}
    pairs += [("machine", machine) for machine in sorted(machines)]
    parts = ""
    if "parts" in run:
        rows = [[escape(part["folder"]), str(part["episodes"])] for part in run["parts"]]
        parts = table(("part", "episodes#"), rows)
    return section("What it was measured with", "", facts(pairs) + parts)


def _rules(protocol: LoadedProtocol) -> str:
    kept = {"rate_hz", "stepping", "max_steps", "max_seconds", "ends_on", "max_v0_steps"}
    rules = protocol.rules.model_dump(mode="json", include=kept)
    return _plain({name: value for name, value in rules.items() if value is not None})


def _plain(value: object) -> str:
    """A dictionary as ``a 1, b 2``; anything else as JSON, strings as they are."""
    if isinstance(value, dict):
        return ", ".join(
            f"{name} {_plain(inner) if not isinstance(inner, dict) else json.dumps(inner)}"
            for name, inner in value.items()
        )
    return value if isinstance(value, str) else json.dumps(value)
