"""Find the work units of a plan that are complete, and those that are still needed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from robocas_ms3.core.errors import PlanError
from robocas_ms3.plans.folder import DATASETS, DEMOS, REPORT, UNITS, Outcome, PlanFolder, WorkUnit

Shard = tuple[int, int]
"""K, N: the work units whose block is K modulo N."""


class Progress:
    """Outcomes of the work units of a plan, read from its folder.

    The units of a part are needed in order, until their successful seeds reach the number of episodes. A unit that is
    not complete counts as if all its seeds succeeded. So the units needed in the end depend only on the plan.

    Attributes:
        done: outcomes of each complete unit.
        partial: outcomes of each unit that has started and is not complete.
    """

    def __init__(self, folder: PlanFolder) -> None:
        self.folder, self.plan = folder, folder.plan
        self.done: dict[WorkUnit, list[Outcome]] = {}
        self.partial: dict[WorkUnit, list[Outcome]] = {}
        # per part: units, seeds and successes of its first units that are complete without a gap
        self._first = [(0, 0, 0)] * len(self.plan.parts)
        self._failure_error: PlanError | None = None
        self.read()

    def read(self) -> None:
        """Read the outcomes of all units that have started."""
        for unit in self.folder.started_units():
            self.add(unit)

    def add(self, unit: WorkUnit) -> bool:
        """Read the outcomes of a unit; return whether the unit is complete."""
        if unit not in self.done:
            outcomes = self.folder.outcomes(unit)
            if outcomes is None:
                self.partial[unit] = self.folder.partial_outcomes(unit)
                return False
            self.done[unit] = outcomes
            self.partial.pop(unit, None)
            self._count(unit.part)
        return True

    def _count(self, part: int) -> None:
        block, seeds, successes = self._first[part]
        # without a gap, so that the failure rate does not depend on the order in which units end
        while (outcomes := self.done.get(WorkUnit(part, block))) is not None:
            block, seeds, successes = block + 1, seeds + len(outcomes), successes + _successes(outcomes)
            if seeds - successes > max(20, 3 * successes):
                every = (outcome for unit, done in self.done.items() if unit.part == part for outcome in done)
                reasons = Counter(outcome.failures[-1] for outcome in every if outcome.failures)
                found = f"{seeds - successes} of {seeds} failed, most often with {reasons.most_common(1)[0][0]}"
                where, fix = self.folder.path / UNITS / self.plan.name_of(part), "Try a smaller objects.count."
                self._failure_error = PlanError("too many seeds fail", where=where, found=found, fix=fix)
        self._first[part] = block, seeds, successes

    def check_failures(self) -> None:
        """Raise PlanError if too many seeds of a part fail."""
        if self._failure_error:
            raise self._failure_error

    def delete_damaged(self) -> dict[WorkUnit, list[int]]:
        """Delete episodes whose files have another size than when written (disk errors); return their seeds.

        After the first files were joined nothing is deleted.
        """
        damaged: dict[WorkUnit, list[int]] = {}
        if any((self.folder.path / name).exists() for name in (DATASETS, DEMOS, REPORT)):
            return damaged
        for unit, outcome in (episode for episodes in self.chosen_episodes().values() for episode in episodes):
            if self.folder.files(unit, outcome.seed).size() != outcome.size:
                damaged.setdefault(unit, []).append(outcome.seed)
        for unit, seeds in damaged.items():
            self.folder.delete_seeds(unit, seeds)
            del self.done[unit]
            self._first[unit.part] = 0, 0, 0
        return damaged

    def missing(self, shard: Shard = (0, 1)) -> Iterator[WorkUnit]:
        """Yield the units of a shard that are needed and not complete, in the order of the plan."""
        for part, config in enumerate(self.plan.parts):
            block, _, expected = self._first[part]
            while expected < config.episodes:
                unit = WorkUnit(part, block)
                if unit in self.done:
                    expected += _successes(self.done[unit])
                else:
                    expected += self.plan.block_of(part)
                    if block % shard[1] == shard[0]:
                        yield unit
                block += 1

    def chosen_episodes(self) -> dict[int, list[tuple[WorkUnit, Outcome]]]:
        """Return the episodes of each part: its first successful seeds, in order; no unit may be missing."""
        chosen: dict[int, list[tuple[WorkUnit, Outcome]]] = {}
        for part, config in enumerate(self.plan.parts):
            units = sorted(unit for unit in self.done if unit.part == part)
            episodes = [(unit, outcome) for unit in units for outcome in self.done[unit] if outcome.success]
            chosen[part] = episodes[: config.episodes]
        return chosen


def _successes(outcomes: list[Outcome]) -> int:
    return sum(outcome.success for outcome in outcomes)
