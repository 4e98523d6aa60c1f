"""Draw the learning curves of runs of `robocas train ppo` in one figure; write a JPEG file.

python benchmarks/learning_curve.py out/ppo_1 out/ppo_2 out/ppo_3 [--out docs/images/ppo.jpg]
"""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

COLOURS = ("#2f6fa8", "#e08a2e", "#4f9a6a", "#9a5fa8", "#7a7a7a")


@dataclass
class Args:
    runs: tyro.conf.Positional[list[Path]]
    """Folders of the runs, each with a metrics.csv."""
    out: Path = Path("docs/images/ppo.jpg")


def main(args: Args) -> None:
    with rc_context({"font.size": 9, "axes.titlesize": 10}):
        figure = Figure(figsize=(11, 3), layout="constrained")
        FigureCanvasAgg(figure)
        left, middle, right = figure.subplots(1, 3)
        for run, colour in zip(args.runs, COLOURS, strict=False):
            found = read_metrics(run / "metrics.csv")
            steps = found["step"] / 1000
            left.plot(steps, found["return"], color=colour)
            middle.plot(steps, 100 * found["held"], color=colour)
            right.plot(found["seconds"] / 60, 100 * found["held"], color=colour, label=run.name)
        left.set(title="return per episode", xlabel="thousand steps")
        middle.set(title="held at the end, %", xlabel="thousand steps", ylim=(0, 100))
        right.set(title="held at the end, %", xlabel="minutes", ylim=(0, 100))
        right.legend(frameon=False)
        for axes in (left, middle, right):
            axes.grid(alpha=0.3)
            for side in ("top", "right"):
                axes.spines[side].set_visible(False)
        figure.savefig(args.out, dpi=110, pil_kwargs={"quality": 88})


def read_metrics(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of the training rows of a metrics.csv."""
    with path.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["split"] == "train"]
    names = ("step", "seconds", "return", "held")
    return {name: np.array([float(row[name]) for row in rows]) for name in names}


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
