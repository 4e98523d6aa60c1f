"""What another policy left behind: the beginning of an episode that no reset leads to. Loads no simulator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from robocas_ms3.core.errors import EpisodeLost


@dataclass(frozen=True)
class Takeover:
    """State in which a policy left a scene.

    Attributes:
        seed: of the scene.
        policy: its name.
        policy_steps: for which it acted.
        state: as ``set_state_dict`` takes it, each array (1, D) float32 or bool; without targets of controllers.
        gripper: last command of the gripper, -1 closed or 1 open.
        refused: why nothing can be taken over, in a few words that can be counted; empty: it can.
    """

    seed: int
    policy: str
    policy_steps: int
    state: dict[str, dict[str, NDArray[Any]]]
    gripper: float
    refused: str = ""

    def check(self) -> None:
        """Raise ``EpisodeLost`` if nothing can be taken over."""
        if self.refused:
            raise EpisodeLost("takeover", self.refused)
