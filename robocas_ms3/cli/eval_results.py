"""``robocas eval report | merge | compare | verify | videos | table``: read and check results of evaluations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from robocas_ms3.cli.options import Folders, Maybe
from robocas_ms3.core.text import format_count

if TYPE_CHECKING:
    from robocas_ms3.evaluation.leaderboard.rows import LeaderboardRow
    from robocas_ms3.evaluation.protocols.protocol import LoadedProtocol
    from robocas_ms3.evaluation.results.result_files import Result


SHOWN_VIOLATIONS = 20  # of a result; the others are counted


@dataclass
class Results:
    """Options of commands that read results."""

    folders: Folders
    """Folder of a result, or folders of partial results of one evaluation, such as shards."""
    protocol: Annotated[Maybe[str], tyro.conf.arg(metavar="PROTOCOL")] = None
    """Protocol folder. Required if the protocol of the result is not bundled."""


@dataclass
class Report(Results):
    """Print the tables of a result and write report.html.

    Example: robocas eval report eval/pick
    """

    out: Maybe[Path] = None
    """Output folder of report.html. Default: the result folder; required for several folders."""


@dataclass(kw_only=True)
class Merge(Results):
    """Merge partial results of one evaluation, such as shards, into one result.

    Example: robocas eval merge eval/0 eval/1 --out eval/pick
    """

    out: Path
    """Output folder of the merged result."""
    overwrite: bool = False
    """Replace an existing result."""


@dataclass
class Compare(Results):
    """Compare results over the same scenes with exact paired tests; with one result, compare its splits.

    With more than two folders, the folders with equal settings are partial results of one evaluation.

    Example: robocas eval compare eval/small eval/rt1
    """


@dataclass(kw_only=True)
class WriteTable(Results):
    """Write a table of several results, with the published results of the RoboCAS paper.

    Folders with equal settings are partial results of one evaluation. The rows of these results are printed; the whole
    tables are written next to the JSON file as Markdown. The results are not audited; `robocas leaderboard` has only
    audited results.

    Example: robocas eval table eval/small eval/rt1 --out tables/results.json
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FILE.json")]
    """JSON file of the table."""
    update: bool = False
    """Add the rows to an existing table. Without this option, they replace all rows."""


@dataclass
class Verify(Results):
    """Check that a result is complete and consistent with its protocol (exit status 1 if not).

    Example: robocas eval verify eval/pick
    """


