"""What does tasks, in whichever process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")
Task_contra = TypeVar("Task_contra", contravariant=True)
Result_co = TypeVar("Result_co", covariant=True)


class Worker(Protocol[Task_contra, Result_co]):
    """Does one task after the other."""

    def do(self, task: Task_contra, /) -> Result_co:
        """Do a task."""
        ...

    def close(self) -> None:
        """Free what it holds."""
        ...


@dataclass(frozen=True)
class Calls(Generic[Task, Result]):
    """A worker that needs nothing: calls a function."""

    function: Callable[[Task], Result]

    def do(self, task: Task) -> Result:
        """Call it."""
        return self.function(task)

    def close(self) -> None:
        """Nothing is held."""
