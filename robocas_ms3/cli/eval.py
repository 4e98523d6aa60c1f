"""``robocas eval``: measure a policy by a protocol; report, compare and check results; make protocols."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from robocas_ms3.cli import eval_protocols, eval_results
from robocas_ms3.cli.interrupts import resumable
from robocas_ms3.cli.options import Maybe, Several, Word

DESCRIPTION = """Measure a policy by a protocol, and work with results.

`robocas eval pick --policy small` is short for `robocas eval run pick --policy small`.
"""


@dataclass
class Run:
    """Measure a policy by a protocol: every episode of its list once, written as it ends.

    Example: robocas eval pick --policy runs/pick --protocol paper-v1 --out eval/pick
    """

    tasks: Annotated[Several[str], tyro.conf.Positional] = ()
    """Only the episodes of these tasks. Default: all."""
    policy: str = "scripted"
    """Policy: scripted (joint targets), scripted-motions (RoboCAS' 7 numbers), scripted-beside (these, off by some
    cm), random, still, replay:TRAJECTORY.h5, a folder of `robocas train`, module:Class of your own, one that an
    installed package brings (`robocas list`), or ws://HOST:PORT, a server's (`robocas serve-policy`)."""
    protocol: Maybe[str] = None
    """Name of a bundled protocol, or its folder. Default: ms3-v1."""
    out: Maybe[Path] = None
    """Folder to write to. Default: eval/PROTOCOL/POLICY, with the weld eval/PROTOCOL/POLICY_weld."""
    overwrite: bool = False
    """Start again. Default: continue a result with the same settings, or add episodes to it."""
    retry_errors: bool = False
    """Run episodes again that ended with an error, such as a server that was gone."""
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
    """K/N: only every N-th episode, from the K-th on (K = 0 ... N - 1). `robocas eval merge` joins the results."""
    split: Word = ""
    """Only the episodes of this split, such as `seen`."""
    episodes: Maybe[int] = None
    """Only the first so many of each configuration."""
    weld: bool = False
    """Weld what closed fingers have lifted to the hand, as upstream does, until the gripper is told to open. Only in
    protocols with upstream's steps (paper-v1), in processes; never to be compared with results without."""


@resumable
def run(cfg: Run) -> int:
    """Play the episodes that the result does not have yet; give 1 if any of the result ended with an error."""
    from robocas_ms3.core.errors import EvaluationError
    from robocas_ms3.core.strict import nearest
    from robocas_ms3.scenes.task_specs import TASKS

    for word in cfg.tasks:  # before seconds go by for what is imported next
        if word not in TASKS:
            expected = f"one of {', '.join(TASKS)}; or {', '.join(COMMANDS)}"
            fix = nearest(word, [*TASKS, *COMMANDS])
            raise EvaluationError("no such task", where=word, expected=expected, fix=fix)
    from robocas_ms3.cli.bars import bar
    from robocas_ms3.cli.eval_results import write_pages
    from robocas_ms3.cli.terminal import say, say_lines
    from robocas_ms3.core.strict import check_number
    from robocas_ms3.core.words import count_of
    from robocas_ms3.core.workers import Limits, use_one_torch_thread
    from robocas_ms3.evaluation.policies import check_policy, open_policy
    from robocas_ms3.evaluation.protocol import load_protocol
    from robocas_ms3.evaluation.report.tables import markdown
    from robocas_ms3.evaluation.results import read

    for name, number in (("envs", cfg.envs), ("episodes", cfg.episodes), ("workers", cfg.workers)):
        if number is not None:
            check_number(name, number, 1)
    check_number("step_seconds", cfg.step_seconds, 1)
    check_number("memory_gb", cfg.memory_gb, 0.1)
    shard = shard_of(cfg.shard)
    check_policy(cfg.policy)
    protocol = load_protocol(cfg.protocol or "ms3-v1")
    from robocas_ms3.evaluation.session import EvaluationSession, evaluate
    from robocas_ms3.evaluation.settings import EvaluationSettings

    use_one_torch_thread()
    name = re.sub(r"[^\w.-]+", "_", cfg.policy) + ("_weld" if cfg.weld else "")
    out = cfg.out or (Path("eval") / protocol.rules.name / name).absolute()
    settings = EvaluationSettings(
        policy_name=cfg.policy,
        num_envs=cfg.envs,
        backend=cfg.backend,
        workers=cfg.workers,
        shard=shard,
        tasks=cfg.tasks,
        episodes=cfg.episodes,
        split=cfg.split,
        weld=cfg.weld,
        limits=Limits(cfg.step_seconds, cfg.memory_gb),
    )
    succeeded = played = 0
    with open_policy(cfg.policy) as policy, bar("episodes played") as shown:
        session, retry = EvaluationSession(protocol, policy, settings), cfg.retry_errors
        for outcome in evaluate(session, out, overwrite=cfg.overwrite, retry_errors=retry, on_start=shown.start):
            played += 1
            succeeded += outcome.success
            shown.advance()
    result = read(out)
    say_lines(markdown(result))
    broken = result.broken_off()
    fix = f", {broken} broken off by an error (--retry-errors runs them again)" if broken else ""
    there = count_of(len(result.outcomes), "episode")
    say(f"{count_of(played, 'episode')} played, {succeeded} succeeded; {out}: {there}{fix}")
    write_pages(result, out, cfg.protocol)
    return 1 if broken else 0


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


COMMANDS = {
    "run": run,
    "report": eval_results.report,
    "merge": eval_results.merge,
    "compare": eval_results.compare,
    "verify": eval_results.verify,
    "videos": eval_results.videos,
    "protocols": eval_protocols.list_protocols,
    "freeze": eval_protocols.freeze,
}
DEFAULT = "run"
