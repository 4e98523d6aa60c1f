"""``robocas eval report | merge | compare | verify | videos``: work with results of evaluations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from robocas_ms3.cli.options import Folders, Maybe
from robocas_ms3.core.words import count_of

if TYPE_CHECKING:
    from robocas_ms3.evaluation.protocol import LoadedProtocol
    from robocas_ms3.evaluation.results import Result


@dataclass
class Report:
    """Print the tables of a result, and write its page report.html.

    Example: robocas eval report eval/pick
    """

    folders: Folders
    """Folder of the result, or of its parts, such as shards."""
    out: Maybe[Path] = None
    """Folder of the page. Default: the folder of the result; required for several folders."""
    protocol: Maybe[str] = None
    """Folder of the protocol, if it is not a bundled one."""


@dataclass
class Merge:
    """Write the parts of a result, such as shards, as one result.

    Example: robocas eval merge eval/0 eval/1 --out eval/pick
    """

    folders: Folders
    """Folders of the parts."""
    out: Path
    """Folder of the new result."""
    protocol: Maybe[str] = None
    """Folder of the protocol, if it is not a bundled one."""


@dataclass
class Compare:
    """Compare results over the same scenes, by exact tests; the splits of one result with each other.

    Example: robocas eval compare eval/small eval/rt1
    """

    folders: Folders
    """Folders of results. Of more than two, those with the same settings are parts of one result."""
    protocol: Maybe[str] = None
    """Folder of the protocol, if it is not a bundled one."""


@dataclass
class Verify:
    """Check that a result is complete and belongs to its protocol; exit code 1 if not.

    Example: robocas eval verify eval/pick
    """

    folders: Folders
    """Folder of the result, or of its parts."""
    protocol: Maybe[str] = None
    """Folder of the protocol, if it is not a bundled one."""


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
    """Run ``report``."""
    from robocas_ms3.cli.terminal import say, say_lines
    from robocas_ms3.evaluation.report.tables import markdown
    from robocas_ms3.evaluation.results import read

    check_folders(cfg.folders)
    result = read(*cfg.folders)
    say_lines(markdown(result))
    first, *others = cfg.folders
    if cfg.out is None and others:
        say("Pass --out DIR for the page of several folders.")
    else:
        write_pages(result, cfg.out or first, cfg.protocol)
    return 0


def merge(cfg: Merge) -> int:
    """Run ``merge``."""
    from robocas_ms3.cli.terminal import say
    from robocas_ms3.evaluation.results import merge as write

    check_folders(cfg.folders)
    result = write(list(cfg.folders), cfg.out)
    say(f"{cfg.out}: {count_of(len(result.outcomes), 'episode')}")
    write_pages(result, cfg.out, cfg.protocol)
    return 0


def compare(cfg: Compare) -> int:
    """Run ``compare``."""
    from robocas_ms3.cli.terminal import say_lines
    from robocas_ms3.evaluation.report.comparison import comparison, comparison_of_splits
    from robocas_ms3.evaluation.results import parts_of, read

    check_folders(cfg.folders)
    groups = [[folder] for folder in cfg.folders] if len(cfg.folders) == 2 else parts_of(list(cfg.folders))
    results = [read(*parts) for parts in groups]
    if len(results) == 1:
        say_lines(comparison_of_splits(results[0], protocol_of(results[0], cfg.protocol)))
    else:
        say_lines(comparison(results))
    return 0


def verify(cfg: Verify) -> int:
    """Run ``verify``."""
    from robocas_ms3.cli.terminal import say
    from robocas_ms3.evaluation.results import read
    from robocas_ms3.evaluation.verify import problems

    check_folders(cfg.folders)
    result = read(*cfg.folders)
    found = problems(result, protocol_of(result, cfg.protocol))
    for problem in found:
        say(problem)
    if broken := result.broken_off():
        say(f"note: broken off by an error: {count_of(broken, 'episode')}, counted as failed")
    valid = f"{count_of(len(result.outcomes), 'episode')} of {result.run.protocol}, all well"
    say(f"{', '.join(map(str, cfg.folders))}: {count_of(len(found), 'problem') if found else valid}")
    return 1 if found else 0


def videos(cfg: Videos) -> int:
    """Run ``videos``.

    Raises:
        EvaluationError: the policy of the result is not installed, and --policy does not confirm it.
    """
    from robocas_ms3.cli.bars import bar
    from robocas_ms3.cli.terminal import say
    from robocas_ms3.core.errors import EvaluationError
    from robocas_ms3.core.strict import check_number
    from robocas_ms3.evaluation.policies import POLICIES, open_policy
    from robocas_ms3.evaluation.results import read

    check_number("count", cfg.count, 1)
    result = read(cfg.folder)
    loaded = protocol_of(result, cfg.protocol)
    name = str(result.run.policy.name)
    if name not in {*POLICIES.builtin, *POLICIES.entry_points} and cfg.policy != name:
        fix = f"Name it yourself, if you trust it: --policy {name}"
        raise EvaluationError("this result is of a policy of somebody's own", where=cfg.folder, found=name, fix=fix)
    from robocas_ms3.core.workers import use_one_torch_thread
    from robocas_ms3.evaluation.report.videos import failed_of_each_kind, film

    use_one_torch_thread()
    numbers = failed_of_each_kind(result, cfg.count)
    with open_policy(name) as played, bar("episodes filmed") as shown:
        for done, filmed in enumerate(film(result, loaded, played, numbers), start=1):
            say(str(filmed.path) + ("" if filmed.same else ": this time it came out differently"))
            shown.at(done, len(numbers))
    if not numbers:
        say("no episode failed")
    write_pages(result, cfg.folder, cfg.protocol)
    return 0


def check_folders(folders: tuple[Path, ...]) -> None:
    """Check that at least one folder of a result is named.

    Raises:
        EvaluationError: there is none.
    """
    from robocas_ms3.core.errors import EvaluationError

    if not folders:
        raise EvaluationError("missing result folder", where="DIR", expected="the folder of a result, or of its parts")


def protocol_of(result: Result, given: str | None) -> LoadedProtocol:
    """The protocol that was given, or the shipped one that a result names: a result chooses no folder.

    Raises:
        EvaluationError: none was given, and none of that name is shipped.
    """
    from robocas_ms3.core.errors import EvaluationError
    from robocas_ms3.evaluation.protocol import load_protocol, shipped_protocols

    name, shipped = result.run.protocol, shipped_protocols()
    if given is None and name not in shipped:
        expected, fix = f"one of {', '.join(shipped)}", "Pass --protocol FOLDER."
        raise EvaluationError(
            "its protocol is not shipped", where=result.folder, expected=expected, found=name, fix=fix
        )
    return load_protocol(shipped[name] if given is None else given)


def write_pages(result: Result, out: Path, given: str | None) -> None:
    """Write the report, and say where it is."""
    from robocas_ms3.cli.terminal import say
    from robocas_ms3.core.errors import EvaluationError
    from robocas_ms3.evaluation.report import write_report

    try:
        protocol = protocol_of(result, given)
    except EvaluationError:
        protocol = None  # one of somebody's own, who knows where
    if protocol is not None and protocol.hash != result.run.protocol_hash:
        protocol = None
    written = write_report(result, out, protocol)
    say(f"{out}: {', '.join(path.name for path in written)}")
    if not any(path.suffix == ".parquet" for path in written):
        say('no episodes.parquet without pyarrow; in the clone: pip install -e ".[lerobot]"')
