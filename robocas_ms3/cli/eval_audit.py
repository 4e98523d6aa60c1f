"""``robocas eval audit``: play the stored actions of a result again and compare the outcomes."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from robocas_ms3.cli.options import Maybe, resumable
from robocas_ms3.core.text import format_count

if TYPE_CHECKING:
    from robocas_ms3.evaluation.audit import AuditPlan
    from robocas_ms3.evaluation.results import Result


@dataclass
class Audit:
    """Play the stored actions of a result again, and compare the outcomes (exit status 1 if one differs).

    The result is checked by `robocas eval verify` first. Neither the policy nor a renderer is needed.

    Example: robocas eval audit eval/pick --sample 50
    """

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of the result."""
    protocol: Annotated[Maybe[str], tyro.conf.arg(metavar="PROTOCOL")] = None
    """Protocol folder. Required if the protocol of the result is not bundled."""
    sample: Annotated[Maybe[int], tyro.conf.arg(metavar="N")] = None
    """Play only N episodes, chosen at random. Default: all."""
    seed: Annotated[Maybe[int], tyro.conf.arg(metavar="N")] = None
    """Random seed of --sample. Default: a number that nobody can predict; it is printed and recorded."""
    out: Maybe[Path] = None
    """Folder of the audit. Default: the name of the result folder with the suffix _audit."""
    envs: Annotated[Maybe[int], tyro.conf.arg(metavar="N")] = None
    """Number of environments that run at the same time. Default: one per CPU core."""
    overwrite: bool = False
    """Delete an existing audit and start again. Default: continue it."""


@resumable
def audit(cfg: Audit) -> int:
    from robocas_ms3.cli.eval_results import find_protocol_of
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.checks import check_number
    from robocas_ms3.evaluation.audit import AuditPlan, find_audit_obstacle, run_audit
    from robocas_ms3.evaluation.results import read_result
    from robocas_ms3.evaluation.verify import count_missing_episodes, find_violations

    for name in ("sample", "envs"):
        if (number := getattr(cfg, name)) is not None:
            check_number(f"--{name}", number, 1)
    result = read_result(cfg.folder)
    protocol = find_protocol_of(result, cfg.protocol)
    if violations := find_violations(result, protocol, is_complete=False):
        for violation in violations:
            print_line(violation)
        print_line(f"{cfg.folder}: {format_count(len(violations), 'violation')}; no episode was played")
        return 1
    if missing := count_missing_episodes(result, protocol):
        print_line(f"note: {missing} of {format_count(len(protocol.episodes), 'episode')} are not in the result")
    if obstacle := find_audit_obstacle(result):
        print_line(f"{cfg.folder}: cannot be audited: {obstacle}")
        return 1
    plan = AuditPlan([], 0)
    with ProgressBar("episodes played") as bar:

        def start(chosen: AuditPlan) -> None:
            nonlocal plan
            plan = chosen
            bar.start(len(plan.numbers))

        differing = 0
        for one in run_audit(
            result,
            protocol,
            cfg.out or cfg.folder.with_name(f"{cfg.folder.absolute().name}_audit"),
            sample=cfg.sample,
            seed=cfg.seed,
            envs=cfg.envs or len(os.sched_getaffinity(0)),
            overwrite=cfg.overwrite,
            on_start=start,
        ):
            bar.advance()
            differing += bool(one.differences)
            for difference in one.differences:
                print_line(f"episode {one.episode}: recorded -> played: {difference}")
    return _print_summary(cfg.folder, result, plan, differing)


def _print_summary(folder: Path, result: Result, plan: AuditPlan, differing: int) -> int:
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.evaluation.audit import bound_differing_episodes

    broken, count = result.count_errors(), len(plan.numbers)
    total = len(result.outcomes) - broken
    played = f"{folder}: {count} of {format_count(total, 'episode')} played"
    if broken:
        print_line(
            f"note: {format_count(broken, 'episode')} ended with an error, counted as failed and cannot be played"
        )
    if differing:
        print_line(f"{played}; {differing} differ from the result")
        return 1
    sampled = ""
    if count < total:
        bound = bound_differing_episodes(count, total)
        sampled = f". Sample with seed {plan.seed}: at most {bound} of the {total} differ (95 % confidence)"
    print_line(f"{played}, all with the recorded outcomes{sampled}")
    return 0
