"""Define the error types of the package; each message is one line: where, what, expected, found, fix."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
from collections.abc import Mapping
from typing import Any


class RobocasError(Exception):
    """Base class of all errors that this package raises; the command line prints them without a traceback.

    Args:
        what: the problem, such as "unknown policy".
        where: the file, key, option or object with the problem.
        expected: the valid values.
        found: the invalid value.
        fix: a sentence that tells the user how to solve the problem.
        usage: whether the caller passed an unknown name or path; `robocas` then exits with status 2 instead of 1.
    """

    def __init__(
        self,
        what: str,
        *,
        where: object = "",
        expected: object = "",
        found: object = "",
        fix: str = "",
        usage: bool = False,
    ) -> None:
        self.what, self.where, self.expected, self.found, self.fix = what, where, expected, found, fix
        self.usage = usage
        head = f"{where}: {what}" if str(where) else what
        if isinstance(found, OSError) and found.strerror:  # without the number
            found = f"{found.strerror}: {found.filename}" if found.filename else found.strerror
        parts = [f"{name} {value}" for name, value in (("expected", expected), ("found", found)) if str(value)]
        message = head + (f" ({', '.join(parts)})" if parts else "") + (f". {fix}" if fix else "")
        super().__init__(message)


class ConfigError(RobocasError):
    """Invalid task configuration."""


class ExtensionError(RobocasError):
    """Unknown task, planner or other extension, or an extension that cannot be loaded."""


class AssetError(RobocasError):
    """Missing, damaged or invalid asset pack or mesh."""


class LayoutError(RobocasError):
    """No layout of the objects satisfies the task configuration."""


class SimulationError(RobocasError):
    """Failure of the physics engine."""


class OutputExistsError(RobocasError):
    """The output exists already and must not be overwritten."""


class DatasetError(RobocasError):
    """A trajectory file or dataset cannot be read or written."""


class EmptySplitError(DatasetError):
    """A split of a dataset (training or validation) has no episodes."""


class IncompleteDatasetError(DatasetError):
    """Some episodes of a dataset cannot be written; ``reasons`` has the reason per name of an episode folder."""

    reasons: Mapping[str, str] = {}


class PlanError(RobocasError):
    """Invalid plan of a dataset (`robocas plan`), or a plan whose dataset cannot be generated."""


class MissingExtraError(RobocasError):
    """Missing or broken optional dependency; the message has the command that installs it."""


def require_extra(extra: str, purpose: str, *modules: str, fix: str = "", load: bool = True) -> None:
    """Check that the modules of an extra are installed, and import them.

    Args:
        extra: name of the extra.
        purpose: what needs the modules, for the message.
        modules: names of the modules.
        fix: an alternative to installing the extra, for the message.
        load: whether to import the modules; without the import, a broken package is not found.

    Raises:
        MissingExtraError: a module is not installed, or its import fails.
    """
    if missing := [module for module in modules if importlib.util.find_spec(module) is None]:
        what, install = (
            f"modules for {purpose} are not installed: {', '.join(missing)}",
            f'In the clone: pip install -e ".[{extra}]".',
        )
        raise MissingExtraError(what, fix=f"{install} {fix}".rstrip())
    for module in modules if load else ():
        try:
            importlib.import_module(module)
        except Exception as error:
            name = importlib.metadata.packages_distributions().get(module, [module])[0]
            what, found = f"cannot import {module}, required for {purpose}", f"{type(error).__name__}: {error}"
            install = f"Install the package again: pip install --force-reinstall {name}."
            found = " ".join(found.split())[:300]
            raise MissingExtraError(what, found=found, fix=f"{install} {fix}".rstrip()) from error


class WorkerCrashError(RobocasError):
    """A worker process crashed, or was killed because a task exceeded a limit; ``found`` has the reason."""


class WorkerStartError(RobocasError):
    """A worker process crashed before its first task."""


class VectorEnvError(RobocasError):
    """A vector environment cannot be created or stepped."""


class VectorEnvCrashError(VectorEnvError):
    """A worker process of a vector environment crashed; ``envs`` are the indices of the affected environments."""

    envs: tuple[int, ...] = ()


class EvaluationError(RobocasError):
    """Invalid protocol, policy, setting or result of an evaluation."""


class WireError(EvaluationError):
    """A message to or from a remote policy cannot be encoded or decoded."""


class PolicyError(EvaluationError):
    """A policy could not act in some envs; only the episodes of these envs end.

    Args:
        reasons: reason of the failure by env index, for each failed env.
        actions: (E, A) or (E, H, A) as `Policy.act` returns them, for all envs of the request; rows of failed envs are
            ignored. None: all envs failed.
    """

    def __init__(self, reasons: Mapping[int, str], actions: Any = None) -> None:
        self.reasons, self.actions = dict(reasons), actions
        super().__init__(
            "the policy could not act", found="; ".join(f"env {env}: {why}" for env, why in reasons.items())
        )


class TrainingError(RobocasError):
    """A baseline cannot be trained: invalid configuration, run folder, checkpoint or dataset."""


class RobotDescriptionError(RobocasError):
    """Missing or invalid URDF, SRDF or collision mesh of a robot."""


class PlanningError(RobocasError):
    """A scripted policy could not plan or run a motion.

    Args:
        stage: stage of the task at which the error occurred: ``grasp_sampling``, ``reach``, ``approach``, ``grasp``,
            ``lift``, ...
        reason: a short fixed text, such as ``no_goals``; reports count the failures per reason.
    """

    def __init__(self, stage: str, reason: str) -> None:
        self.stage, self.reason = stage, reason
        super().__init__(f"{stage}: {reason}")

    def __reduce__(self):
        return type(self), (self.stage, self.reason)


class UnrecoverableError(PlanningError):
    """The episode cannot succeed from its current state; the scripted policy has to backtrack."""
