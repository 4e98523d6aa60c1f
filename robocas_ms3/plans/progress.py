"""Which work units of a plan are done, and which ones are still needed."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from robocas_ms3.core.errors import PlanError
from robocas_ms3.plans.folder import UNITS
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.units import Outcome, Unit, started_blocks


@dataclass(frozen=True)
class Shard:
    """The work units whose block is ``index`` modulo ``count``."""

    index: int = 0
    count: int = 1

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Parse ``K/N``.

        Raises:
            PlanError: it has another form, or K is not less than N.
        """
        found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
        if not found or int(found[1]) >= int(found[2]):
            raise PlanError("invalid shard", where="--shard", expected="K/N with K < N, such as 0/4", found=repr(text))
        return cls(int(found[1]), int(found[2]))

    def __contains__(self, unit: Unit) -> bool:
        return unit.block % self.count == self.index


class Progress:
    """The outcomes of a plan's work units, read from its folder.

    Units of a part are needed in order, until they have its number of episodes; a unit that is not done counts as if
    all its seeds succeeded. So which units are needed in the end depends on the plan alone.
    """

    def __init__(self, plan: Plan, out: Path) -> None:
        self.plan, self._out = plan, out
        self.parts = [_PartProgress(plan, number) for number in range(len(plan.parts))]
        self.read()

    def read(self) -> None:
        """Read the outcomes of units that were completed since."""
        for part in self.parts:
            for block in started_blocks(self.plan, self._out, part.number):
                if block not in part.done:
                    self.add(Unit(part.number, block))

    def add(self, unit: Unit) -> bool:
        """Read the outcomes of a unit; return whether it is complete."""
        part = self.parts[unit.part]
        if unit.block not in part.done:
            outcomes = unit.outcomes(self.plan, self._out)
            if outcomes is None:
                return False
            part.add(unit.block, outcomes)
        return True

    def check_failures(self) -> None:
        """Check that seeds succeed.

        Raises:
            PlanError: almost all seeds of a part fail.
        """
        for part in self.parts:
            if part.failures:
                where, fix = self._out / UNITS / self.plan.name_of(part.number), "A smaller objects.count may help."
                raise PlanError("almost all seeds fail", where=where, found=part.failures, fix=fix)

    def missing(self, shard: Shard | None = None) -> Iterator[Unit]:
        """Yield the units that are needed and not done, in the order of the plan."""
        for part in self.parts:
            for unit in part.missing():
                if shard is None or unit in shard:
                    yield unit

    def partial(self) -> dict[int, list[Outcome]]:
        """Read the outcomes of seeds in units that are not complete, by the number of their part."""
        return {
            part.number: [
                outcome
                for block in started_blocks(self.plan, self._out, part.number)
                if block not in part.done
                for outcome in Unit(part.number, block).partial_outcomes(self.plan, self._out)
            ]
            for part in self.parts
        }

    def chosen(self) -> dict[int, list[tuple[Unit, Outcome]]]:
        """Return the episodes of each part: the first successful seeds, in order, once no unit is missing."""
        return {part.number: part.chosen() for part in self.parts}

    def forget(self, unit: Unit, seeds: list[int]) -> None:
        """Delete some seeds, which are then done again."""
        unit.forget(self.plan, self._out, seeds)
        self.parts[unit.part].forget(unit.block)


class _PartProgress:
    """The outcomes of one part's units.

    Attributes:
        done: block -> outcomes of a unit that is complete.
        failures: how many seeds fail, if almost all do; else empty.
    """

    def __init__(self, plan: Plan, number: int) -> None:
        self.number, self._size, self._wanted = number, plan.block_of(number), plan.parts[number].episodes
        self.done: dict[int, list[Outcome]] = {}
        self.failures = ""
        self._checked = self._seeds = self._successes = 0  # of the first blocks, without a gap

    def missing(self) -> Iterator[Unit]:
        block, expected = self._checked, self._successes
        while expected < self._wanted:
            if block in self.done:
                expected += _successes(self.done[block])
            else:
                expected += self._size
                yield Unit(self.number, block)
            block += 1

    def add(self, block: int, outcomes: list[Outcome]) -> None:
        self.done[block] = outcomes
        # block by block without a gap: whether too many fail must not depend on which unit is done first
        while self._checked in self.done:
            first = self.done[self._checked]
            self._checked += 1
            self._seeds += len(first)
            self._successes += _successes(first)
            failed = self._seeds - self._successes
            if failed > max(20, 3 * self._successes) and not self.failures:
                reasons = Counter(each.failures[-1] for done in self.done.values() for each in done if each.failures)
                self.failures = f"{failed} of {self._seeds}"
                self.failures += f", most of them: {reasons.most_common(1)[0][0]}" if reasons else ""

    def chosen(self) -> list[tuple[Unit, Outcome]]:
        episodes = [
            (Unit(self.number, block), outcome)
            for block in sorted(self.done)
            for outcome in self.done[block]
            if outcome.success
        ]
        return episodes[: self._wanted]

    def forget(self, block: int) -> None:
        del self.done[block]
        self._checked = self._seeds = self._successes = 0


def _successes(outcomes: list[Outcome]) -> int:
    return sum(outcome.success for outcome in outcomes)
