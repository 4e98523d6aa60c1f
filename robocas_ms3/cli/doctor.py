"""``robocas doctor``: check the installation."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from robocas_ms3.core.text import format_count

if TYPE_CHECKING:
    from robocas_ms3.doctor.checks import Finding


@dataclass
class Doctor:
    """Check the installation: versions, render device, physics, planner, asset packs and disk.

    Exit status 1 if a required check fails.

    Example: robocas doctor
    """

    json: bool = False
    """Print the report as JSON."""


def main(cfg: Doctor) -> int:
    from robocas_ms3.cli.progress import spinner
    from robocas_ms3.cli.terminal import print_json
    from robocas_ms3.doctor.checks import run_checks

    with spinner("checking the installation"):
        findings = run_checks()
    failed = sum(finding.status == "fail" for finding in findings)
    if cfg.json:
        print_json({"ok": not failed, "findings": [asdict(finding) for finding in findings]})
    else:
        _print(findings, failed)
    return 1 if failed else 0


def _print(findings: list[Finding], failed: int) -> None:
    from rich.text import Text

    from robocas_ms3.cli.terminal import print_table, table_console

    marks = {"ok": Text("ok", "green"), "limited": Text("limited", "yellow"), "fail": Text("FAIL", "bold red")}
    columns = ("", "check", "found", *(["fix"] if any(finding.fix for finding in findings) else []))
    rows = [(marks[each.status], each.name, each.found, each.fix)[: len(columns)] for each in findings]
    print_table(columns, rows)
    limited = sum(finding.status == "limited" for finding in findings)
    verdict = f"{format_count(failed, 'required check')} failed" if failed else "all required checks passed"
    table_console().print(verdict + (f"; {format_count(limited, 'optional feature')} limited" if limited else ""))
