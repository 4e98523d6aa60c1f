"""Options of the engine that hands units to Slurm."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field

from robocas_ms3.core.errors import PlanError
from robocas_ms3.core.strict import StrictModel, parse
from robocas_ms3.plans.claims import LEASE
from robocas_ms3.plans.engines import refuse_options

PASSED = (
    *("partition", "account", "qos", "constraint", "exclude", "nodelist", "gres", "gpus_per_node", "reservation"),
    *("licenses", "nice", "begin", "comment", "exclusive", "mem_per_cpu", "mail_type", "mail_user", "wckey"),
)
"""Options of sbatch that are handed on as they are."""


class SlurmOptions(StrictModel):
    """What ``--executor-option`` may say, besides `PASSED`."""

    executor: Literal["slurm", "local"] = Field(default="slurm", description="local: processes of this machine")
    units_per_job: Annotated[int, Field(ge=1)] = Field(default=1, description="one after the other")
    tries: Annotated[int, Field(ge=1)] = Field(default=3, description="jobs of a unit that may die at the same episode")
    time: Annotated[int, Field(ge=1)] = Field(default=240, description="minutes of a job")
    mem_gb: Annotated[float, Field(gt=0)] | None = Field(
        default=None, description="of a job; None: what its two processes may use, 2 x limits.memory_gb of the plan"
    )
    cpus_per_task: Annotated[int, Field(ge=1)] = 1
    lease: Annotated[float, Field(gt=0)] = Field(
        default=LEASE, description="s without news after which a job counts as dead"
    )
    sbatch: dict[str, str] = Field(default={}, description="what is handed on")


def read_options(options: Mapping[str, str]) -> SlurmOptions:
    """Read the words of ``--executor-option``.

    Raises:
        PlanError: there is no such option, or it has no such value.
    """
    own = tuple(name for name in SlurmOptions.model_fields if name != "sbatch")
    refuse_options("slurm", options, own + PASSED)
    values: dict[str, Any] = {name: _number(value) for name, value in options.items() if name in own}
    passed = {name: value for name, value in options.items() if name in PASSED}
    return parse(
        SlurmOptions, values | {"sbatch": passed}, PlanError, where="--executor-option", about="no option of Slurm"
    )


def _number(text: str) -> Any:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
