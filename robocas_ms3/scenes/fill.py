"""Fill a bank of layouts, with all cores."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager

from robocas_ms3.errors import LayoutError
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
    with _pool(bank, jobs, len(missing)) as made:
        for pair, problem in made(firsts):
            if problem:
                without[pair[0]] = problem
            yield pair, problem
        others = [pair for pair in missing if pair[0] != pair[1]]
        yield from ((pair, without[pair[0]]) for pair in others if pair[0] in without)
        yield from made([pair for pair in others if pair[0] not in without])


@contextmanager
def _pool(bank: LayoutBank, jobs: int, count: int) -> Generator[Callable[[list[Pair]], Iterator[tuple[Pair, str]]]]:
    """Gives a function that makes layouts, each pair with why there is none."""
    if jobs <= 1 or count < 2:
        yield lambda pairs: ((pair, _make(bank, pair)) for pair in pairs)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(jobs, count), context, _start_worker, (bank,)) as pool:
        try:
            yield lambda pairs: (
                done.result() for done in as_completed([pool.submit(_make_in_worker, pair) for pair in pairs])
            )
        except BaseException:  # an interruption too: only what is under way is waited for
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _make(bank: LayoutBank, pair: Pair) -> str:
    try:
        bank.get(*pair)
    except LayoutError as error:
        return str(error)
    return ""


_worker_bank: list[LayoutBank] = []


def _start_worker(bank: LayoutBank) -> None:
    _worker_bank.append(bank)


def _make_in_worker(pair: Pair) -> tuple[Pair, str]:
    return pair, _make(_worker_bank[0], pair)
