"""``robocas eval``: measure a policy by a protocol; compare, verify and list."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from robocas_ms3.evaluation.protocol import LoadedProtocol
    from robocas_ms3.evaluation.results import Result


@dataclass
class Eval:
    """Measure a policy by a protocol: every episode of its list once, written as it ends.

    robocas eval [TASK ...] --policy P --protocol NAME --out DIR   plays the episodes of these tasks, or of all
    robocas eval report DIR ...                                    tables of a result, and its page report.html
    robocas eval merge DIR ... --out DIR                           parts of a result, such as shards, as one
    robocas eval compare DIR DIR ...                               two results over the same episodes, by an exact test
    robocas eval verify DIR ...                                    whether a result is whole, and of this protocol
    robocas eval videos DIR                                        plays failed episodes again and films them
    robocas eval protocols                                         lists the protocols that are shipped
    robocas eval freeze PLAN.yaml --out DIR                        makes a protocol of your own
    """

    words: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Tasks; or one of the words above, and what it is about."""
    policy: str = "scripted"
    """Of whom: scripted (joint targets), scripted-motions (RoboCAS' 7 numbers), random, still, replay:TRAJECTORY.h5,
    module:Class of your own, or ws://HOST:PORT, a server's (`robocas serve-policy`)."""
    protocol: str = "ms3-v1"
    """Name of a shipped protocol, or its folder."""
    out: Path | None = None
    """Folder to write to. Default: eval/PROTOCOL/POLICY, with the weld eval/PROTOCOL/POLICY_weld."""
    resume: bool = False
    """Go on with a result that is there."""
    envs: int = 2
    """Envs at a time; the outcome does not depend on it."""
    workers: int | None = None
    """Processes. Default: one an env, no more than cores."""
    backend: Literal["auto", "processes", "gpu"] = "auto"
    """Where envs run. Auto: a GPU if there is one."""
    shard: str = "0/1"
    """Only a part of the episodes, K/N: the K-th of N runs, from 0 on. The words above take the folders of
    all parts."""
    episodes: int | None = None
    """Only the first so many of each configuration."""
    weld: bool = False
    """Weld what closed fingers have lifted to the hand, as upstream does, until the gripper is told to open. Only in
    protocols with upstream's steps (paper-v1), in processes; never to be compared with results without."""
    count: int = 8
    """How many videos, of all kinds of failures in turn."""


WORDS = ("report", "merge", "compare", "verify", "videos", "protocols", "freeze")


def main(cfg: Eval) -> int:
    """Run the command; gives the exit code."""
    from robocas_ms3.errors import EvaluationError

    first = cfg.words[0] if cfg.words else ""
    if first not in WORDS:
        return run(cfg)
    about = [Path(word) for word in cfg.words[1:]]
    if first == "protocols":
        return protocols()
    if first == "freeze":
        return freeze(_one(about, first), cfg.out)
    if first == "compare":
        return compare(about)
    if not about:
        raise EvaluationError("of what?", where=first, expected="a folder of a result, or those of its parts")
    if first == "merge":
        return merge(about, cfg.out, cfg.protocol)
    if first == "videos":
        return videos(_one(about, first), cfg.protocol, cfg.policy, cfg.count)
    return report(about, cfg.out, cfg.protocol) if first == "report" else verify(about, cfg.protocol)


