"""``robocas validate``: check a dataset."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from robocas_ms3.cli.options import Maybe
from robocas_ms3.cli.progress import ProgressBar
from robocas_ms3.cli.terminal import print_json, print_line
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.text import format_count

if TYPE_CHECKING:
    from robocas_ms3.datasets.checks.dataset import ValidationReport
    from robocas_ms3.datasets.checks.replay import ReplayReport


@dataclass
class Validate:
    """Check a dataset of any format and list every violation of the format; exit code 1 if there is one.

    With --replay, each episode is also replayed open loop from its 7-D actions in its rebuilt scene. The report says
    how many succeed again and how far the gripper deviates. This changes the exit code only with --min-success.

    Example: robocas validate datasets/pick --replay
    """

    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset."""
    replay: bool = False
    """Replay the actions too (RoboCAS folders; simulated, not rendered)."""
    min_success: Maybe[float] = None
    """With --replay: exit code 1 if a smaller fraction of the episodes of a task succeeds again (0 to 1), or if none of
    them could be replayed."""
    pack: Maybe[str] = None
    """With --replay: object pack to use instead of the recorded one: its name, or its folder."""
    json: bool = False
    """Print a machine-readable report."""


def main(cfg: Validate) -> int:
    from robocas_ms3.datasets.checks.dataset import validate
    from robocas_ms3.datasets.formats import detect_format

    if cfg.min_success is not None and not cfg.replay:
        raise DatasetError("a share of replayed episodes needs --replay", where="--min-success")
    if cfg.min_success is not None and not 0 <= cfg.min_success <= 1:
        raise DatasetError("no such share", where="--min-success", expected="0 to 1", found=cfg.min_success)
    found = detect_format(cfg.dataset)
    if found and found.name != "robocas" and cfg.replay:
        raise DatasetError("only RoboCAS folders can be replayed", where=cfg.dataset)
    with ProgressBar("episodes checked", transient=True) as bar:
        check = found.load("checker") if found and found.checker else validate
        report: ValidationReport = check(cfg.dataset, on_episode=bar.update)
    if not cfg.json:
        for violation in report.violations:
            print_line(str(violation))
        verdict = format_count(len(report.violations), "violation") if report.violations else "valid"
        counts = f"{format_count(report.episodes, 'episode')}, {format_count(report.steps, 'step')}"
        print_line(f"{cfg.dataset}: {counts}, {verdict}")
    content, wrong = report.as_json(), bool(report.violations)
    if cfg.replay:
        replays = _replay(cfg.dataset, cfg.pack)
        content["replay"] = replays.as_json()
        least = cfg.min_success or 0.0
        wrong |= any((of_task["share"] or 0.0) < least for of_task in replays.by_task().values())
        if not cfg.json:
            for line in _lines(replays):
                print_line(line)
    if cfg.json:
        print_json(content)
    return 1 if wrong else 0


def _replay(root: Path, pack: str | None) -> ReplayReport:

    from robocas_ms3.core.workers import use_one_torch_thread
    from robocas_ms3.datasets.checks.replay import replay_dataset

    use_one_torch_thread()
    with ProgressBar("episodes replayed", transient=True) as bar:
        return replay_dataset(root, pack=pack, on_episode=bar.update)


def _lines(report: ReplayReport) -> Iterator[str]:
    for episode in report.episodes:
        if episode.skipped:
            yield f"episode {episode.number}: not replayed: {episode.skipped}"
        elif not episode.success:
            strayed = f"strayed {episode.max_error * 1000:.0f} mm at most"
            yield f"episode {episode.number}: its own actions do not succeed again; {strayed}"
    for task, of_task in report.by_task().items():
        name = task or "unknown task"
        if not of_task["tried"]:
            yield f"{name}: none of {format_count(of_task['skipped'], 'episode')} could be replayed: no share is known"
        else:
            yield (
                f"{name}: {of_task['succeeded']} of {of_task['tried']} replayed episodes succeed"
                f" again ({of_task['share']:.0%}); tracking error {of_task['mean_error'] * 1000:.1f} mm on average,"
                f" {of_task['max_error'] * 1000:.0f} mm at most"
            )
