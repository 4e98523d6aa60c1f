"""``robocas eval audit``: replay the stored actions of a result, and compare the outcomes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from robocas_ms3.cli.options import CORES, Jobs, Maybe, resumable
from robocas_ms3.core.text import format_count

if TYPE_CHECKING:
    from collections.abc import Collection

    from robocas_ms3.evaluation.audit.replay import AuditedEpisode
    from robocas_ms3.evaluation.audit.run import AuditPlan, AuditSettings, AuditSummary
    from robocas_ms3.evaluation.protocols.protocol import LoadedProtocol
    from robocas_ms3.evaluation.results.result_files import Result


@dataclass(kw_only=True)
class ReplayOptions:
    """Options of commands that replay stored actions."""

    jobs: Jobs = CORES
    """Number of processes. Default: one per CPU core. 0: replay in this process, without limits of time and memory."""

    def make_settings(
        self, stored_episodes: Collection[int] | None = None, *, overwrite: bool = False
    ) -> AuditSettings:
        """Return the settings of an audit; raise an error if a number is too small."""
        from robocas_ms3.core.checks import check_number
        from robocas_ms3.evaluation.audit.run import AuditSettings

        check_number("--jobs", self.jobs, 0)
        return AuditSettings(stored_episodes=stored_episodes, jobs=self.jobs, overwrite=overwrite)


@dataclass(kw_only=True)
class SampleOptions(ReplayOptions):
    """Options of commands that may replay a part of the stored actions."""

    sample: Annotated[Maybe[int], tyro.conf.arg(metavar="N")] = None
    """Replay N episodes per result, chosen at random. Default: all with stored actions."""
    seed: Annotated[Maybe[int], tyro.conf.arg(metavar="N")] = None
    """Random seed of --sample. Default: a random number, which is printed."""

    def make_settings(
        self, stored_episodes: Collection[int] | None = None, *, overwrite: bool = False
    ) -> AuditSettings:
        """Return the settings of an audit; raise an error if a number is too small."""
        from robocas_ms3.core.checks import check_number

        for name, number, least in (("--sample", self.sample, 1), ("--seed", self.seed, 0)):
            if number is not None:
                check_number(name, number, least)
        settings = super().make_settings(stored_episodes, overwrite=overwrite)
        return replace(settings, sample=self.sample, seed=self.seed)


@dataclass
class Audit(SampleOptions):
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
    """Folder of the audit. Default: audit/FOLDER in the working directory; audit/NAME, with the name of FOLDER, if
    FOLDER is elsewhere."""
    overwrite: bool = False
    """Delete an existing audit and start again. Default: continue it."""


@resumable
def audit(cfg: Audit) -> int:
    from robocas_ms3.cli.eval_results import print_violations
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.evaluation.audit.obstacles import find_audit_obstacle
    from robocas_ms3.evaluation.results.result_files import load_protocol_of, read_result
    from robocas_ms3.evaluation.results.verify import find_violations

    settings = cfg.make_settings(overwrite=cfg.overwrite)
    result = read_result(cfg.folder)
    protocol = load_protocol_of(result, cfg.protocol)
    if violations := find_violations(result, protocol, is_complete=False):
        print_violations(violations)
        print_line(f"{cfg.folder}: {format_count(len(violations), 'violation')}; no episode was replayed")
        return 1
    if obstacle := find_audit_obstacle(result):
        print_line(f"{cfg.folder}: cannot be audited: {obstacle}")
        return 1
    folder, here = cfg.folder.resolve(), Path.cwd().resolve()
    name = folder.relative_to(here) if folder.is_relative_to(here) else folder.name
    out = cfg.out or Path("audit") / name
    summary = replay_result(result, protocol, out, settings)
    return _print_summary(cfg.folder, result, protocol, summary)


def replay_result(result: Result, protocol: LoadedProtocol, out: Path, settings: AuditSettings) -> AuditSummary:
    """Replay episodes of a result with a progress bar; print notes and differences (`run_audit`)."""
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.source_hash import hash_source
    from robocas_ms3.evaluation.audit.obstacles import list_other_processors
    from robocas_ms3.evaluation.audit.run import AuditSummary, run_audit

    if models := list_other_processors(result):
        print_line(f"note: made on another model of processor, so contacts may diverge: {', '.join(models)}")
    if result.run.source_hash not in ("", hash_source()):
        print_line("note: made with other source code of robocas_ms3, so outcomes may differ")
    plans: list[AuditPlan] = []
    episodes: list[AuditedEpisode] = []
    with ProgressBar("episodes replayed") as bar:

        def start(plan: AuditPlan) -> None:
            plans.append(plan)
            if plan.replayed_before < len(plan.episodes):
                bar.start(len(plan.episodes), plan.replayed_before)

        for one in run_audit(result, protocol, out, settings, start):
            episodes.append(one)
            if len(episodes) > plans[0].replayed_before:
                bar.advance()
    summary = AuditSummary(plans[0], episodes)
    for difference in summary.differences:
        print_line(f"{result.folder}: {difference}")
    return summary


def describe_earlier_replays(plan: AuditPlan) -> str:
    """Return how many episodes were replayed in an earlier run, in parentheses; empty if none."""
    return f" ({plan.replayed_before} of them in an earlier run)" if plan.replayed_before else ""


def _print_summary(folder: Path, result: Result, protocol: LoadedProtocol, summary: AuditSummary) -> int:
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.evaluation.audit.sample import bound_differing_episodes

    plan, total = summary.plan, len(result.outcomes)
    count = len(plan.episodes)
    if summary.with_tolerances:
        text = format_count(summary.with_tolerances, "episode")
        print_line(f"note: {text} diverged; replayed from checkpoint to checkpoint, with tolerances")
    print_line(
        f"{folder}: {count} of {format_count(total, 'episode')} replayed{describe_earlier_replays(plan)}, "
        f"of {len(protocol.episodes)} in the protocol"
    )
    if failed := result.count_errors():
        print_line(f"note: {format_count(failed, 'episode')} ended with an error and counted as failed")
    if lacking := total - plan.candidates:
        print_line(
            f"note: {format_count(lacking, 'episode')} failed before the first action, so there is nothing to replay"
        )
    if differing := sum(bool(one.differences) for one in summary.episodes):
        print_line(f"different from the result: {differing} of {format_count(count, 'episode')}")
        return 1
    print_line("no differences beyond the tolerances" if summary.with_tolerances else "all equal the recorded episodes")
    if count < plan.candidates:
        bound = bound_differing_episodes(count, plan.candidates)
        print_line(f"sample with seed {plan.seed}: at most {bound} of the {plan.candidates} differ (95 % confidence)")
    return 0
