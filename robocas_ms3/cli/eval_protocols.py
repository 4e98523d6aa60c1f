"""``robocas eval protocols | freeze``: list the bundled protocols, make one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from robocas_ms3.cli.options import Repeated
from robocas_ms3.core.words import count_of


@dataclass
class Protocols:
    """List the bundled protocols, and the configurations to train on that belong to them.

    Example: robocas eval protocols
    """


@dataclass
class Freeze:
    """Make a protocol of your own from a plan: choose its scenes and write them to files.

    Example: robocas eval freeze scripts/protocols/smoke.yaml --out protocols/mine --set objects.count=12
    """

    plan: Annotated[Path, tyro.conf.Positional]
    """YAML file of the plan; scripts/protocols has those of the bundled protocols."""
    out: Path
    """Folder of the protocol."""
    set: Repeated[str] = ()
    """Set a key in all configurations of the plan, such as `--set objects.count=12`; repeatable
    (docs/configuration.md)."""


def list_protocols(cfg: Protocols) -> int:
    """Run ``protocols``."""
    from robocas_ms3.cli.terminal import say
    from robocas_ms3.evaluation.protocol import load_protocol, shipped_protocols

    for name in shipped_protocols():
        protocol = load_protocol(name)
        count = count_of(len(protocol.episodes), "episode")
        say(f"{name}: {count}, {protocol.hash[:12]}: {protocol.rules.description}")
        if files := protocol.train_files():
            say(f"    to train on: {', '.join(map(str, files))}")
    return 0


def freeze(cfg: Freeze) -> int:
    """Run ``freeze``."""
    from robocas_ms3.cli.bars import bar
    from robocas_ms3.cli.terminal import say
    from robocas_ms3.core.outputs import check_replaceable
    from robocas_ms3.evaluation.freeze import freeze as make
    from robocas_ms3.evaluation.freeze import read_plan
    from robocas_ms3.evaluation.protocol import load_protocol

    plan = read_plan(cfg.plan)
    check_replaceable(cfg.out)
    with bar("episodes chosen") as shown:
        for done, total in make(plan, cfg.out, overrides=cfg.set):
            shown.at(done, total)
    protocol = load_protocol(cfg.out)
    say(f"{cfg.out}: {count_of(len(protocol.episodes), 'episode')}, {protocol.hash}")
    return 0
