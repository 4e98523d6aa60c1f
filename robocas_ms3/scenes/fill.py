"""Fill a bank of layouts, with all cores."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from functools import partial

from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.workers import FunctionWorker, WorkerPool
from robocas_ms3.scenes.bank import LayoutBank
from robocas_ms3.scenes.table import Pair


def pairs_of(seeds: Iterable[int], objects: Iterable[int] | None = None) -> list[Pair]:
    """Pairs of seeds whose layouts environments ask for.

    Args:
        seeds: of layouts.
        objects: seeds of objects, as several envs have them: each goes with all ``seeds``, and first with itself, which
            is the layout its env is built with. None: as one env has it, objects and layout of one seed.
    """
    if objects is None:
        return [(seed, seed) for seed in seeds]
    seeds = list(seeds)
    return [(chosen, seed) for chosen in objects for seed in dict.fromkeys([chosen, *seeds])]


def fill(bank: LayoutBank, pairs: Iterable[Pair], jobs: int = 1) -> Generator[tuple[Pair, str], None, None]:
    """Make the layouts that a bank lacks.

    Args:
        bank: to fill.
        pairs: of seeds, those wanted.
        jobs: processes; the outcome does not depend on it. Objects' own layouts come first, which others begin with.

    Yields:
        Each pair when it is done, in any order, and why there is no layout, or an empty text.
    """
    missing = bank.missing(pairs)
    firsts = [pair for pair in missing if pair[0] == pair[1]]
    without: dict[int, str] = {}  # objects seeds without objects, and why
    workers = jobs if min(jobs, len(missing)) > 1 else 0
    with WorkerPool(partial(FunctionWorker, partial(_make, bank)), workers, on_crash=_crashed) as pool:
        for pair, problem in pool.map(firsts, ordered=False):
            if problem:
                without[pair[0]] = problem
            yield pair, problem
        others = [pair for pair in missing if pair[0] != pair[1]]
        yield from ((pair, without[pair[0]]) for pair in others if pair[0] in without)
        yield from pool.map((pair for pair in others if pair[0] not in without), ordered=False)


def _make(bank: LayoutBank, pair: Pair) -> tuple[Pair, str]:
    try:
        bank.get(*pair)
    except LayoutError as error:
        return pair, str(error)
    return pair, ""


def _crashed(pair: Pair, why: str) -> tuple[Pair, str]:
    return pair, f"the process that made it died ({why}); is memory short?"
