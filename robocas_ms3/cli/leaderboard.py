"""``robocas leaderboard add | audit``: add results to the leaderboard, and check its entries."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from robocas_ms3.cli.eval_results import Results
from robocas_ms3.cli.options import Folders, Maybe
from robocas_ms3.core.text import format_count

if TYPE_CHECKING:
    from robocas_ms3.evaluation.protocol import LoadedProtocol
    from robocas_ms3.evaluation.results import Result


@dataclass(kw_only=True)
class Add(Results):
    """Add a result to an entry, a folder with the results of a policy.

    The copy has all outcomes, and the stored actions of 50 episodes that the protocol fixes. The result is first
    checked like in `robocas eval verify`. It may lack tasks and splits of the protocol, but no episodes of the others.

    Example: robocas leaderboard add eval/pick --out leaderboard/mine/paper-v1
    """

    out: Annotated[Path, tyro.conf.arg(metavar="ENTRY/PROTOCOL")]
    """Folder of the result in the entry."""
    overwrite: bool = False
    """Replace an existing result."""


@dataclass
class AuditEntries:
    """Check entries, and replay their stored actions (exit status 1 if an outcome differs).

    Example: robocas leaderboard audit leaderboard/mine --sample 5
    """

    entries: Folders
    """Folders of entries, or of results in entries."""
    sample: Annotated[Maybe[int], tyro.conf.arg(metavar="N")] = None
    """Replay N episodes per result, chosen at random. Default: all with stored actions."""
    envs: Annotated[Maybe[int], tyro.conf.arg(metavar="N")] = None
    """Number of environments that run at the same time. Default: one per CPU core."""


def add(cfg: Add) -> int:
    from robocas_ms3.cli.eval_results import find_protocol_of, read
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.evaluation.leaderboard.entries import write_result

    result = read(cfg.folders)
    sample = write_result(result, find_protocol_of(result, cfg.protocol), cfg.out, overwrite=cfg.overwrite)
    print_line(f"wrote {cfg.out}: {format_count(len(result.outcomes), 'episode')}, actions of {len(sample)}")
    return 0


def audit(cfg: AuditEntries) -> int:
    from robocas_ms3.cli.eval_results import find_protocol_of
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.checks import check_number
    from robocas_ms3.evaluation.leaderboard.entries import find_result_violations, find_results
    from robocas_ms3.evaluation.results import read_result

    for name in ("sample", "envs"):
        if (number := getattr(cfg, name)) is not None:
            check_number(f"--{name}", number, 1)
    bad = 0
    folders = [folder for entry in cfg.entries for folder in find_results(entry)]
    for folder in folders:
        result = read_result(folder)
        protocol = find_protocol_of(result, None)
        problems = find_result_violations(result, protocol) or _replay(result, protocol, cfg)
        for problem in problems:
            print_line(f"{folder}: {problem}")
        bad += bool(problems)
        if not problems:
            print_line(f"{folder}: no differences")
    print_line(f"{format_count(len(folders), 'result')} checked, {bad} with problems")
    return 1 if bad else 0


def _replay(result: Result, protocol: LoadedProtocol, cfg: AuditEntries) -> list[str]:
    """Replay stored actions of a result; return the differences, or why it cannot be replayed."""
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.evaluation.audit import find_audit_obstacle, run_audit
    from robocas_ms3.evaluation.leaderboard.entries import list_stored_episodes

    if obstacle := find_audit_obstacle(result):
        return [f"cannot be audited: {obstacle}"]
    problems = []
    with ProgressBar("episodes replayed") as bar, tempfile.TemporaryDirectory() as folder:
        for one in run_audit(
            result,
            protocol,
            Path(folder) / "audit",
            sample=cfg.sample,
            stored=list_stored_episodes(result, protocol),
            envs=cfg.envs or len(os.sched_getaffinity(0)),
            on_start=lambda plan: bar.start(len(plan.episodes)),
        ):
            bar.advance()
            problems += [f"episode {one.episode}, recorded -> replayed: {text}" for text in one.differences]
    return problems


COMMANDS = {"add": add, "audit": audit}
DESCRIPTION = "Add results to the leaderboard, and check its entries."
