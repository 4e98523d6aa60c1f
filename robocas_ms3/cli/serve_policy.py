"""``robocas serve-policy``: let a policy answer over a socket."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from typing import Annotated

import tyro


@dataclass
class ServePolicy:
    """Let a policy act for evaluations elsewhere: robocas eval --policy ws://HOST:PORT. Ctrl-C ends it.

    There is no password, and whoever can reach the port can ask: keep to loopback, and tunnel (ssh -L).
    """

    policy: Annotated[str, tyro.conf.Positional]
    """As robocas eval has it: scripted, random, still, replay:TRAJECTORY.h5, a folder of robocas train, or
    module:Class of your own."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0: all of this machine's."""
    port: int = 8000
    """0: any that is free, which is printed."""


def main(cfg: ServePolicy) -> int:
    """Run the command; gives the exit code."""
    from robocas_ms3.cli.bars import say
    from robocas_ms3.errors import EvaluationError
    from robocas_ms3.evaluation.policies import open_policy
    from robocas_ms3.evaluation.remote.server import PolicyServer

    if not 0 <= cfg.port < 2**16:
        raise EvaluationError("no such port", where="--port", expected="0 to 65535", found=cfg.port)
    if not _is_loopback(cfg.host):
        say(f"{cfg.host} is no loopback address: whoever can reach it can ask this policy")
    with open_policy(cfg.policy) as policy:
        PolicyServer(policy, cfg.host, cfg.port).run(lambda url: say(f"{cfg.policy} at {url}"))
    return 0


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
