"""Plots of the statistics of a dataset, with matplotlib and without a display."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from robocas_ms3.core.text import format_count, format_object_name
from robocas_ms3.datasets.actions import ACTION_NAMES
from robocas_ms3.datasets.statistics.collect import DatasetStatistics, compute_histogram, sort_counts
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
from robocas_ms3.datasets.statistics.layouts import LayoutMap

MAX_ROWS = 50  # bars per plot; stats.json has all


def write_stats(stats: DatasetStatistics, out: Path) -> list[Path]:
    """Write ``stats.json`` and the plots as PNG into a folder; return the paths."""
    return write_figures(stats.as_json(), {name: partial(draw, stats) for name, draw in PLOTS.items()}, out)


def draw_lengths(stats: DatasetStatistics) -> Any:
    rows, columns = grid_shape(len(stats.lengths), 2)
    figure = make_figure(4.6 * columns + 0.4, 2.7 * rows + 0.3)
    panels = make_axes(figure, rows, columns, len(stats.lengths))
    for axes, (task, lengths) in zip(panels, sorted(stats.lengths.items()), strict=True):
        low, high = min(lengths), max(lengths)
        edges = np.linspace(low - 0.5, high + 0.5, min(30, high - low + 1) + 1)
        axes.hist(lengths, bins=edges, color=BLUE, edgecolor="white", linewidth=0.5)
        median = float(np.median(lengths))
        axes.axvline(median, color=ORANGE, linestyle="--", linewidth=1)
        about = f"median {median:.0f} steps = {median / stats.rate_hz:.0f} s"
        axes.set_title(f"{shorten_label(task)}: {format_count(len(lengths), 'episode')}, {about}")
        axes.set(xlabel=f"steps of {stats.rate_hz:g} Hz", ylabel="episodes")
        use_integer_ticks(axes.xaxis)
        use_integer_ticks(axes.yaxis)
    return figure


def draw_objects(stats: DatasetStatistics) -> Any:
    if not stats.objects and not stats.targets:
        return None
    everything = sort_counts(stats.objects | stats.targets)
    ids = list(everything)[:MAX_ROWS]
    figure = make_figure(7, 1.2 + 0.2 * len(ids))
    axes = make_axes(figure, 1, 1, 1)[0]
    rows = np.arange(len(ids))
    names = [shorten_label(format_object_name(i, stats.names.get(i, ""))) for i in ids]
    axes.barh(rows, [stats.objects[i] for i in ids], color=GREY, height=0.8, label="in the scene")
    axes.barh(rows, [stats.targets[i] for i in ids], color=ORANGE, height=0.45, label="target")
    axes.set_yticks(rows, names)
    axes.set_ylim(len(ids) - 0.4, -0.6)
    use_integer_ticks(axes.xaxis)
    more = f", the first {len(ids)} of {len(everything)}" if len(everything) > len(ids) else ""
    never = sum(1 for asset in everything if not stats.targets[asset])
    axes.set(xlabel="episodes", title=f"Objects{more}; {never} never the target")
    axes.grid(axis="x", color="#dddddd", linewidth=0.6)
    axes.legend(frameon=False, loc="lower right")
    return figure


def draw_layouts(stats: DatasetStatistics) -> Any:
    """Draw a heat map of object positions per configuration, with the targets; x is up, y is left."""
    if not stats.layouts:
        return None
    rows, columns = grid_shape(len(stats.layouts), 3)
    figure = make_figure(4.2 * columns, 2.6 * rows + 0.3)
    panels = make_axes(figure, rows, columns, len(stats.layouts))
    for axes, (name, layout) in zip(panels, sorted(stats.layouts.items()), strict=True):
        _draw_layout(figure, axes, name, layout)
    figure.suptitle("Objects per cell at the start; dots: targets", fontsize=9)
    return figure


def _draw_layout(figure: Any, axes: Any, name: str, layout: LayoutMap) -> None:
    shown = np.ma.masked_equal(layout.counts, 0)
    mesh = axes.pcolormesh(
        layout.y_edges,
        layout.x_edges,
        shown,
        cmap="YlGnBu",
        vmin=0,
        vmax=max(5, layout.counts.max()),  # a single object should not look like a hot spot
        edgecolor="#eeeeee",
        linewidth=0.4,
    )
    if len(layout.targets):
        size = float(np.clip(600 / len(layout.targets), 5, 25))
        axes.scatter(layout.targets[:, 1], layout.targets[:, 0], s=size, color=ORANGE, linewidth=0)
    if layout.region:
        (x0, y0), (x1, y1) = layout.region
        axes.plot([y0, y1, y1, y0, y0], [x0, x0, x1, x1, x0], color="#444444", linewidth=1)
    axes.set_aspect("equal")
    axes.set_xlim(layout.y_edges[-1], layout.y_edges[0])
    axes.set_ylim(layout.x_edges[0], layout.x_edges[-1])
    axes.locator_params(nbins=5)
    covered = "" if layout.coverage is None else f", {layout.coverage:.0%} covered"
    axes.set_title(f"{shorten_label(name)}\n{format_count(layout.episodes, 'episode')}{covered}")
    axes.set(xlabel=f"y of {layout.frame} (m)", ylabel="x (m)")
    bar = figure.colorbar(mesh, cax=axes.inset_axes((1.04, 0.0, 0.04, 1.0)))  # as high as the map
    bar.ax.set_ylim(0, max(1, layout.counts.max()))
    use_integer_ticks(bar.ax.yaxis)


def draw_instructions(stats: DatasetStatistics) -> Any:
    tables = {
        f"Instructions, {len(stats.instructions)} different": stats.instructions,
        f"Templates, {len(stats.templates)} different": stats.templates,
        "Relations": stats.relations,
    }
    tables = {title: list(sort_counts(table).items())[: MAX_ROWS // 2] for title, table in tables.items() if table}
    heights = [0.8 + 0.2 * len(rows) for rows in tables.values()]
    figure = make_figure(10, sum(heights))
    panels = np.atleast_1d(figure.subplots(len(tables), 1, height_ratios=heights))
    for axes, (title, rows) in zip(panels, tables.items(), strict=True):
        axes.spines[["top", "right"]].set_visible(False)
        places = np.arange(len(rows))
        axes.barh(places, [count for _, count in rows], color=BLUE, height=0.7)
        axes.set_yticks(places, [shorten_label(text) for text, _ in rows])
        axes.set_ylim(len(rows) - 0.4, -0.6)
        use_integer_ticks(axes.xaxis)
        axes.set_title(title, loc="left")
    panels[-1].set_xlabel("episodes")
    return figure


def draw_actions(stats: DatasetStatistics) -> Any:
    if not len(stats.actions):
        return None
    figure = make_figure(11, 5.2)
    units = ("m", "m", "m", "rad", "rad", "rad", "")
    for axes, name, column, unit in zip(make_axes(figure, 2, 4, 7), ACTION_NAMES, stats.actions.T, units, strict=True):
        bins = compute_histogram(column)
        edges, counts = np.array(bins["edges"]), np.array(bins["counts"])
        if name == "gripper":
            axes.bar([0, 1], counts, color=BLUE, width=0.6)
            axes.set_xticks([0, 1], ["closed", "open"])
            axes.set(title=f"gripper: {counts[1] / counts.sum():.0%} open", ylabel="steps")
            continue
        axes.stairs(counts, edges, fill=True, color=BLUE)
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.7)
        axes.locator_params(axis="x", nbins=4)
        for percentile in np.percentile(column, [1, 99]):
            axes.axvline(percentile, color=ORANGE, linestyle="--", linewidth=1)
        axes.set(title=f"{name} ({unit})", ylabel="steps (log)")
    figure.suptitle(f"Actions per step at {stats.rate_hz:g} Hz, in the EEF frame; dashed: 1st and 99th percentile")
    return figure


def draw_subgoals(stats: DatasetStatistics) -> Any:
    if not stats.subgoals:
        return None
    kinds = sorted(stats.subgoals, key=lambda kind: -len(stats.subgoals[kind]))
    figure = make_figure(7.5, 1.2 + 0.55 * len(kinds))
    axes = make_axes(figure, 1, 1, 1)[0]
    seconds = [np.array(stats.subgoals[kind]) / stats.rate_hz for kind in kinds]
    boxes = axes.boxplot(
        seconds,
        orientation="horizontal",
        widths=0.5,
        patch_artist=True,
        medianprops={"color": "black"},
        flierprops={"marker": ".", "markersize": 3, "markeredgecolor": GREY},
    )
    for box in boxes["boxes"]:
        box.set(facecolor="#b9d3ea", edgecolor=BLUE)
    labels = [
        f"{shorten_label(kind)}\n{format_count(len(s), 'time')}, median {np.median(s):.1f} s"
        for kind, s in zip(kinds, seconds, strict=True)
    ]
    axes.set_yticks(np.arange(1, len(kinds) + 1), labels)
    axes.invert_yaxis()
    axes.set_xlim(left=0)
    axes.grid(axis="x", color="#dddddd", linewidth=0.6)
    axes.set(xlabel="s", title="Duration of sub-goals")
    return figure


PLOTS: dict[str, Callable[[DatasetStatistics], Any]] = {
    "lengths": draw_lengths,
    "objects": draw_objects,
    "layouts": draw_layouts,
    "instructions": draw_instructions,
    "actions": draw_actions,
    "subgoals": draw_subgoals,
}
"""Plot functions by file name; a function returns None if there is nothing to draw."""
