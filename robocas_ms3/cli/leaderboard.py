"""``robocas leaderboard add``: add results to the entries of the leaderboard."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from robocas_ms3.cli.eval_results import Results
from robocas_ms3.core.text import format_count


@dataclass(kw_only=True)
class Add(Results):
    """Add a result to an entry, a folder with the results of a policy.

    The copy has all outcomes, and the stored actions of 50 episodes that the protocol fixes. The result is first
    checked like in `robocas eval verify`. It may lack tasks and splits of the protocol, but no episodes of the others.

    Example: robocas leaderboard add eval/pick --out leaderboard/mine/paper-v1
    """

    out: Annotated[Path, tyro.conf.arg(metavar="ENTRY/PROTOCOL")]
    """Folder of the result in the entry."""
    overwrite: bool = False
    """Replace an existing result."""


def add(cfg: Add) -> int:
    from robocas_ms3.cli.eval_results import find_protocol_of, read
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.evaluation.leaderboard.entries import write_result

    result = read(cfg.folders)
    sample = write_result(result, find_protocol_of(result, cfg.protocol), cfg.out, overwrite=cfg.overwrite)
    print_line(f"wrote {cfg.out}: {format_count(len(result.outcomes), 'episode')}, actions of {len(sample)}")
    return 0


COMMANDS = {"add": add}
DESCRIPTION = "Add results to the leaderboard."
