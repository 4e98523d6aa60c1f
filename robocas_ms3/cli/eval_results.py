"""``robocas eval report | merge | compare | verify | videos``: work with results of evaluations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from robocas_ms3.cli.options import Folders, Maybe
from robocas_ms3.core.text import format_count

if TYPE_CHECKING:
    from robocas_ms3.evaluation.protocol import LoadedProtocol
    from robocas_ms3.evaluation.results import Result


@dataclass
class Results:
    """Results that a command reads."""

    folders: Folders
    """Folder of a result, or of its parts, such as shards."""
    protocol: Maybe[str] = None
    """Folder of the protocol, if it is not a bundled one."""


@dataclass
class Report(Results):
    """Print the tables of a result, and write its page report.html.

    Example: robocas eval report eval/pick
    """

    out: Maybe[Path] = None
    """Folder of the page. Default: the folder of the result; required for several folders."""


@dataclass(kw_only=True)
class Merge(Results):
    """Write the parts of a result, such as shards, as one result.

    Example: robocas eval merge eval/0 eval/1 --out eval/pick
    """

    out: Path
    """Folder of the new result."""


@dataclass
class Compare(Results):
    """Compare results over the same scenes, by exact tests; the splits of one result with each other.

    Of more than two folders, those with the same settings are parts of one result.

    Example: robocas eval compare eval/small eval/rt1
    """


@dataclass
class Verify(Results):
    """Check that a result is complete and belongs to its protocol; exit code 1 if not.

    Example: robocas eval verify eval/pick
    """


@dataclass
class Videos:
    """Run failed episodes again, film them, and link the videos in the page of the result.

    Example: robocas eval videos eval/pick --count 4
    """

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of the result."""
    protocol: Maybe[str] = None
    """Folder of the protocol, if it is not a bundled one."""
    policy: Maybe[str] = None
    """Name of the policy, to confirm one that is not installed: a file does not choose code to run."""
    count: int = 8
    """How many videos, of all kinds of failures in turn."""


def report(cfg: Report) -> int:
    from robocas_ms3.cli.terminal import print_line, print_text
    from robocas_ms3.evaluation.report.tables import render_markdown

    result = _read(cfg.folders)
    print_text(render_markdown(result))
    if cfg.out is None and len(cfg.folders) > 1:
        print_line("Pass --out DIR for the page of several folders.")
    else:
        write_pages(result, cfg.out or result.folder, cfg.protocol)
    return 0


def merge(cfg: Merge) -> int:
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.evaluation.results import merge_results

    _check_folders(cfg.folders)
    result = merge_results(cfg.folders, cfg.out)
    print_line(f"{cfg.out}: {format_count(len(result.outcomes), 'episode')}")
    write_pages(result, cfg.out, cfg.protocol)
    return 0


def compare(cfg: Compare) -> int:
    from robocas_ms3.cli.terminal import print_text
    from robocas_ms3.evaluation.report.comparison import compare_results, compare_splits
    from robocas_ms3.evaluation.results import group_partial_results, read_result

    _check_folders(cfg.folders)
    groups = [[folder] for folder in cfg.folders] if len(cfg.folders) == 2 else group_partial_results(cfg.folders)
    results = [read_result(*parts) for parts in groups]
    if len(results) == 1:
        print_text(compare_splits(results[0], _protocol_of(results[0], cfg.protocol)))
    else:
        print_text(compare_results(results))
    return 0


def verify(cfg: Verify) -> int:
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.evaluation.verify import find_violations

    result = _read(cfg.folders)
    found = find_violations(result, _protocol_of(result, cfg.protocol))
    for problem in found:
        print_line(problem)
    if broken := result.error_count():
        print_line(f"note: broken off by an error: {format_count(broken, 'episode')}, counted as failed")
    valid = f"{format_count(len(result.outcomes), 'episode')} of {result.run.protocol}, all well"
    print_line(f"{', '.join(map(str, cfg.folders))}: {format_count(len(found), 'problem') if found else valid}")
    return 1 if found else 0


def videos(cfg: Videos) -> int:
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.checks import check_number
    from robocas_ms3.core.errors import EvaluationError
    from robocas_ms3.evaluation.policies import POLICIES, open_policy

    check_number("--count", cfg.count, 1)
    result = _read((cfg.folder,))
    protocol, name = _protocol_of(result, cfg.protocol), result.run.policy.name
    if name not in {*POLICIES.builtin, *POLICIES.entry_points} and cfg.policy != name:
        fix = f"Name it yourself, if you trust it: --policy {name}"
        raise EvaluationError("this result is of a policy of somebody's own", where=cfg.folder, found=name, fix=fix)
    from robocas_ms3.core.workers import use_one_torch_thread
    from robocas_ms3.evaluation.report.videos import choose_failed_episodes, record_videos

    use_one_torch_thread()
    numbers = choose_failed_episodes(result, cfg.count)
    with open_policy(name) as policy, ProgressBar("episodes filmed") as bar:
        for done, (path, same) in enumerate(record_videos(result, protocol, policy, numbers), start=1):
            print_line(str(path) + ("" if same else ": this time it came out differently"))
            bar.update(done, len(numbers))
    if not numbers:
        print_line("no episode failed")
    write_pages(result, cfg.folder, cfg.protocol)
    return 0


def write_pages(result: Result, out: Path, protocol: str | None) -> None:
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.errors import EvaluationError
    from robocas_ms3.evaluation.report import write_report

    try:
        loaded = _protocol_of(result, protocol)
    except EvaluationError:
        loaded = None  # one of the user's own
    matches = loaded is not None and loaded.hash == result.run.protocol_hash
    written = write_report(result, out, loaded if matches else None)
    print_line(f"{out}: {', '.join(path.name for path in written)}")
    if not any(path.suffix == ".parquet" for path in written):
        print_line('no episodes.parquet without pyarrow; in the clone: pip install -e ".[lerobot]"')


def _check_folders(folders: tuple[Path, ...]) -> None:
    from robocas_ms3.core.errors import EvaluationError

    if not folders:
        raise EvaluationError("missing result folder", where="DIR", expected="the folder of a result, or of its parts")


def _read(folders: tuple[Path, ...]) -> Result:
    from robocas_ms3.evaluation.results import read_result

    _check_folders(folders)
    return read_result(*folders)


def _protocol_of(result: Result, given: str | None) -> LoadedProtocol:
    """Return the given protocol, or the shipped one that a result names: a result chooses no folder."""
    from robocas_ms3.core.errors import EvaluationError
    from robocas_ms3.evaluation.protocol import load_protocol, shipped_protocols

    name, shipped = result.run.protocol, shipped_protocols()
    if given is None and name not in shipped:
        what, fix = "its protocol is not shipped", "Pass --protocol FOLDER."
        raise EvaluationError(what, where=result.folder, expected=f"one of {', '.join(shipped)}", found=name, fix=fix)
    return load_protocol(shipped[name] if given is None else given)
