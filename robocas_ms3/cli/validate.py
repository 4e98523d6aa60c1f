"""``robocas validate``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass
class Validate:
    """Check a RoboCAS dataset against the schema and list every violation; exit code 1 if there is any."""

    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset."""
    json: bool = False
    """Print a machine-readable report."""


def main(cfg: Validate) -> int:
    """Validate; gives the exit code."""
    import json

    from rich.console import Console
    from rich.progress import Progress

    from robocas_ms3.datasets.validate import validate

    progress = Progress(console=Console(stderr=True), transient=True)  # shown when there is something to do
    bar = progress.add_task("episodes", total=None)

    def on_episode(done: int, count: int) -> None:
        progress.start()
        progress.update(bar, completed=done, total=count)

    try:
        report = validate(cfg.dataset, on_episode=on_episode)
    finally:
        if progress.live.is_started:
            progress.stop()
    console = Console(soft_wrap=True, highlight=False, markup=False)
    if cfg.json:
        console.print(json.dumps(report.as_json(), indent=2, ensure_ascii=False))
    else:
        for violation in report.violations:
            console.print(str(violation))
        verdict = f"{len(report.violations)} violations" if report.violations else "valid"
        console.print(f"{cfg.dataset}: {report.episodes} episodes, {report.steps} steps, {verdict}")
    return 1 if report.violations else 0
