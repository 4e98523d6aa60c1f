"""One thing wrong with a dataset."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Violation:
    """A difference from the schema.

    Attributes:
        file: path in the dataset; empty: the dataset as a whole.
        key: in that file; empty: the file itself.
        expected: by the schema.
        found: instead.
    """

    file: str
    key: str
    expected: str
    found: str

    def __str__(self) -> str:
        """One line."""
        where = ", ".join(part for part in (self.file, self.key) if part) or "dataset"
        return f"{where}: expected {self.expected}, found {self.found}"
