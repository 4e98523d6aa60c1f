"""``robocas eval report | merge | compare | verify | videos``: what is done with results."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from robocas_ms3.evaluation.protocol import LoadedProtocol
    from robocas_ms3.evaluation.results import Result

from robocas_ms3.core.words import count_of


def report(folders: list[Path], out: Path | None, protocol: str | None) -> int:
    """Print a result's tables; write them and its page into its folder, those of several into another one."""
    from robocas_ms3.cli.terminal import say, say_lines
    from robocas_ms3.evaluation.results import read
    from robocas_ms3.evaluation.tables import markdown

    result = read(*folders)
    say_lines(markdown(result))
    if out is None and len(folders) > 1:
        say("Pass --out DIR for the page of several folders.")
    else:
        write_pages(result, out or folders[0], protocol)
    return 0


def merge(folders: list[Path], out: Path | None, protocol: str | None) -> int:
    """Write parts of a result as one."""
    from robocas_ms3.cli.terminal import say
    from robocas_ms3.core.errors import EvaluationError
    from robocas_ms3.evaluation.results import merge as write

    if out is None:
        raise EvaluationError("where to?", where="--out", expected="a folder")
    result = write(folders, out)
    say(f"{out}: {count_of(len(result.outcomes), 'episode')}")
    write_pages(result, out, protocol)
    return 0


def compare(folders: list[Path], protocol: str | None) -> int:
    """Compare results; of more folders than two, those that were measured with the same are parts of one.

    A single result is compared with itself, split by split.
    """
    from robocas_ms3.cli.terminal import say_lines
    from robocas_ms3.evaluation.comparison import comparison, comparison_of_splits
    from robocas_ms3.evaluation.results import parts_of, read

    groups = [[folder] for folder in folders] if len(folders) == 2 else parts_of(folders)
    results = [read(*parts) for parts in groups]
    if len(results) == 1:
        say_lines(comparison_of_splits(results[0], protocol_of(results[0], protocol)))
    else:
        say_lines(comparison(results))
    return 0


def verify(folders: list[Path], protocol: str | None) -> int:
    """See that a result is whole, and of a protocol that is here; 1 where it isn't."""
    from robocas_ms3.cli.terminal import say
    from robocas_ms3.evaluation.results import read
    from robocas_ms3.evaluation.verify import problems

    result: Result = read(*folders)
    name = str(result.run["protocol"])
    found = problems(result, protocol_of(result, protocol))
    for problem in found:
        say(problem)
    if broken := result.broken_off():
        say(f"note: broken off by an error: {count_of(broken, 'episode')}, counted as failed")
    where = ", ".join(map(str, folders))
    say(
        f"{where}: "
        + (
            count_of(len(found), "problem")
            if found
            else f"{count_of(len(result.outcomes), 'episode')} of {name}, all well"
        )
    )
    return 1 if found else 0


def videos(folder: Path, protocol: str | None, policy: str, count: int) -> int:
    """Film failed episodes, and link the videos in the page.

    Raises:
        EvaluationError: it is of a policy that is not installed, and was not named again: a file chooses no code.
    """
    from robocas_ms3.cli.bars import bar
    from robocas_ms3.cli.terminal import say
    from robocas_ms3.core.errors import EvaluationError
    from robocas_ms3.core.strict import check_number
    from robocas_ms3.evaluation.policies import POLICIES, open_policy
    from robocas_ms3.evaluation.results import read

    check_number("count", count, 1)
    result = read(folder)
    loaded = protocol_of(result, protocol)
    name = str(result.run["policy"]["name"])
    if name not in {*POLICIES.builtin, *POLICIES.entry_points} and policy != name:
        fix = f"Name it yourself, if you trust it: --policy {name}"
        raise EvaluationError("this result is of a policy of somebody's own", where=folder, found=name, fix=fix)
    from robocas_ms3.core.workers import use_one_torch_thread
    from robocas_ms3.evaluation.videos import failed_of_each_kind, film

    use_one_torch_thread()
    numbers = failed_of_each_kind(result, count)
    with open_policy(name) as played, bar("episodes filmed") as shown:
        for done, filmed in enumerate(film(result, loaded, played, numbers), start=1):
            say(str(filmed.path) + ("" if filmed.same else ": this time it came out differently"))
            shown.at(done, len(numbers))
    if not numbers:
        say("no episode failed")
    write_pages(result, folder, protocol)
    return 0


def protocol_of(result: Result, given: str | None) -> LoadedProtocol:
    """The protocol that was given, or the shipped one that a result names: a result chooses no folder.

    Raises:
        EvaluationError: none was given, and none of that name is shipped.
    """
    from robocas_ms3.core.errors import EvaluationError
    from robocas_ms3.evaluation.protocol import load_protocol, shipped_protocols

    name, shipped = result.run["protocol"], shipped_protocols()
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
    if protocol is not None and protocol.hash != result.run["protocol_hash"]:
        protocol = None
    written = write_report(result, out, protocol)
    say(f"{out}: {', '.join(path.name for path in written)}")
    if not any(path.suffix == ".parquet" for path in written):
        say('no episodes.parquet without pyarrow; in the clone: pip install -e ".[lerobot]"')