@dataclass
class Videos:
    """Record videos of episodes by running them again, and link the videos in report.html.

    Example: robocas eval videos eval/pick --outcome succeeded --count 4
    """

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of the result."""
    protocol: Annotated[Maybe[str], tyro.conf.arg(metavar="PROTOCOL")] = None
    """Protocol folder. Required if the protocol of the result is not bundled."""
    policy: Annotated[Maybe[str], tyro.conf.arg(metavar="POLICY")] = None
    """Repeat the policy of the result to allow its code to run. Required unless `robocas list` names the policy."""
    count: int = 8
    """Number of videos. The episodes alternate between configurations and kinds of failures."""
    outcome: Literal["failed", "succeeded", "all"] = "failed"
    """Which episodes to record."""


def report(cfg: Report) -> int:
    from robocas_ms3.cli.terminal import print_line, print_text
    from robocas_ms3.evaluation.report.tables import render_markdown

    result = read(cfg.folders)
    print_text(render_markdown(result, _find_protocol(result, cfg.protocol)))
    if cfg.out is None and len(cfg.folders) > 1:
        print_line("report.html was not written: pass --out DIR for several result folders")
    else:
        write_pages(result, cfg.out or result.folder, cfg.protocol)
    return 0


def merge(cfg: Merge) -> int:
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.evaluation.results.result_files import merge_results

    _check_folders(cfg.folders)
    result = merge_results(cfg.folders, cfg.out, overwrite=cfg.overwrite)
    print_line(f"{cfg.out}: {format_count(len(result.outcomes), 'episode')}")
    write_pages(result, cfg.out, cfg.protocol)
    return 0


def compare(cfg: Compare) -> int:
    from robocas_ms3.cli.terminal import print_text
    from robocas_ms3.evaluation.report.comparison import compare_results, compare_splits
    from robocas_ms3.evaluation.results.result_files import group_partial_results, load_protocol_of, read_result

    _check_folders(cfg.folders)
    groups = [[folder] for folder in cfg.folders] if len(cfg.folders) == 2 else group_partial_results(cfg.folders)
    results = [read_result(*parts) for parts in groups]
    if len(results) == 1:
        print_text(compare_splits(results[0], load_protocol_of(results[0], cfg.protocol)))
    else:
        print_text(compare_results(results))
    return 0


def table(cfg: WriteTable) -> int:
    from robocas_ms3.cli.terminal import print_line, print_text
    from robocas_ms3.core.errors import EvaluationError
    from robocas_ms3.core.files import atomic_file
    from robocas_ms3.evaluation.leaderboard.markdown import render_leaderboard
    from robocas_ms3.evaluation.leaderboard.result_rows import make_rows
    from robocas_ms3.evaluation.leaderboard.rows import (
        Leaderboard,
        read_leaderboard,
        read_published_rows,
        replace_rows,
        sort_rows,
        write_leaderboard,
    )
    from robocas_ms3.evaluation.results.verify import check_consistency

    if cfg.out.suffix != ".json":
        what, expected = "invalid name of the table", "a name that ends in .json"
        raise EvaluationError(what, where="--out", expected=expected, found=cfg.out.name, usage=True)
    new: list[LeaderboardRow] = []
    for result in read_evaluations(cfg.folders):
        protocol = _find_protocol(result, cfg.protocol)
        if protocol is not None:
            check_consistency(result, protocol, stored=())
        new += make_rows(result, protocol)
    measured = new
    if cfg.update and cfg.out.exists():
        earlier = read_leaderboard(cfg.out).rows
        if any(row.entry for row in earlier):
            what, fix = (
                "this leaderboard has only audited results",
                "Choose another file, or use robocas leaderboard add.",
            )
            raise EvaluationError(what, where=cfg.out, fix=fix)
        measured = replace_rows(earlier, measured)
    rows = sort_rows([*measured, *read_published_rows()])
    page = cfg.out.with_suffix(".md")
    write_leaderboard(cfg.out, Leaderboard(rows=rows))
    with atomic_file(page) as tmp:
        tmp.write_text(render_leaderboard(rows), encoding="utf-8")
    print_text(render_leaderboard(sort_rows(new)))
    print_line(f"wrote {cfg.out} and {page.name}: {format_count(len(rows), 'row')}")
    return 0


def print_violations(violations: list[str]) -> None:
    """Print the first violations, and the number of the others."""
    from robocas_ms3.cli.terminal import print_line

    for violation in violations[:SHOWN_VIOLATIONS]:
        print_line(violation)
    if (others := len(violations) - SHOWN_VIOLATIONS) > 0:
        print_line(f"and {format_count(others, 'other violation')}")


def verify(cfg: Verify) -> int:
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.evaluation.report.tables import name_measurement
    from robocas_ms3.evaluation.results.result_files import load_protocol_of
    from robocas_ms3.evaluation.results.verify import find_violations

    result = read(cfg.folders)
    found = find_violations(result, load_protocol_of(result, cfg.protocol))
    print_violations(found)
    if broken := result.count_errors():
        print_line(f"note: {format_count(broken, 'episode')} ended with an error and counted as failed")
    valid = f"{format_count(len(result.outcomes), 'episode')} of {name_measurement(result.run)}, no violations"
    print_line(f"{', '.join(map(str, cfg.folders))}: {format_count(len(found), 'violation') if found else valid}")
    return 1 if found else 0


def videos(cfg: Videos) -> int:
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.checks import check_number
    from robocas_ms3.core.errors import EvaluationError
    from robocas_ms3.evaluation.policies import POLICIES, open_policy
    from robocas_ms3.evaluation.results.result_files import load_protocol_of

    check_number("--count", cfg.count, 1)
    result = read((cfg.folder,))
    protocol, name = load_protocol_of(result, cfg.protocol), result.run.policy.name
    if name not in {*POLICIES.builtin, *POLICIES.entry_points} and cfg.policy != name:
        fix = f"Add --policy {name} if you trust its code."
        raise EvaluationError("the policy of this result has no registered name", where=cfg.folder, found=name, fix=fix)
    from robocas_ms3.core.workers import use_one_torch_thread
    from robocas_ms3.evaluation.report.videos import choose_episodes, record_videos

    use_one_torch_thread()
    numbers = choose_episodes(result, cfg.count, cfg.outcome)
    with open_policy(name) as policy, ProgressBar("videos recorded") as bar:
        for done, (path, same) in enumerate(record_videos(result, protocol, policy, numbers), start=1):
            print_line(str(path) + ("" if same else ": the outcome differs from the recorded outcome"))
            bar.update(done, len(numbers))
    if not numbers:
        print_line(f"no episode to record with --outcome {cfg.outcome}")
    write_pages(result, cfg.folder, cfg.protocol)
    return 0


def write_pages(result: Result, out: Path, protocol: str | None) -> None:
    """Write report.html and the other reports of a result into a folder, and print their names."""
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.evaluation.report import write_report

    written = write_report(result, out, _find_protocol(result, protocol))
    print_line(f"wrote {out}: {', '.join(path.name for path in written)}")
    if not any(path.suffix == ".parquet" for path in written):
        print_line(
            'episodes.parquet was not written, because pyarrow is missing. In the clone: pip install -e ".[lerobot]"'
        )


def _check_folders(folders: tuple[Path, ...]) -> None:
    from robocas_ms3.core.errors import EvaluationError

    if not folders:
        expected, fix = "the folder of a result, or of partial results", "Pass the --out folder of robocas eval."
        raise EvaluationError("missing result folder", where="DIR", expected=expected, fix=fix, usage=True)


def read(folders: tuple[Path, ...]) -> Result:
    """Read the result in a folder, or in the folders of its partial results."""
    from robocas_ms3.evaluation.results.result_files import read_result

    _check_folders(folders)
    return read_result(*folders)


def read_evaluations(folders: tuple[Path, ...]) -> list[Result]:
    """Read results; folders with equal settings are partial results of one evaluation."""
    from robocas_ms3.evaluation.results.result_files import group_partial_results, read_result

    _check_folders(folders)
    return [read_result(*parts) for parts in group_partial_results(folders)]


def _find_protocol(result: Result, given: str | None) -> LoadedProtocol | None:
    """Load the protocol of a result; None if it is not bundled and not given, or has other files."""
    from robocas_ms3.core.errors import EvaluationError
    from robocas_ms3.evaluation.results.result_files import load_protocol_of

    try:
        loaded = load_protocol_of(result, given)
    except EvaluationError:
        return None
    return loaded if loaded.hash == result.run.protocol_hash else None
