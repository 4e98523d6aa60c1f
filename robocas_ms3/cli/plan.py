"""``robocas plan run | status | list``: datasets of any size, from a plan."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from robocas_ms3.cli.options import Maybe, Repeated
from robocas_ms3.core.words import count_of


@dataclass
class Run:
    """Make the dataset that a plan says: record, render, join. docs/scale.md.

    What is there is kept, and Ctrl-C or a crash loses no episode: the same command with --resume goes on.
    """

    plan: Annotated[str, tyro.conf.Positional]
    """Name of a shipped plan (`robocas plan list`), or a YAML file."""
    out: Path
    """Folder of everything the plan makes."""
    on: Literal["local", "slurm", "ray"] = "local"
    """Where the work is done: on this machine, by jobs of Slurm, by a Ray cluster."""
    jobs: Maybe[int] = None
    """How many episodes are made at once. Default: one for each CPU core of this machine."""
    executor_option: Repeated[str] = ()
    """Set an option of Slurm or Ray, such as `--executor-option partition=cpu`; repeatable (docs/scale.md)."""
    resume: bool = False
    """Go on with a plan that was begun."""
    overwrite: bool = False
    """Replace the output folder if it exists."""


@dataclass
class Status:
    """Say how far a plan is, from any machine that sees its folder."""

    out: Annotated[Path, tyro.conf.Positional]
    """The folder."""
    json: bool = False
    """As JSON."""


@dataclass
class List:
    """List the shipped plans."""


@dataclass
class Plan:
    """Make datasets of any size from a plan; docs/scale.md."""

    command: (
        Annotated[Run, tyro.conf.subcommand("run")]
        | Annotated[Status, tyro.conf.subcommand("status")]
        | Annotated[List, tyro.conf.subcommand("list")]
    )
    """What to do."""


def main(cfg: Plan) -> int:
    """Run the command."""
    if isinstance(cfg.command, Run):
        try:
            return run(cfg.command)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("the same command with --resume goes on") from None
    if isinstance(cfg.command, Status):
        return show_status(cfg.command)
    from robocas_ms3.cli.terminal import say
    from robocas_ms3.plans.plan import load_plan, shipped_plans

    for name in shipped_plans():
        plan = load_plan(name)
        say(f"{name}: {count_of(sum(part.episodes for part in plan.parts), 'episode')}. {plan.description}")
    return 0


def run(command: Run) -> int:
    """Run ``run``."""
    import os

    from robocas_ms3.cli.plan_progress import PlanProgress
    from robocas_ms3.cli.terminal import say
    from robocas_ms3.demos.checks import check_number
    from robocas_ms3.plans.engines import check_engine, open_engine
    from robocas_ms3.plans.plan import load_plan
    from robocas_ms3.plans.run import run_plan
    from robocas_ms3.plans.units import REPORT

    jobs = command.jobs if command.jobs is not None else os.cpu_count() or 1
    check_number("jobs", jobs, 1)
    options = dict(_option(word) for word in command.executor_option)
    plan = load_plan(command.plan)
    check_engine(command.on, options)
    if command.on == "local" and plan.makes_datasets:
        from robocas_ms3.datasets.writing.render import require_renderer

        require_renderer()
    with PlanProgress(plan, command.out) as progress:
        report = run_plan(
            plan,
            command.out,
            lambda plan, out: open_engine(command.on, plan, out, jobs, options),
            resume=command.resume,
            overwrite=command.overwrite,
            jobs=jobs,
            on_progress=progress.at,
            on_stage=progress.note,
        )
    made = [str(path.relative_to(command.out)) for path in sorted(command.out.glob("d[ae]*s/*"))]
    say(f"{command.out}: {count_of(report['episodes'], 'episode')}; {', '.join([*made, REPORT])}")
    return 0


def _option(word: str) -> tuple[str, str]:
    from robocas_ms3.core.errors import PlanError

    name, sign, value = word.partition("=")
    if not (name and sign):
        raise PlanError("invalid option", where="--executor-option", expected="NAME=VALUE", found=word)
    return name, value


def show_status(command: Status) -> int:
    """Run ``status``."""
    import json

    from rich.markup import escape
    from rich.table import Table

    from robocas_ms3.cli.terminal import say, say_lines, table_console
    from robocas_ms3.plans.status import status

    found = status(command.out)
    if command.json:
        say_lines(json.dumps(found.as_json(), indent=2))
        return 0
    table = Table("part", "episodes", "seeds", "failed", "record, CPU s each", "render, CPU s each", "MB")
    for part in found.parts:
        failed = ", ".join(f"{reason} x{count}" for reason, count in part.failed.items()) or "-"
        table.add_row(
            part.name,
            f"{part.done} of {part.wanted}",
            str(part.tried),
            escape(failed),  # a reason may be anything
            f"{part.record_seconds:.1f}",
            f"{part.render_seconds:.1f}",
            f"{part.bytes / 1e6:.0f}",
        )
    table_console().print(table)
    if found.finished:
        say("finished")
        return 0
    if found.seconds_left is not None:
        left, idle = found.seconds_left / 60, found.idle_seconds or 0.0
        rate = count_of(round(found.episodes_an_hour), "episode")
        say(f"{rate} an hour, {left:.0f} min left; the last {idle:.0f} s ago")
    joins = ", and joins" * all(part.done == part.wanted for part in found.parts)
    say(f"{found.at_work} is at it{joins}" if found.at_work else "nobody is at it; --resume goes on")
    return 0
