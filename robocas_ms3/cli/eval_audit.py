"""``robocas eval audit``: replay the stored actions of a result, and compare the outcomes."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from robocas_ms3.cli.options import Maybe, resumable
from robocas_ms3.core.text import format_count

if TYPE_CHECKING:
    from robocas_ms3.evaluation.audit.run import AuditPlan
    from robocas_ms3.evaluation.protocol import LoadedProtocol
    from robocas_ms3.evaluation.results import Result


@dataclass
class Audit:
    """Replay the stored actions of a result, and compare the outcomes (exit status 1 if one differs).

    The result is first checked like in `robocas eval verify`, but it may lack episodes. Neither the policy nor a
    renderer is needed.

    Example: robocas eval audit eval/pick --sample 50
    """

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of the result."""
    protocol: Annotated[Maybe[str], tyro.conf.arg(metavar="PROTOCOL")] = None
    """Protocol folder. Required if the protocol of the result is not bundled."""
    out: Maybe[Path] = None
    """Folder of the audit. Default: audit/NAME in the working directory; NAME: name of the result folder."""
    sample: Annotated[Maybe[int], tyro.conf.arg(metavar="N")] = None
    """Replay only N episodes, chosen at random. Default: all."""
    seed: Annotated[Maybe[int], tyro.conf.arg(metavar="N")] = None
    """Random seed of --sample. Default: a number that nobody can predict; it is printed and recorded."""
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
    from robocas_ms3.evaluation.audit.run import find_audit_obstacle, list_other_processors, run_audit
    from robocas_ms3.evaluation.results import read_result
    from robocas_ms3.evaluation.run_record import hash_source
    from robocas_ms3.evaluation.verify import find_violations

    for name, least in (("sample", 1), ("envs", 1), ("seed", 0)):
        if (number := getattr(cfg, name)) is not None:
            check_number(f"--{name}", number, least)
    result = read_result(cfg.folder)
    protocol = find_protocol_of(result, cfg.protocol)
    if violations := find_violations(result, protocol, is_complete=False):
        for violation in violations:
            print_line(violation)
        print_line(f"{cfg.folder}: {format_count(len(violations), 'violation')}; no episode was replayed")
        return 1
    if obstacle := find_audit_obstacle(result):
        print_line(f"{cfg.folder}: cannot be audited: {obstacle}")
        return 1
    if models := list_other_processors(result):
        print_line(f"note: made on another model of processor, so contacts may diverge: {', '.join(models)}")
    if result.run.source_hash not in ("", hash_source()):
        print_line("note: made with other source code of robocas_ms3, so outcomes may differ")
    plans: list[AuditPlan] = []
    differing = from_checkpoints = 0
    with ProgressBar("episodes replayed") as bar:

        def start(plan: AuditPlan) -> None:
            plans.append(plan)
            bar.start(len(plan.episodes))

        for one in run_audit(
            result,
            protocol,
            cfg.out or Path("audit") / cfg.folder.absolute().name,
            sample=cfg.sample,
            seed=cfg.seed,
            envs=cfg.envs or len(os.sched_getaffinity(0)),
            overwrite=cfg.overwrite,
            on_start=start,
        ):
            bar.advance()
            differing += bool(one.differences)
            from_checkpoints += one.mode == "checkpoints"
            for difference in one.differences:
                print_line(f"episode {one.episode}, recorded -> replayed: {difference}")
    if from_checkpoints:
        count = format_count(from_checkpoints, "episode")
        print_line(f"note: {count} diverged and were replayed from checkpoint to checkpoint, with tolerances")
    equal = "no differences beyond the tolerances" if from_checkpoints else "all equal the result"
    return _print_summary(cfg.folder, result, protocol, plans[0], differing, equal)


def _print_summary(
    folder: Path, result: Result, protocol: LoadedProtocol, plan: AuditPlan, differing: int, equal: str
) -> int:
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.evaluation.audit.run import bound_differing_episodes

    count, total = len(plan.episodes), len(result.outcomes)
    print_line(
        f"{folder}: {count} of {format_count(total, 'episode')} replayed ({plan.replayed} of them earlier), "
        f"of {len(protocol.episodes)} in the protocol"
    )
    if failed := result.count_errors():
        print_line(f"note: {format_count(failed, 'episode')} ended with an error and counted as failed")
    if differing:
        print_line(f"{differing} of {format_count(count, 'episode')} differ from the result")
        return 1
    print_line(equal)
    if count < total:
        bound = bound_differing_episodes(count, total)
        print_line(f"sample with seed {plan.seed}: at most {bound} of the {total} differ (95 % confidence)")
    return 0
