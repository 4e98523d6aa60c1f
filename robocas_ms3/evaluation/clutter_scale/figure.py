"""Plot of the success of policies against the difficulty of scenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from robocas_ms3.core.files import atomic_file
from robocas_ms3.datasets.statistics.figures import DPI, choose_colors, make_axes, make_figure
from robocas_ms3.evaluation.clutter_scale.item_response import HARDEST
from robocas_ms3.evaluation.clutter_scale.study import ClutterStudy

_DASHED = "privileged"  # track whose curves are dashed


def write_curves(study: ClutterStudy, path: Path) -> None:
    """Write the curves of all policies, and the number of scenes by difficulty, as PNG; one column per task."""
    columns = len(study.tasks)
    figure = make_figure(max(9, 1.5 + 5 * columns), 5.5)
    axes = make_axes(figure, 2, columns, 2 * columns)
    figure.get_layout_engine().set(h_pad=0.1)
    names = dict.fromkeys(policy.name for task in study.tasks.values() for policy in task.policies)
    colors = dict(zip(names, choose_colors(len(names)), strict=True))
    lines = {}
    difficulty = np.linspace(0, HARDEST, 101)
    for column, (name, task) in enumerate(study.tasks.items()):
        curves, scenes = axes[column], axes[columns + column]
        for policy in task.policies:
            color, style = colors[policy.name], "--" if policy.track == _DASHED else "-"
            (lines[policy.name],) = curves.plot(difficulty, 100 * policy.curve.predict(difficulty), style, color=color)
            if policy.curve.half is not None and 0 <= policy.curve.half <= HARDEST:
                low, high = np.clip([policy.curve.low, policy.curve.high], 0, HARDEST)
                curves.plot([low, high], [50, 50], color=color, alpha=0.4, linewidth=4)
                curves.plot(policy.curve.half, 50, "o", color=color)
        curves.set(title=name, ylabel="success / %", ylim=(-2, 102), xlim=(0, HARDEST))
        scenes.hist(task.difficulty, bins=20, range=(0, HARDEST))
        scenes.set(xlabel="difficulty", ylabel="scenes", xlim=(0, HARDEST))
    title = "Success against difficulty (dots: half of the episodes succeed; bars: 95 % intervals; dashed: privileged)"
    figure.suptitle(title, fontsize=10)
    figure.legend(lines.values(), lines, fontsize=7, loc="outside lower center", ncols=2)
    with atomic_file(path) as tmp:
        figure.savefig(tmp, dpi=DPI, format="png")
