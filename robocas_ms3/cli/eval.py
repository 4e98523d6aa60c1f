"""``robocas eval``: measure a policy by a protocol; compare, verify and list."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from robocas_ms3.cli.options import Maybe, Repeated, Several, Word


@dataclass
class Eval:
    """Measure a policy by a protocol: every episode of its list once, written as it ends.

    - eval [TASK ...] --policy P --protocol NAME --out DIR: plays the episodes of these tasks, or of all
    - eval report DIR ...: tables of a result, and its page report.html
    - eval merge DIR ... --out DIR: parts of a result, such as shards, as one
    - eval compare DIR DIR ...: over the same scenes, by exact tests; of one result its splits
    - eval verify DIR ...: whether a result is whole, and of its protocol
    - eval videos DIR: plays failed episodes again and films them
    - eval protocols: lists the protocols that are shipped
    - eval freeze PLAN.yaml --out DIR [--set objects.count=12]: makes a protocol of your own
    """

    words: Annotated[Several[str], tyro.conf.Positional] = ()
    """Tasks; or one of the words above, and what it is about."""
    policy: str = "scripted"
    """Of whom: scripted (joint targets), scripted-motions (RoboCAS' 7 numbers), scripted-beside (these, off by some
    cm), random, still, replay:TRAJECTORY.h5, a folder of `robocas train`, module:Class of your own, one that an
    installed package brings (`robocas list`), or ws://HOST:PORT, a server's (`robocas serve-policy`)."""
    protocol: Maybe[str] = None
    """Name of a shipped protocol, or a folder. Default: ms3-v1; of a result, the shipped one that it names."""
    out: Maybe[Path] = None
    """Folder to write to. Default: eval/PROTOCOL/POLICY, with the weld eval/PROTOCOL/POLICY_weld."""
    resume: bool = False
    """Go on with a result that is there."""
    retry_errors: bool = False
    """With --resume: play episodes again that an error broke off, such as a server that was gone."""
    envs: int = 2
    """Envs at a time; the outcome does not depend on it."""
    workers: Maybe[int] = None
    """Processes. Default: one an env, no more than cores."""
    step_seconds: float = 300.0
    """Seconds that envs of a process may take for a step or a reset. Where they take longer, or more memory, or crash,
    the episode is played again once; then it counts as failed, broken off by an error. Policies have no limit."""
    memory_gb: float = 8.0
    """GB of memory that a process of envs may use."""
    backend: Literal["auto", "processes", "gpu"] = "auto"
    """Where envs run. Auto: a GPU if there is one."""
    shard: str = "0/1"
    """Only a part of the episodes, K/N: the K-th of N runs, from 0 on. The words above take the folders of
    all parts."""
    split: Word = ""
    """Only the episodes of this split, such as `seen`."""
    episodes: Maybe[int] = None
    """Only the first so many of each configuration."""
    weld: bool = False
    """Weld what closed fingers have lifted to the hand, as upstream does, until the gripper is told to open. Only in
    protocols with upstream's steps (paper-v1), in processes; never to be compared with results without."""
    count: int = 8
    """How many videos, of all kinds of failures in turn."""
    set: Repeated[str] = ()
    """With freeze: set a key in all configurations of the plan, such as `--set objects.count=12`; repeatable
    (docs/configuration.md)."""


WORDS = ("report", "merge", "compare", "verify", "videos", "protocols", "freeze")


def main(cfg: Eval) -> int:
    """Run the command; gives the exit code."""
    from robocas_ms3.cli import eval_protocols, eval_results
    from robocas_ms3.core.errors import EvaluationError

    first = cfg.words[0] if cfg.words else ""
    if cfg.set and first != "freeze":
        raise EvaluationError(
            "a protocol's configurations are frozen",
            where="--set",
            expected="eval freeze PLAN.yaml --set KEY=VALUE",
            found=cfg.set[0],
            fix="Freeze a protocol of your own.",
        )
    if first not in WORDS:
        return run(cfg)
    about = [Path(word) for word in cfg.words[1:]]
    if first == "protocols":
        return eval_protocols.protocols()
    if first == "freeze":
        return eval_protocols.freeze(_one(about, first), cfg.out, cfg.set)
    if not about:
        raise EvaluationError("of what?", where=first, expected="a folder of a result, or those of its parts")
    if first == "compare":
        return eval_results.compare(about, cfg.protocol)
    if first == "merge":
        return eval_results.merge(about, cfg.out, cfg.protocol)
    if first == "videos":
        return eval_results.videos(_one(about, first), cfg.protocol, cfg.policy, cfg.count)
    if first == "report":
        return eval_results.report(about, cfg.out, cfg.protocol)
    return eval_results.verify(about, cfg.protocol)


