"""What is found out about a dataset made elsewhere: problems, and episodes that can be taken."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from numpy.typing import NDArray

from robocas_ms3.datasets import schema

FULL_SIZE = (640, 480)
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
class Layout:
    """What all episodes of a dataset share. ``size`` is None where cameras differ or it is 640 x 480."""

    cameras: tuple[str, ...]
    depth: bool
    image_format: schema.ImageFormat
    size: tuple[int, int] | None

    def __str__(self) -> str:
        size = "{} x {}".format(*(self.size or FULL_SIZE))
        return f"{', '.join(self.cameras)}, {size} {self.image_format}, {'with' if self.depth else 'without'} depth"


@dataclass
class Found:
    """An episode that can be taken.

    Attributes:
        number: of it.
        arrays: all of them, as the schema wants them.
        derived: key -> what it was made of.
        missing: keys that could not be made.
        mended: what was put right, in words.
        turn_deg: its EEF frame was turned by this about z, to be ManiSkill's.
        layout: of its pictures.
    """

    number: int
    arrays: dict[str, NDArray] = field(default_factory=dict)
    derived: dict[str, str] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    mended: list[str] = field(default_factory=list)
    turn_deg: int = 0
    layout: Layout | None = None

    @property
    def steps(self) -> int:
        """T."""
        return int(self.arrays["episode_length"])

    @property
    def embedded(self) -> bool:
        """Whether all embeddings are there."""
        return all(spec.name in self.arrays for spec in schema.EPISODE_INFO if spec.embedding)


@dataclass
class Report:
    """Collects the findings of one episode.

    Attributes:
        number: of it.
        folder: its path in the dataset, with a slash.
        findings: they are added here.
        usable: whether it can be taken, as far as is known.
        mendings: what was put right, in words.
    """

    number: int
    folder: str
    findings: list[Finding]
    usable: bool = True
    mendings: list[str] = field(default_factory=list)

    def bad(self, file: str, problem: str) -> None:
        """The episode can't be taken."""
        self.usable = False
        self.findings.append(Finding(self.number, self.folder + file, problem, "left out"))

    def mended(self, file: str, problem: str) -> None:
        """Something was put right."""
        self.mendings.append(f"{file}: {problem}")
        self.findings.append(Finding(self.number, self.folder + file, problem, "mended"))

    def noted(self, file: str, problem: str) -> None:
        """Something is taken, or left, as it is."""
        self.findings.append(Finding(self.number, self.folder + file, problem, "noted"))
