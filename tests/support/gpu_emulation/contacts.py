"""Contact impulse queries of the emulated GPU system."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpu_emulation.buffers import Buffer


class ContactQuery:
    """Stand-in for SAPIEN's contact impulse queries.

    Attributes:
        cuda_impulses: (Q, 3) N s, written by `Contacts.read`.
        terms: by pair of bodies, or by body: row of ``cuda_impulses`` and sign.
    """

    def __init__(self, terms: dict[Any, tuple[int, float]], count: int) -> None:
        self.cuda_impulses = Buffer(np.zeros((count, 3), np.float32))
        self.terms = terms


class Contacts:
    """Reads the impulses of the last step from all CPU systems.

    Args:
        systems: one CPU system per env; the list may grow.
    """

    def __init__(self, systems: Sequence[Any]) -> None:
        self._systems = systems
        self._queried: set[Any] = set()  # bodies; reading the points of all other contacts takes too long
        self._impulses: dict[tuple[Any, Any], NDArray[np.float32]] | None = None

    def clear(self) -> None:
        """Discard the impulses of the last step."""
        self._impulses = None

    def pair_query(self, pairs: Sequence[tuple[Any, Any]]) -> ContactQuery:
        """Make a query of the impulse on the first body of each pair by the second."""
        if not pairs:
            raise RuntimeError("failed to create contact query: empty body pairs")
        terms = {}
        for row, (first, second) in enumerate(pairs):
            terms[first, second], terms[second, first] = (row, 1.0), (row, -1.0)
        self._queried |= min({first for first, _ in pairs}, {second for _, second in pairs}, key=len)
        self.clear()
        return ContactQuery(terms, len(pairs))

    def read(self, query: ContactQuery) -> None:
        """Write the impulses of the last step into a query."""
        impulses = query.cuda_impulses.array
        impulses[:] = 0
        for pair, impulse in self._of_last_step().items():
            if pair in query.terms:
                row, sign = query.terms[pair]
                impulses[row] += sign * impulse

    def _of_last_step(self) -> dict[tuple[Any, Any], NDArray[np.float32]]:
        """Sum the impulses on the first body of each pair that touches, over its contact points."""
        if self._impulses is None:
            self._impulses = {}
            for system in self._systems:
                for contact in system.get_contacts():
                    pair = tuple(contact.bodies)
                    if self._queried.isdisjoint(pair):
                        continue
                    total = self._impulses.setdefault(pair, np.zeros(3, np.float32))
                    for point in contact.points:
                        total += point.impulse
        return self._impulses
