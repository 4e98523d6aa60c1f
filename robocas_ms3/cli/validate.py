"""``robocas validate``: check a dataset against its format."""

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
    from robocas_ms3.datasets.checks.candidates import CandidatesReport
    from robocas_ms3.datasets.checks.dataset import ValidationReport
    from robocas_ms3.datasets.checks.replay import ReplayReport


@dataclass
class Validate:
    """Check a dataset or candidates.h5 against its format and list every violation (exit status 1 if there is one).

    With --replay, the command also replays the 7-D actions of each episode open loop in its scene. It reports the
    success rate and the tracking error of the gripper. The exit status depends on the success rate only with
    --min-success.

    Example: robocas validate datasets/pick --replay
    """

    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset, or a candidates.h5."""
    replay: bool = False
    """Replay the 7-D actions of each episode in simulation, without rendering (RoboCAS folders only)."""
    min_success: Maybe[float] = None
    """With --replay: lowest accepted success rate per task, 0 to 1.
    Exit status 1 if the rate of a task is lower, or if no episode of a task could be replayed."""
    pack: Annotated[Maybe[str], tyro.conf.arg(metavar="PACK")] = None
    """With --replay: name or folder of the object pack to use instead of the recorded one."""
    json: bool = False
    """Print the report as JSON."""


def main(cfg: Validate) -> int:
    from robocas_ms3.datasets.checks.dataset import validate
    from robocas_ms3.datasets.formats import detect_format

    if cfg.min_success is not None and not cfg.replay:
        raise DatasetError("this option needs --replay", where="--min-success", fix="Add --replay.")
    if cfg.min_success is not None and not 0 <= cfg.min_success <= 1:
        raise DatasetError("invalid success rate", where="--min-success", expected="0 to 1", found=cfg.min_success)
    found = detect_format(cfg.dataset)
    if found and found.name != "robocas" and cfg.replay:
        what, expected = "this dataset can't be replayed", "a RoboCAS folder"
        raise DatasetError(what, where="--replay", expected=expected, found=f"{cfg.dataset}, a {found.title}")
    with ProgressBar("episodes checked", transient=True) as bar:
        check = found.import_function("checker") if found and found.checker else validate
        report: ValidationReport | CandidatesReport = check(cfg.dataset, on_episode=bar.update)
    if not cfg.json:
        for violation in report.violations:
            print_line(str(violation))
        verdict = format_count(len(report.violations), "violation") if report.violations else "valid"
        print_line(f"{cfg.dataset}: {report.describe_size()}, {verdict}")
    content, wrong = report.as_json(), bool(report.violations)
    if cfg.replay:
        replays = _replay(cfg.dataset, cfg.pack)
        content["replay"] = replays.as_json()
        least = cfg.min_success or 0.0
        wrong |= any((of_task["success_rate"] or 0.0) < least for of_task in replays.summarize_by_task().values())
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
            yield f"episode {episode.number} was not replayed: {episode.skipped}"
        elif not episode.success:
            error = f"largest tracking error {episode.max_error * 1000:.0f} mm"
            yield f"episode {episode.number}: the replay failed; {error}"
    for task, of_task in report.summarize_by_task().items():
        name = task or "unknown task"
        if not of_task["replayed"]:
            count = format_count(of_task["skipped"], "episode")
            yield f"{name}: none of {count} could be replayed; success rate unknown"
        else:
            yield (
                f"{name}: {of_task['succeeded']} of {of_task['replayed']} replayed episodes succeed"
                f" ({of_task['success_rate']:.0%}); mean tracking error {of_task['mean_error'] * 1000:.1f} mm,"
                f" largest {of_task['max_error'] * 1000:.0f} mm"
            )
