"""Find the work units of a plan that are complete, and those that are still needed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from robocas_ms3.core.errors import PlanError
from robocas_ms3.plans.folder import DATASETS, DEMOS, REPORT, UNITS, Outcome, PlanFolder, WorkUnit

Shard = tuple[int, int]
"""K, N: shard K of N runs the work units whose block number is K modulo N."""


class PlanProgress:
    """Complete, started and missing work units of a plan, read from its folder.

    A plan part needs its work units in order, until their successful seeds reach its number of episodes. For this
    count, all seeds of a work unit that is not complete count as successful. So the work units that are needed in the
    end depend only on the plan.

    Attributes:
        done: outcomes of each complete work unit.
        partial: outcomes of each work unit that has started and is not complete.
    """

    def __init__(self, folder: PlanFolder) -> None:
        self.folder, self.plan = folder, folder.plan
        self.done: dict[WorkUnit, list[Outcome]] = {}
        self.partial: dict[WorkUnit, list[Outcome]] = {}
        # per plan part: number of work units, seeds and successes before the first work unit that is not complete
        self._prefix = [(0, 0, 0)] * len(self.plan.parts)
        self._failure_error: PlanError | None = None
        self.read_outcomes()

    def read_outcomes(self) -> None:
        """Read the outcomes of all work units that have started."""
        for unit in self.folder.started_units():
            self.read_unit(unit)

    def read_unit(self, unit: WorkUnit) -> bool:
        """Read the outcomes of a work unit; return whether the work unit is complete."""
        if unit not in self.done:
            outcomes = self.folder.read_outcomes(unit)
            if outcomes is None:
                self.partial[unit] = self.folder.read_partial_outcomes(unit)
                return False
            self.done[unit] = outcomes
            self.partial.pop(unit, None)
            self._extend_prefix(unit.part)
        return True

    def _extend_prefix(self, part: int) -> None:
        block, seeds, successes = self._prefix[part]
        # without a gap, so that the failure rate does not depend on the order in which work units end
        while (outcomes := self.done.get(WorkUnit(part, block))) is not None:
            block, seeds, successes = block + 1, seeds + len(outcomes), successes + _successes(outcomes)
            if seeds - successes > max(20, 3 * successes):
                every = (outcome for unit, done in self.done.items() if unit.part == part for outcome in done)
                reasons = Counter(outcome.failures[-1] for outcome in every if outcome.failures)
                found = f"{seeds - successes} of {seeds} skipped, most often with {reasons.most_common(1)[0][0]}"
                where, fix = (
                    self.folder.path / UNITS / self.plan.part_name(part),
                    "Fewer objects (objects.count) may help.",
                )
                self._failure_error = PlanError("too many seeds are skipped", where=where, found=found, fix=fix)
        self._prefix[part] = block, seeds, successes

    def check_skipped_seeds(self) -> None:
        """Raise PlanError if a plan part has more than 20 skipped seeds, and more than three times its successes."""
        if self._failure_error:
            raise self._failure_error

    def delete_damaged_episodes(self) -> dict[WorkUnit, list[int]]:
        """Delete episodes whose files changed their size after writing (disk errors).

        Nothing is deleted once the first files are joined.

        Returns:
            The deleted seeds of each work unit.
        """
        damaged: dict[WorkUnit, list[int]] = {}
        if any((self.folder.path / name).exists() for name in (DATASETS, DEMOS, REPORT)):
            return damaged
        for unit, outcome in (episode for episodes in self.chosen_episodes().values() for episode in episodes):
            if self.folder.seed_files(unit, outcome.seed).size() != outcome.size:
                damaged.setdefault(unit, []).append(outcome.seed)
        for unit, seeds in damaged.items():
            self.folder.delete_seeds(unit, seeds)
            del self.done[unit]
            self._prefix[unit.part] = 0, 0, 0
        return damaged

    def missing_units(self, shard: Shard = (0, 1)) -> Iterator[WorkUnit]:
        """Yield the work units of a shard that are needed and not complete, in the order of the plan."""
        for part, config in enumerate(self.plan.parts):
            block, _, expected = self._prefix[part]
            while expected < config.episodes:
                unit = WorkUnit(part, block)
                if unit in self.done:
                    expected += _successes(self.done[unit])
                else:
                    expected += self.plan.seeds_per_unit(part)
                    if block % shard[1] == shard[0]:
                        yield unit
                block += 1

    def chosen_episodes(self) -> dict[int, list[tuple[WorkUnit, Outcome]]]:
        """Return the episodes to join for each plan part: its first successful seeds, in order.

        No work unit may be missing.
        """
        chosen: dict[int, list[tuple[WorkUnit, Outcome]]] = {}
        for part, config in enumerate(self.plan.parts):
            units = sorted(unit for unit in self.done if unit.part == part)
            episodes = [(unit, outcome) for unit in units for outcome in self.done[unit] if outcome.success]
            chosen[part] = episodes[: config.episodes]
        return chosen


def _successes(outcomes: list[Outcome]) -> int:
    return sum(outcome.success for outcome in outcomes)
