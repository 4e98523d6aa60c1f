"""Plots of the statistics of ``candidates.h5``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from robocas_ms3.core.text import format_count
from robocas_ms3.datasets.statistics.candidates import ALL_SOURCES, CandidateStatistics
from robocas_ms3.datasets.statistics.figures import (
    BLUE,
    GREY,
    ORANGE,
    grid_shape,
    make_axes,
    make_figure,
    shorten_label,
    use_integer_ticks,
    write_figures,
)
from robocas_ms3.demos.candidates.labels import MIN_BENEFIT

MAX_FAILURES = 30  # bars; stats.json has all


def write_candidate_stats(stats: CandidateStatistics, out: Path) -> list[Path]:
    """Write ``stats.json`` and the plots as PNG into a folder; return the paths."""
    figures = {"outcomes": draw_outcomes, "benefits": draw_benefits, "failures": draw_failures}
    return write_figures(stats.as_json(), {name: partial(draw, stats) for name, draw in figures.items()}, out)


def draw_outcomes(stats: CandidateStatistics) -> Any:
    """Draw the numbers of infeasible, failed and successful candidates per primitive and source."""
    rows = [
        (primitive if source == ALL_SOURCES else f"{primitive}, {source.replace('_', ' ')}", of)
        for primitive, sources in stats.primitives.items()
        for source, of in sources.items()
    ]
    if not rows:
        return None
    figure = make_figure(7, 1.3 + 0.25 * len(rows))
    axes = make_axes(figure, 1, 1, 1)[0]
    places, left = np.arange(len(rows)), np.zeros(len(rows))
    parts = {
        "successful": (BLUE, [of.success.k for _, of in rows]),
        "failed": (ORANGE, [of.feasible.k - of.success.k for _, of in rows]),
        "infeasible": (GREY, [of.candidates - of.feasible.k for _, of in rows]),
    }
    for name, (color, counts) in parts.items():
        axes.barh(places, counts, left=left, color=color, height=0.7, label=name)
        left += counts
    axes.set_yticks(places, [f"{name}  {of.success}" for name, of in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    use_integer_ticks(axes.xaxis)
    axes.set(xlabel="candidates")
    figure.suptitle(f"{stats.title}: outcomes; rate of success with its 95 % interval", fontsize=9)
    axes.legend(frameon=False, loc="lower right")
    return figure


def draw_benefits(stats: CandidateStatistics) -> Any:
    """Draw histograms of the benefit of pushes and lifts for the target."""
    found = {name: values[np.isfinite(values)] for name, values in stats.benefits.items()}
    found = {name: values for name, values in found.items() if len(values)}
    if not found:
        return None
    rows, columns = grid_shape(len(found), 2)
    figure = make_figure(3.8 * columns, 2.7 * rows + 0.3)
    for axes, (name, values) in zip(make_axes(figure, rows, columns, len(found)), found.items(), strict=True):
        axes.hist(values, bins=41, color=BLUE)
        axes.axvline(MIN_BENEFIT, color=ORANGE, linestyle="--", linewidth=1)
        share = (values >= MIN_BENEFIT).mean()
        title = f"{name}: {format_count(len(values), 'candidate')}\n{share:.0%} at least {MIN_BENEFIT:g} s"
        axes.set(title=title, xlabel="benefit (s)", ylabel="candidates")
        use_integer_ticks(axes.yaxis)
    figure.suptitle("Decrease of the target's clearing cost by feasible candidates", fontsize=9)
    return figure


def draw_failures(stats: CandidateStatistics) -> Any:
    """Draw the number of candidates per failure."""
    if not stats.failures:
        return None
    rows = list(stats.failures.items())[:MAX_FAILURES]
    figure = make_figure(7, 1.2 + 0.2 * len(rows))
    axes = make_axes(figure, 1, 1, 1)[0]
    places = np.arange(len(rows))
    axes.barh(places, [count for _, count in rows], color=ORANGE, height=0.7)
    axes.set_yticks(places, [shorten_label(name) for name, _ in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    use_integer_ticks(axes.xaxis)
    axes.set(xlabel="candidates", title=f"{stats.title}: failures")
    return figure
