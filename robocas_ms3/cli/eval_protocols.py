"""``robocas eval protocols | freeze``: protocols that are shipped, and one's own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from robocas_ms3.core.words import count_of


def protocols() -> int:
    """List the protocols that are shipped."""
    from robocas_ms3.cli.terminal import say
    from robocas_ms3.evaluation.protocol import load_protocol, shipped_protocols

    for name in shipped_protocols():
        protocol = load_protocol(name)
        say(
            f"{name}: {count_of(len(protocol.episodes), 'episode')}, {protocol.hash[:12]}: {protocol.rules.description}"
        )
        if protocol.train_files():
            say(f"    to train on: {', '.join(map(str, protocol.train_files()))}")
    return 0


def freeze(plan: Path, out: Path | None, overrides: Sequence[str] = ()) -> int:
    """Make a protocol; ``overrides`` are set in all configurations of the plan."""
    from robocas_ms3.cli.bars import bar
    from robocas_ms3.cli.terminal import say
    from robocas_ms3.core.errors import EvaluationError
    from robocas_ms3.core.outputs import check_absent
    from robocas_ms3.evaluation.freeze import freeze as make
    from robocas_ms3.evaluation.freeze import read_plan
    from robocas_ms3.evaluation.protocol import load_protocol

    if out is None:
        raise EvaluationError("where to?", where="--out", expected="a folder")
    read = read_plan(plan)
    check_absent(out, EvaluationError)
    with bar("episodes chosen") as shown:
        for done, total in make(read, out, overrides=overrides):
            shown.at(done, total)
    say(f"{out}: {count_of(len(load_protocol(out).episodes), 'episode')}, {load_protocol(out).hash}")
    return 0