def run(cfg: Eval) -> int:
    """Play what a result lacks."""
    from robocas_ms3.core.errors import EvaluationError
    from robocas_ms3.core.strict import nearest
    from robocas_ms3.scenes.task_specs import TASKS

    for word in cfg.words:  # before seconds go by for what is imported next
        if word not in TASKS:
            expected = f"one of {', '.join(TASKS)}; or {', '.join(WORDS)}"
            raise EvaluationError("no such task", where=word, expected=expected, fix=nearest(word, [*TASKS, *WORDS]))
    from robocas_ms3.cli.bars import bar
    from robocas_ms3.cli.eval_results import write_pages
    from robocas_ms3.cli.terminal import say, say_lines
    from robocas_ms3.core.strict import check_number
    from robocas_ms3.core.words import count_of
    from robocas_ms3.core.workers import Limits, use_one_torch_thread
    from robocas_ms3.evaluation.policies import check_policy, open_policy
    from robocas_ms3.evaluation.protocol import load_protocol
    from robocas_ms3.evaluation.results import read
    from robocas_ms3.evaluation.tables import markdown

    for name, number in (("envs", cfg.envs), ("episodes", cfg.episodes), ("workers", cfg.workers)):
        if number is not None:
            check_number(name, number, 1)
    check_number("step_seconds", cfg.step_seconds, 1)
    check_number("memory_gb", cfg.memory_gb, 0.1)
    if cfg.retry_errors and not cfg.resume:
        raise EvaluationError("there is nothing to retry", where="--retry-errors", fix="Pass --resume too.")
    shard = shard_of(cfg.shard)
    check_policy(cfg.policy)
    protocol = load_protocol(cfg.protocol or "ms3-v1")
    from robocas_ms3.evaluation.run import Settings, evaluate

    use_one_torch_thread()
    name = re.sub(r"[^\w.-]+", "_", cfg.policy) + ("_weld" if cfg.weld else "")
    out = cfg.out or (Path("eval") / protocol.rules.name / name).absolute()
    settings = Settings(
        num_envs=cfg.envs,
        backend=cfg.backend,
        workers=cfg.workers,
        shard=shard,
        tasks=cfg.words,
        episodes=cfg.episodes,
        split=cfg.split,
        weld=cfg.weld,
        limits=Limits(cfg.step_seconds, cfg.memory_gb),
    )
    succeeded = played = 0
    with open_policy(cfg.policy) as policy, bar("episodes played") as shown:
        try:
            again, begun = cfg.retry_errors, shown.start
            for outcome in evaluate(
                protocol, policy, cfg.policy, out, settings, resume=cfg.resume, again=again, on_start=begun
            ):
                played += 1
                succeeded += outcome.success
                shown.advance()
        except KeyboardInterrupt:
            raise KeyboardInterrupt("the same command with --resume goes on") from None
    result = read(out)
    say_lines(markdown(result))
    broken = result.broken_off()
    fix = f", {broken} broken off by an error (--resume --retry-errors plays them again)" if broken else ""
    there = count_of(len(result.outcomes), "episode")
    say(f"{count_of(played, 'episode')} played, {succeeded} succeeded; {out}: {there}{fix}")
    write_pages(result, out, cfg.protocol)
    return 0


def shard_of(text: str) -> tuple[int, int]:
    """(number, of how many) of ``K/N``.

    Raises:
        EvaluationError: it is none.
    """
    from robocas_ms3.core.errors import EvaluationError

    number, _, of = text.partition("/")
    if not (number.isdecimal() and of.isdecimal() and int(number) < int(of)):
        raise EvaluationError("no part of a whole", where="--shard", expected="K/N such as 0/4", found=text)
    return int(number), int(of)


def _one(about: list[Path], word: str) -> Path:
    from robocas_ms3.core.errors import EvaluationError

    if len(about) != 1:
        raise EvaluationError("takes one thing", where=word, expected="a folder or file", found=len(about))
    return about[0]
