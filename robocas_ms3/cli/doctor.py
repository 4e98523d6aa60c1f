"""``robocas doctor``: check what works on this machine."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from robocas_ms3.core.words import count_of

if TYPE_CHECKING:
    from robocas_ms3.doctor.checks import Finding


@dataclass
class Doctor:
    """Check versions, render device, physics, planner, assets and disk; exit code 1 if something required fails.

    Example: robocas doctor
    """

    json: bool = False
    """Print a machine-readable report."""


def main(cfg: Doctor) -> int:
    from robocas_ms3.cli.bars import working
    from robocas_ms3.cli.terminal import say_json
    from robocas_ms3.doctor.checks import examine

    with working("examining"):
        findings = examine()
    failed = sum(finding.status == "fail" for finding in findings)
    if cfg.json:
        say_json({"ok": not failed, "findings": [asdict(finding) for finding in findings]})
    else:
        _print(findings, failed)
    return 1 if failed else 0


def _print(findings: list[Finding], failed: int) -> None:
    from rich.table import Table
    from rich.text import Text

    from robocas_ms3.cli.terminal import table_console

    marks = {"ok": Text("ok", "green"), "limited": Text("limited", "yellow"), "fail": Text("FAIL", "bold red")}
    table = Table("", "what")
    table.add_column("found", overflow="fold")
    if any(finding.fix for finding in findings):
        table.add_column("fix", overflow="fold")
    for finding in findings:
        row = (finding.name, finding.found, finding.fix)[: len(table.columns) - 1]
        table.add_row(marks[finding.status], *row)
    console = table_console()
    console.print(table)
    limited = sum(finding.status == "limited" for finding in findings)
    verdict = f"{failed} of what is needed fails" if failed else "everything needed works"
    console.print(verdict + (f"; {count_of(limited, 'optional row')} limited" if limited else ""))