def run(cfg: Eval) -> int:
    """Play what a result lacks."""
    from robocas_ms3.cli.bars import bar, say
    from robocas_ms3.demos.checks import check_number
    from robocas_ms3.errors import EvaluationError
    from robocas_ms3.evaluation.policies import open_policy
    from robocas_ms3.evaluation.protocol import load_protocol
    from robocas_ms3.evaluation.results import read
    from robocas_ms3.evaluation.run import Settings, evaluate
    from robocas_ms3.tasks.spec import TASKS

    for word in cfg.words:
        if word not in TASKS:
            expected = f"one of {', '.join(TASKS)}; or {', '.join(WORDS)}"
            raise EvaluationError("no such task", where=word, expected=expected)
    check_number("envs", cfg.envs, 1)
    protocol = load_protocol(cfg.protocol)
    name = re.sub(r"[^\w.-]+", "_", cfg.policy) + ("_weld" if cfg.weld else "")
    out = cfg.out or Path("eval") / protocol.rules.name / name
    settings = Settings(cfg.envs, cfg.backend, cfg.workers, shard_of(cfg.shard), cfg.words, cfg.episodes, cfg.weld)
    succeeded = played = 0
    with open_policy(cfg.policy) as policy, bar("episodes") as shown:
        try:
            for outcome, left in evaluate(protocol, policy, cfg.policy, out, settings, resume=cfg.resume):
                played += 1
                succeeded += outcome.success
                shown.at(played, played + left)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("the same command with --resume goes on") from None
    result = read(out)
    say(f"{played} episodes played, {succeeded} succeeded; {out}: {len(result.outcomes)} episodes")
    _write(result, out, cfg.protocol)
    return 0


def report(folders: list[Path], out: Path | None, protocol: str) -> int:
    """Print a result's tables; write them and its page into its folder, those of several into another one."""
    from robocas_ms3.cli.bars import say
    from robocas_ms3.evaluation.results import read
    from robocas_ms3.evaluation.tables import markdown

    result = read(*folders)
    say(markdown(result))
    if out is None and len(folders) > 1:
        say("Pass --out DIR for the page of several folders.")
    else:
        _write(result, out or folders[0], protocol)
    return 0


def merge(folders: list[Path], out: Path | None, protocol: str) -> int:
    """Write parts of a result as one."""
    from robocas_ms3.cli.bars import say
    from robocas_ms3.errors import EvaluationError
    from robocas_ms3.evaluation.results import merge as write

    if out is None:
        raise EvaluationError("where to?", where="--out", expected="a folder")
    result = write(folders, out)
    say(f"{out}: {len(result.outcomes)} episodes")
    _write(result, out, protocol)
    return 0


def compare(folders: list[Path]) -> int:
    """Compare two results; of more folders, those that were measured with the same are parts of one."""
    from robocas_ms3.cli.bars import say
    from robocas_ms3.errors import EvaluationError
    from robocas_ms3.evaluation.results import parts_of, read
    from robocas_ms3.evaluation.tables import comparison

    results = [[folder] for folder in folders] if len(folders) == 2 else parts_of(folders)
    if len(results) != 2:
        expected = "folders of two results, or of the parts of two"
        raise EvaluationError("compares two results", where="compare", expected=expected, found=len(results))
    say(comparison(*(read(*parts) for parts in results)))
    return 0


def verify(folders: list[Path], protocol: str) -> int:
    """See that a result is whole, and of a protocol that is here; 1 where it isn't."""
    from robocas_ms3.cli.bars import say
    from robocas_ms3.evaluation.results import read
    from robocas_ms3.evaluation.verify import problems

    result: Result = read(*folders)
    name = str(result.run["protocol"])
    found = problems(result, _protocol_of(result, protocol))
    for problem in found:
        say(problem)
    where = ", ".join(map(str, folders))
    say(f"{where}: " + (f"{len(found)} problems" if found else f"{len(result.outcomes)} episodes of {name}, all well"))
    return 1 if found else 0


