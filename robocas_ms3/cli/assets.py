"""``robocas assets``: look at asset packs, make new ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any

import tyro

from robocas_ms3.cli import assets_make as make
from robocas_ms3.cli import assets_show as show

Subcommand = tyro.conf.subcommand


@dataclass
class Assets:
    """Look at asset packs, and make new ones from scans and datasets."""

    command: (
        Annotated[show.ListPacks, Subcommand("list")]
        | Annotated[show.Info, Subcommand("info")]
        | Annotated[show.Verify, Subcommand("verify")]
        | Annotated[show.Sheet, Subcommand("sheet")]
        | Annotated[make.Build, Subcommand("build")]
        | Annotated[make.ImportScans, Subcommand("import-scans")]
        | Annotated[make.ImportGraspNet, Subcommand("import-graspnet")]
        | Annotated[make.ImportYCB, Subcommand("import-ycb")]
        | Annotated[make.ImportPartNet, Subcommand("import-partnet")]
    ) = field(default_factory=show.ListPacks)
    """What to do."""


RUN: dict[type, Callable[[Any], int]] = {
    show.ListPacks: show.list_packs,
    show.Info: show.info,
    show.Verify: show.verify,
    show.Sheet: show.sheet,
    make.Build: make.build,
    make.ImportScans: make.import_scans,
    make.ImportGraspNet: make.import_graspnet,
    make.ImportYCB: make.import_ycb,
    make.ImportPartNet: make.import_partnet,
}


def main(cfg: Assets) -> int:
    """Run the command."""
    return RUN[type(cfg.command)](cfg.command)
