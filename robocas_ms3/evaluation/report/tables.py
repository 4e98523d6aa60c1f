"""A result as Markdown."""

from __future__ import annotations

from collections import Counter

from robocas_ms3.core.words import count_of, in_markdown
from robocas_ms3.evaluation.outcomes import STAGES, Outcome, summarize_retrieval
from robocas_ms3.evaluation.results import Result
from robocas_ms3.evaluation.statistics import Share, success_by

P_VIS_EDGES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
WELDED = (
    "With upstream's weld: what closed fingers had lifted hung on the hand until the gripper was told to open. "
    "Never compare this with results without it."
)


def title(result: Result) -> str:
    """Return what a result is of, in a line of plain text."""
    how = " with upstream's weld" if result.run.weld else ""
    return f"{result.run.policy.name} by {result.run.protocol}{how}"


def markdown(result: Result) -> str:
    """The tables of a result."""
    run, broken = result.run, result.broken_off()
    lines = [
        f"# {in_markdown(title(result))}",
        "",
        *([f"**{WELDED}**", ""] if run.weld else []),
        f"Protocol hash {in_markdown(run.protocol_hash[:16])}, {count_of(len(result.outcomes), 'episode')}, "
        f"{in_markdown(run.backend)}; "
        + in_markdown(", ".join(f"{name} {number}" for name, number in run.versions.items()))
        + ". Intervals are Clopper-Pearson's, 95 %. RA, PA: any object reached, lifted; RR: the target reached; "
        "CO: what hid it cleared.",
        *(["", f"**Broken off by an error: {count_of(broken, 'episode')}, counted as failed.**"] if broken else []),
        "",
        "| configuration | n | success | at the end | upstream's | " + " | ".join(STAGES) + " | steps | s |",
        "|---|---|---|---|---|" + "---|" * (len(STAGES) + 2),
    ]
    for config, outcomes in result.by("config").items():
        cells = [
            in_markdown(config),
            str(len(outcomes)),
            percent(result.rate("success", outcomes)),
            percent(result.rate("success_at_end", outcomes), interval=False),
            _stage(result, "success_v0", outcomes),
            *(_stage(result, stage, outcomes) for stage in STAGES.values()),
            f"{_mean([one.steps for one in outcomes]):.0f}",
            f"{_mean([one.seconds for one in outcomes]):.1f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    lines += _splits(result)
    lines += ["", "## Where episodes failed", "", "| configuration | first stage not reached |", "|---|---|"]
    for config, outcomes in result.by("config").items():
        found = Counter(one.failure_stage for one in outcomes if one.failure_stage)
        said = ", ".join(f"{stage} {count}" for stage, count in found.most_common())
        lines.append(f"| {in_markdown(config)} | {in_markdown(said) or 'none failed'} |")
    hidden = [one for one in first_splits(result) if one.p_vis is not None]
    if hidden:
        lines += ["", "## By what is seen of the target (p_vis)", "", "| p_vis | n | success |", "|---|---|---|"]
        for found in success_by([one.p_vis or 0.0 for one in hidden], [one.success for one in hidden], P_VIS_EDGES):
            rate = "" if found.share is None else percent(found.share)
            lines.append(
                f"| {found.low:g} to {found.high:g} | {0 if found.share is None else found.share.n} | {rate} |"
            )
    return "\n".join([*lines, *_retrieval(result)]) + "\n"


def first_splits(result: Result) -> list[Outcome]:
    """The outcomes; where scenes may be there several times, those of each task's first split alone."""
    if not result.repeats():
        return list(result.outcomes.values())
    first: dict[str, str] = {}
    for one in result.outcomes.values():
        first.setdefault(one.task, one.split)
    return [one for one in result.outcomes.values() if one.split == first[one.task]]


def _splits(result: Result) -> list[str]:
    splits = result.by("split")
    if len(splits) < 2:
        return []
    heads = " | ".join(map(in_markdown, splits))
    lines = ["", "## By split", "", f"| task | {heads} |", "|---|" + "---|" * len(splits)]
    for task in result.by("task"):
        cells = []
        for outcomes in splits.values():
            of_task = [one for one in outcomes if one.task == task]
            cells.append(f"{percent(result.rate('success', of_task))} of {len(of_task)}" if of_task else "")
        lines.append(f"| {in_markdown(task)} | {' | '.join(cells)} |")
    return lines


def _retrieval(result: Result) -> list[str]:
    found = {
        config: summarize_retrieval(one.retrieval for one in group) for config, group in result.by("config").items()
    }
    if not any(found.values()):
        return []
    lines = ["", "## What was moved before the target", ""]
    lines += [
        "| configuration | target held | order score | moved | needed of these | left |",
        "|---|---|---|---|---|---|",
    ]
    for config, one in found.items():
        if one is not None:
            shares = f"{one.score:.2f} | {one.moved:.1f} | {100 * one.needed:.0f} %"
            lines.append(f"| {in_markdown(config)} | {one.held} | {shares} | {one.left:.1f} |")
    return lines


def percent(share: Share, *, interval: bool = True) -> str:
    """A share in words: ``72 % (65 to 78)``."""
    text = f"{100 * share.k / share.n:.0f} %"
    return f"{text} ({100 * share.low:.0f} to {100 * share.high:.0f})" if interval else text


def _stage(result: Result, stage: str, outcomes: list[Outcome]) -> str:
    return percent(result.rate(stage, outcomes), interval=False) if stage in outcomes[0].flags else ""


def _mean(values: list[float] | list[int]) -> float:
    return sum(values) / max(len(values), 1)
