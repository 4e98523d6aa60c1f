"""``robocas import-robocas``: import a dataset in the format of RoboCAS-v0."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from robocas_ms3.cli.options import Maybe

if TYPE_CHECKING:
    from robocas_ms3.datasets.manage.survey import Survey


@dataclass
class ImportRobocas:
    """Repair a dataset in the format of RoboCAS-v0 and write it as a valid dataset.

    Without --out the command only checks the dataset. It repairs types, missing arrays that follow from other arrays,
    names of camera pose files, and a rotated EEF frame. It skips and lists episodes that it can't repair. Exit status 1
    if no episode can be imported.

    Example: robocas import-robocas downloads/robocas --out datasets/robocas
    """

    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset; it is not changed."""
    out: Maybe[Path] = None
    """Folder of the new dataset; episodes keep their numbers."""
    rate: Maybe[float] = None
    """Rate of the dataset in Hz. Default: the rate in conversion.json; without this file 5 Hz, as RoboCAS-v0."""
    turn_eef: bool = True
    """Rotate the EEF frame to the TCP frame of ManiSkill if the pose of the gripper camera shows a rotation."""
    embeddings: bool = False
    """Compute missing embeddings of the instruction and the sub-goals (needs the extra 'language')."""
    link: bool = False
    """Hard-link the images instead of copying them."""
    json: bool = False
    """Print the report as JSON."""
    overwrite: bool = False
    """Start again. Default: continue an interrupted import of the same inputs."""


def main(cfg: ImportRobocas) -> int:
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_json, print_line
    from robocas_ms3.core.output_folder import OutputFolder
    from robocas_ms3.core.text import format_count
    from robocas_ms3.datasets.conversion.episode_plan import DATASET
    from robocas_ms3.datasets.manage.copy_episodes import CopyOptions, check_no_overlap
    from robocas_ms3.datasets.manage.import_robocas import import_robocas
    from robocas_ms3.datasets.manage.survey import survey_dataset

    if cfg.out is not None:
        check_no_overlap(cfg.out, [cfg.dataset])
        OutputFolder(
            cfg.out, DATASET, overwrite=cfg.overwrite
        ).read_record()  # checked before the dataset is read, which takes minutes
    embed = None
    if cfg.embeddings:
        from robocas_ms3.scenes.language.embed import TextEmbedder

        embed = TextEmbedder()
    with ProgressBar("episodes read") as bar:
        found = survey_dataset(cfg.dataset, rate_hz=cfg.rate, turn_eef=cfg.turn_eef, on_episode=bar.update)
    if cfg.json:
        print_json(found.as_json())
    else:
        _table(found)
    if not found.importable or cfg.out is None:
        return 0 if found.importable else 1
    with ProgressBar("episodes written") as bar:
        options = CopyOptions(cfg.link, cfg.overwrite, bar.start, bar.advance)
        kept = import_robocas(found, cfg.out, embed=embed, options=options)
    if not cfg.json:
        existing = f", {kept} already there" if kept else ""
        print_line(f"{cfg.out}: {format_count(len(found.importable), 'episode')}{existing}")
    return 0


def _table(found: Survey) -> None:
    from robocas_ms3.cli.terminal import print_line, print_table
    from robocas_ms3.core.text import format_count, format_ranges

    rows: dict[tuple[str, str, str], list[int]] = defaultdict(list)
    for finding in found.findings:
        where = finding.violation.where
        place = where.split("/", 1)[1] if finding.episode is not None and "/" in where else where
        numbers = rows[(finding.outcome, place, finding.problem)]
        if finding.episode is not None:
            numbers.append(finding.episode)
    cells = [(format_ranges(numbers) or "all", *key) for key, numbers in sorted(rows.items())]
    print_table(("episodes", "outcome", "where", "finding"), cells, box=None, pad_edge=False, header_style="bold")
    counts = f"{len(found.importable)} can be imported, {len(found.skipped)} skipped"
    print_line(f"{found.root}: {format_count(found.episodes, 'episode')}, {counts}")
