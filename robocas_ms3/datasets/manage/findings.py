"""What is found out about a dataset made elsewhere: problems, and episodes as they would be taken."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.tolerant import EpisodeArrays

ESSENTIAL = ("ee_pos", "ee_orn", "gripper_status", "language_goal", "step_lang_goals", "step_goal_type")
"""Without one of these an episode is of no use; relative motion follows from ee_pos and ee_orn."""
EMBEDDINGS = tuple(spec.name for spec in schema.EPISODE_INFO if spec.embedding)
Outcome = Literal["left out", "mended", "noted"]


@dataclass(frozen=True)
class Finding:
    """Something that is not as the schema has it.

    Attributes:
        episode: its number; None: the dataset's.
        file: path in the dataset, key after a comma.
        problem: what is wrong.
        outcome: ``left out``: the episode is not taken; ``mended``: put right on the way; ``noted``: taken as it is.
    """

    episode: int | None
    file: str
    problem: str
    outcome: Outcome


@dataclass(frozen=True)
class EpisodeImport:
    """An episode made elsewhere, with what could be put right.

    Attributes:
        number: of it.
        stored: its arrays, as the schema wants them.
        findings: what is not, or was not.
        turn_deg: its EEF frame was turned by this about z, to be ManiSkill's.
        pictures: that it has; None where they were not looked at.
    """

    number: int
    stored: EpisodeArrays
    findings: tuple[Finding, ...]
    turn_deg: int = 0
    pictures: Pictures | None = None

    @property
    def usable(self) -> bool:
        """Whether it can be taken."""
        return all(finding.outcome != "left out" for finding in self.findings)

    @property
    def embedded(self) -> bool:
        """Whether all embeddings are there."""
        return set(EMBEDDINGS) <= self.stored.arrays.keys()

    @property
    def missing(self) -> list[str]:
        """Keys that could not be made."""
        wanted = (spec.name for spec in schema.EPISODE_INFO if not spec.embedding)
        return [key for key in wanted if key not in self.stored.arrays]

    @property
    def mended(self) -> list[str]:
        """What was put right, in words."""
        mended = (finding for finding in self.findings if finding.outcome == "mended")
        return [f"{finding.file.split('/', 1)[1]}: {finding.problem}" for finding in mended]
