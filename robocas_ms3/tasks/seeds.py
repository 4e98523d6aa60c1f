"""Seeds of the envs of a batch, and the layouts that follow from them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.core.errors import ConfigError, LayoutError, RobocasError
from robocas_ms3.scenes.cache import LayoutCache
from robocas_ms3.scenes.layout import Layout, LayoutSource, ObjectIds
from robocas_ms3.scenes.layout_table import FrozenLayouts, LayoutStatus, LayoutTable, SeedPair
from robocas_ms3.tasks.initial_states import InitialStates, InitialStateTable

SEVERAL_ENVS_SEEDS = (0, 99)  # least and greatest seed of several envs' unseeded resets
_OTHER_SEEDS = 20  # tried where a seed has no layout
_FIRST_SEEDS = 2  # tried before any seed had one, so that a configuration without layouts fails early
_T = TypeVar("_T")
_log = logging.getLogger(__name__)


class _UnstableLayout(LayoutError):
    """The engine moves the objects of a layout."""


def consecutive_seeds(first: int, count: int, within: tuple[int, int] | None) -> list[int]:
    """Return consecutive seeds. A first seed of the range ``within`` makes them wrap around in this range."""
    if within is None or not within[0] <= first <= within[1]:
        return [first + i for i in range(count)]
    low, high = within
    return [low + (first - low + i) % (high - low + 1) for i in range(count)]


def check_reset_options(
    options: dict[str, Any] | None, num_envs: int, device: torch.device
) -> tuple[dict[str, Any], list[int]]:
    """Return options of ``BaseEnv.reset``, ``env_idx`` as indices, and the numbers of the envs that are reset.

    Raises:
        RobocasError: ``reset_to_env_states`` was given.
    """
    options = dict(options or {})
    if "reset_to_env_states" in options:
        fix = "Reset with the seed of the recorded episode, then call set_state_dict."
        raise RobocasError("a state lacks objects, target and stages", where="reset_to_env_states", fix=fix)
    if "env_idx" in options:
        index = torch.as_tensor(options["env_idx"], device=device)
        options["env_idx"] = index.nonzero()[:, 0] if index.dtype == torch.bool else index
        if num_envs > 1:
            return options, options["env_idx"].tolist()
    return options, list(range(num_envs))


class EpisodeSeeds:
    """The seed of each env's objects and that of its layout.

    Objects and looks follow from the seed that an env was built with, the layout from the seed of its episode. A single
    env is rebuilt at each reset, so that both are the same. Several envs are built with consecutive seeds of their
    range and keep their objects.

    A requested seed without a layout is an error; an unseeded reset draws another seed.

    Args:
        num_envs: N.
        layouts: where layouts come from.
        seed_range: least and greatest seed of unseeded resets; default: that of frozen layouts, `SEVERAL_ENVS_SEEDS`
            for several envs, any seed for one.
        objects_stay: whether resets keep the objects.

    Raises:
        ConfigError: ``seed_range`` is invalid.

    Attributes:
        layout_seeds: (N,) seed of each env's layout.
        objects_seeds: (N,) seed of each env's objects.
        object_ids: of each env.
        table: all layouts of the cache, if it has a table.
        tabled: starts gathered from that table.
        first_reset: whether the next reset is that of making the environment, whose seed nobody asked for.
    """

    def __init__(
        self, num_envs: int, layouts: LayoutSource, *, seed_range: tuple[int, int] | None, objects_stay: bool
    ) -> None:
        if seed_range is not None and not 0 <= seed_range[0] <= seed_range[1]:
            raise ConfigError("invalid range of seeds", where="seeds", expected="0 <= first <= last", found=seed_range)
        if seed_range is None and isinstance(layouts, FrozenLayouts):
            seed_range = layouts.seeds
        self.range = seed_range or (SEVERAL_ENVS_SEEDS if num_envs > 1 else None)
        self.layouts = layouts
        self.layout_seeds = np.zeros(num_envs, dtype=np.int64)
        self.objects_seeds = np.zeros(num_envs, dtype=np.int64)
        self.object_ids: list[ObjectIds] = []
        self.table: LayoutTable | None = None
        self.initial_state_table: InitialStateTable | None = None
        self._num_envs = num_envs
        self._objects_stay = objects_stay
        self.first_reset = True
        self._requested: set[int] = set()  # envs whose seeds were asked for
        self._generators: Any = None  # a BatchedRNG, of the envs' episodes
        self._other_seeds = _FIRST_SEEDS
        self._attempts = 0  # left to the present reset
        self._before: tuple[NDArray[np.int64], dict[int, Layout]] = (self.layout_seeds, {})  # the present reset
        self._found: dict[int, Layout] = {}  # by env
        self._built_with: dict[int, Layout] = {}  # by seed
        self._failed: dict[SeedPair, LayoutError] = {}  # finding out takes long

    def start_reset(self, seed: Any, envs: list[int]) -> Any:
        """Return the seeds of a reset of some envs.

        Args:
            seed: of each env; a single one is the first env's, and the others take the seeds after it; or None.
            envs: their numbers.
        """
        first, self.first_reset = self.first_reset, False
        seeded = seed is not None and not first
        self._requested = set(envs) if seeded else set()
        self._before = self.layout_seeds.copy(), dict(self._found)
        self._attempts = self._other_seeds if self._num_envs == 1 and not seeded else 0
        if self._num_envs == 1:
            return seed
        within = self.range or SEVERAL_ENVS_SEEDS
        if first:
            return consecutive_seeds(within[0], self._num_envs, within)
        if seed is not None and np.ndim(seed) == 0:
            self._requested = set(envs[:1])
            return consecutive_seeds(int(np.asarray(seed)), len(envs), within)
        return seed

    def retry_reset(self, error: LayoutError) -> bool:
        """Return whether to reset again, with a drawn seed; if not, all seeds are as they were before the reset."""
        if not self._attempts:
            self.layout_seeds[:], self._found = self._before
            return False
        self._attempts -= 1
        _log.log(_level(error), "no layout for the seed of this reset, another is drawn: %s", error)
        return True

    def within_range(self, seed: Any) -> NDArray[np.int64]:
        """Return the seeds (E,) of a reset, moved into the range if nobody asked for them."""
        seed = np.atleast_1d(np.asarray(seed, dtype=np.int64))
        if self._requested or self.range is None:
            return seed
        low, high = self.range
        return np.where((seed >= low) & (seed <= high), seed, low + seed % (high - low + 1))

    def set_layout_seeds(self, envs: NDArray[np.int64], seeds: NDArray[np.int64] | None, generators: Any) -> None:
        """Set the layout seeds of some envs (E,); None: draw each with its env's generator of a ``BatchedRNG``."""
        self._generators = generators
        for i, env in enumerate(envs):
            self.layout_seeds[env] = self._draw(env) if seeds is None else seeds[i]

    def _draw(self, env: int) -> int:
        """Draw a seed of the range with an env's generator."""
        drawn = int(self._generators[env].randint(2**31))
        low, high = self.range or (0, 2**31 - 1)
        return low + drawn % (high - low + 1)

    def choose_objects(self, seeds: NDArray[np.int64], device: torch.device, *, on_gpu: bool) -> None:
        """Choose the objects that each env is built with from its seed (N,), which changes if it has no layout."""
        self._built_with = {}
        if isinstance(self.layouts, LayoutCache) and (self._objects_stay or on_gpu):
            self.table = self.layouts.table("gpu" if on_gpu else "cpu")
            self._other_seeds = _OTHER_SEEDS if self.table else self._other_seeds
        self.object_ids = [self._first_possible(self._objects_of, env, seeds) for env in range(self._num_envs)]
        self.objects_seeds = np.array(seeds)
        self.initial_state_table = InitialStateTable(self.table, self.objects_seeds, device) if self.table else None

    def find_initial_states(self, envs: NDArray[np.int64], device: torch.device) -> InitialStates:
        """Return where some envs' episodes start; gathered on their device if the cache's table holds them all."""
        self.forget_layouts(envs)
        if self.initial_state_table is None:
            return InitialStates.of([self.layout(env) for env in envs.tolist()], device)
        for env in envs[~self.initial_state_table.is_usable(envs, self.layout_seeds[envs])].tolist():
            self.layout(env)  # may draw another seed, which the table holds
        tabled = self.initial_state_table.is_usable(envs, self.layout_seeds[envs])
        found = self.initial_state_table.gather(envs[tabled], self.layout_seeds[envs[tabled]])
        if tabled.all():
            return found
        others = [self.layout(env) for env in envs[~tabled].tolist()]
        return found.with_rows(tabled, InitialStates.of(others, device))

    def forget_layouts(self, envs: NDArray[np.int64]) -> None:
        for env in envs.tolist():
            self._found.pop(env, None)

    def layout(self, env: int) -> Layout:
        if env not in self._found:
            objects_seed = int(self.objects_seeds[env])
            self._found[env] = self._first_possible(
                lambda seed: self._layout((objects_seed, seed)), env, self.layout_seeds
            )
        return self._found[env]

    def _objects_of(self, seed: int) -> ObjectIds:
        if self.table is not None and (tabled := self.table.object_ids(seed)) is not None:
            if not self.table.has_usable_layout(seed):
                where, fix = f"objects seed {seed}", "Take another seed."
                raise _UnstableLayout("no layout of these objects stays", where=where, fix=fix)
            return tabled
        if seed not in self._built_with:
            self._built_with[seed] = self._layout((seed, seed))
        return self._built_with[seed].object_ids

    def _layout(self, pair: SeedPair) -> Layout:
        if pair[0] == pair[1] and pair[0] in self._built_with:
            return self._built_with[pair[0]]
        if self.table is not None:
            if self.table.state(pair) == LayoutStatus.UNSTABLE:
                where = f"objects seed {pair[0]}, seed {pair[1]}"
                fix = "Take another seed."
                raise _UnstableLayout("objects move as soon as this engine runs", where=where, fix=fix)
            if (tabled := self.table.layout(pair)) is not None:
                return tabled
        if pair in self._failed:
            raise self._failed[pair].with_traceback(None)
        try:
            layout = self.layouts(*pair)
        except LayoutError as error:
            self._failed[pair] = error
            raise
        self._other_seeds = _OTHER_SEEDS
        return layout

    def _first_possible(self, make: Callable[[int], _T], env: int, seeds: NDArray[np.int64]) -> _T:
        """Return ``make`` of an env's seed. A seed without layout that nobody asked for is replaced by a drawn one."""
        for _ in range(self._other_seeds):
            try:
                return make(int(seeds[env]))
            except LayoutError as error:
                if env in self._requested or self._num_envs == 1:  # a single env starts over with other objects
                    raise
                _log.log(_level(error), "env %d: no layout for seed %d, another is drawn: %s", env, seeds[env], error)
                seeds[env] = self._draw(env)
        return make(int(seeds[env]))


def _level(error: LayoutError) -> int:
    """Return the level of the message that another seed is drawn; unstable layouts were reported when tried."""
    return logging.DEBUG if isinstance(error, _UnstableLayout) else logging.WARNING