def videos(folder: Path, protocol: str, policy: str, count: int) -> int:
    """Film failed episodes, and link the videos in the page.

    Raises:
        EvaluationError: it is of a policy that is not builtin, and was not named again: a file chooses no code.
    """
    from robocas_ms3.cli.bars import bar, say
    from robocas_ms3.demos.checks import check_number
    from robocas_ms3.errors import EvaluationError
    from robocas_ms3.evaluation.policies import BUILTIN, open_policy
    from robocas_ms3.evaluation.results import read
    from robocas_ms3.evaluation.videos import failed_of_each_kind, film

    check_number("count", count, 1)
    result = read(folder)
    loaded = _protocol_of(result, protocol)
    numbers = failed_of_each_kind(result, count)
    name = str(result.run["policy"]["name"])
    if name not in BUILTIN and policy != name:
        fix = f"Name it yourself, if you trust it: --policy {name}"
        raise EvaluationError("this result is of a policy of somebody's own", where=folder, found=name, fix=fix)
    with open_policy(name) as played, bar("videos") as shown:
        for done, filmed in enumerate(film(result, loaded, played, numbers), start=1):
            say(str(filmed.path) + ("" if filmed.same else ": this time it came out differently"))
            shown.at(done, len(numbers))
    if not numbers:
        say("no episode failed")
    _write(result, folder, protocol)
    return 0


def protocols() -> int:
    """List the protocols that are shipped."""
    from robocas_ms3.cli.bars import say
    from robocas_ms3.evaluation.protocol import load_protocol, shipped_protocols

    for name in shipped_protocols():
        protocol = load_protocol(name)
        say(f"{name}: {len(protocol.episodes)} episodes, {protocol.hash[:12]}: {protocol.rules.description}")
    return 0


def freeze(plan: Path, out: Path | None) -> int:
    """Make a protocol."""
    import yaml

    from robocas_ms3.cli.bars import bar, say
    from robocas_ms3.errors import EvaluationError
    from robocas_ms3.evaluation.freeze import Plan
    from robocas_ms3.evaluation.freeze import freeze as make
    from robocas_ms3.evaluation.protocol import load_protocol

    if out is None:
        raise EvaluationError("where to?", where="--out", expected="a folder")
    try:
        read = Plan.model_validate(yaml.safe_load(plan.read_text(encoding="utf-8")))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise EvaluationError("no plan of a protocol", where=plan, found=" ".join(str(error).split())) from error
    if out.exists():
        raise EvaluationError("there is something already", where=out, fix="Choose another --out.")
    with bar("episodes") as shown:
        for done, total in make(read, out):
            shown.at(done, total)
    say(f"{out}: {len(load_protocol(out).episodes)} episodes, {load_protocol(out).hash}")
    return 0


def shard_of(text: str) -> tuple[int, int]:
    """(number, of how many) of ``K/N``.

    Raises:
        EvaluationError: it is none.
    """
    from robocas_ms3.errors import EvaluationError

    number, _, of = text.partition("/")
    if not (number.isdecimal() and of.isdecimal() and int(number) < int(of)):
        raise EvaluationError("no part of a whole", where="--shard", expected="K/N such as 0/4", found=text)
    return int(number), int(of)


def _one(about: list[Path], word: str) -> Path:
    from robocas_ms3.errors import EvaluationError

    if len(about) != 1:
        raise EvaluationError("takes one thing", where=word, expected="a folder or file", found=len(about))
    return about[0]


def _protocol_of(result: Result, given: str) -> LoadedProtocol:
    """The protocol that a result names, or the folder that was given."""
    from robocas_ms3.evaluation.protocol import load_protocol

    return load_protocol(given if Path(given).is_dir() else result.run["protocol"])


def _write(result: Result, out: Path, given: str) -> None:
    """Write the report, and say where it is."""
    from robocas_ms3.cli.bars import say
    from robocas_ms3.errors import EvaluationError
    from robocas_ms3.evaluation.report import write_report

    try:
        protocol = _protocol_of(result, given)
    except EvaluationError:
        protocol = None  # one of somebody's own, who knows where
    if protocol is not None and protocol.hash != result.run["protocol_hash"]:
        protocol = None
    written = write_report(result, out, protocol)
    say(f"{out}: {', '.join(path.name for path in written)}")
    if not any(path.suffix == ".parquet" for path in written):
        say('no episodes.parquet without pyarrow: pip install "robocas-ms3[lerobot]" brings it')
