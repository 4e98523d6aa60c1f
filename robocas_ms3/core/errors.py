"""Every failure a user can meet has a type here, and a message of one line: what, where, expected, found, fix."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from typing import Any


class RobocasError(Exception):
    """Base of all errors this package raises on purpose; the command line prints them in one line.

    Args:
        what: what went wrong.
        where: the file, key, flag or object concerned.
        expected: what would have been right.
        found: what was there instead.
        fix: what to do about it.
    """

    def __init__(
        self, what: str, *, where: object = "", expected: object = "", found: object = "", fix: str = ""
    ) -> None:
        self.what, self.where, self.expected, self.found, self.fix = what, where, expected, found, fix
        head = f"{where}: {what}" if str(where) else what
        parts = [f"{name} {value}" for name, value in (("expected", expected), ("found", found)) if str(value)]
        message = head + (f" ({', '.join(parts)})" if parts else "") + (f". {fix}" if fix else "")
        super().__init__(message)


class ConfigError(RobocasError):
    """A task configuration is wrong."""


class ExtensionError(RobocasError):
    """A task, planner or the like is not known, or another package's can't be loaded."""


class AssetError(RobocasError):
    """An asset pack, or a mesh on its way into one, is missing, damaged or unusable."""


class LayoutError(RobocasError):
    """No arrangement of the objects satisfies the configuration."""


class SimulationError(RobocasError):
    """The physics engine could not do what it was asked for."""


class OutputExistsError(RobocasError):
    """The output exists and may not be replaced: no flag allows it, or another command wrote it."""


class DatasetError(RobocasError):
    """A trajectory file or dataset can't be read or written."""


class EmptySplitError(DatasetError):
    """A split of a dataset holds no episodes."""


class IncompleteError(DatasetError):
    """Some episodes of a dataset can't be written; ``reasons`` has why, by name of the episode's folder."""

    reasons: Mapping[str, str] = {}


class PlanError(RobocasError):
    """A plan of datasets is wrong, or what it makes can't be made."""


class MissingExtraError(RobocasError):
    """An optional dependency is needed; the message names its extra."""


def require_extra(extra: str, purpose: str, *modules: str, fix: str = "") -> None:
    """Raise MissingExtraError if modules that an extra brings are not installed; ``fix`` is another way out."""
    if missing := [module for module in modules if importlib.util.find_spec(module) is None]:
        what, install = f"missing for {purpose}: {', '.join(missing)}", f'In the clone: pip install -e ".[{extra}]".'
        raise MissingExtraError(what, fix=f"{install} {fix}".rstrip())


class WorkerCrashed(RobocasError):
    """A worker process crashed, or was killed because its task exceeded a limit; ``found`` is the reason."""


class WorkerStartError(RobocasError):
    """A worker process died before its first task."""


class VectorEnvError(RobocasError):
    """A vector environment can't be made, or can't continue."""


class WorkerDied(VectorEnvError):
    """A worker of a vector environment died; ``envs`` are those that it was stepping, or all that it had."""

    envs: tuple[int, ...] = ()


class EvaluationError(RobocasError):
    """A protocol, policy, result or figure of an evaluation is invalid."""


class WireError(EvaluationError):
    """A message to or from a remote policy can't be written or read."""


class PolicyFailed(EvaluationError):
    """A policy could not act in some envs: their episodes end there, those of others go on.

    Args:
        reasons: why, by number of env.
        actions: (E, A) or (E, H, A) as `Policy.act` returns them, for all envs that it was asked about; rows of those
            that failed are ignored. None: all failed.
    """

    def __init__(self, reasons: Mapping[int, str], actions: Any = None) -> None:
        self.reasons, self.actions = dict(reasons), actions
        super().__init__("a policy failed", found="; ".join(f"env {env}: {why}" for env, why in reasons.items()))


class TrainingError(RobocasError):
    """A baseline can't be trained: its configuration, run, checkpoint or dataset is wrong."""


class RobotDescriptionError(RobocasError):
    """A robot's URDF, SRDF or collision mesh is missing or unusable."""


class PlanningFailed(RobocasError):
    """A scripted policy could not continue.

    Args:
        stage: the step of the policy: ``grasp_sampling``, ``reach``, ``approach``, ``grasp``, ``lift``, ...
        reason: why, in a few words that can be counted.
    """

    def __init__(self, stage: str, reason: str) -> None:
        self.stage, self.reason = stage, reason
        super().__init__(f"{stage}: {reason}")

    def __reduce__(self):
        return type(self), (self.stage, self.reason)


class EpisodeLost(PlanningFailed):
    """The episode can't succeed any more after what a scripted policy did, which has to be undone."""
