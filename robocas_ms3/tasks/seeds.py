"""Seeds and layouts of the envs of a batch."""

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

SEVERAL_ENVS_SEEDS = (0, 99)  # default range of unseeded resets of several envs
_OTHER_SEEDS = 20  # number of other seeds to try after a seed without layout
_FIRST_SEEDS = 2  # the same before any seed had a layout, so that a configuration without layouts fails early
_T = TypeVar("_T")
_log = logging.getLogger(__name__)


class _UnstableLayout(LayoutError):
    """Error: the objects of a layout are not stable in the physics engine."""


def consecutive_seeds(first: int, count: int, within: tuple[int, int] | None) -> list[int]:
    """Return consecutive seeds, which wrap around in the range ``within`` if the first one is in it."""
    if within is None or not within[0] <= first <= within[1]:
        return [first + i for i in range(count)]
    low, high = within
    return [low + (first - low + i) % (high - low + 1) for i in range(count)]


def check_reset_options(
    options: dict[str, Any] | None, num_envs: int, device: torch.device
) -> tuple[dict[str, Any], list[int]]:
    """Return options of ``BaseEnv.reset`` with ``env_idx`` as indices, and the envs to reset.

    Raises:
        RobocasError: the options have ``reset_to_env_states``.
    """
    options = dict(options or {})
    if "reset_to_env_states" in options:
        fix = "Reset with the seed of the recorded episode, then call set_state_dict."
        what = "unsupported option: a state does not contain objects, target and stages"
        raise RobocasError(what, where="reset_to_env_states", fix=fix)
    if "env_idx" in options:
        index = torch.as_tensor(options["env_idx"], device=device)
        options["env_idx"] = index.nonzero()[:, 0] if index.dtype == torch.bool else index
        if num_envs > 1:
            return options, options["env_idx"].tolist()
    return options, list(range(num_envs))


class EpisodeSeeds:
    """The objects seed and the layout seed of each env, and its layout.

    The seed with which an env was built decides objects and appearance; the seed of an episode decides the layout. A
    single env is rebuilt at each reset, so both seeds are equal. Several envs are built with consecutive seeds of their
    range and keep their objects.

    A requested seed without a layout is an error; an unseeded reset draws another seed.

    Args:
        num_envs: N.
        layouts: source of the layouts.
        seed_range: least and greatest seed of unseeded resets; default: the range of frozen layouts,
            `SEVERAL_ENVS_SEEDS` for several envs, any seed for one env.
        objects_stay: whether resets keep the objects.

    Raises:
        ConfigError: ``seed_range`` is invalid.

    Attributes:
        layout_seeds: (N,) layout seed of each env.
        objects_seeds: (N,) objects seed of each env.
        object_ids: object ids of each env.
        table: layout table of the cache, if it has one.
        initial_state_table: initial states from this table, on the envs' device.
        first_reset: whether the next reset builds the environment, so that its seed was not requested.
    """

    def __init__(
        self, num_envs: int, layouts: LayoutSource, *, seed_range: tuple[int, int] | None, objects_stay: bool
    ) -> None:
        if seed_range is not None and not 0 <= seed_range[0] <= seed_range[1]:
            raise ConfigError("invalid range of seeds", where="seeds", expected="0 <= first <= last", found=seed_range)
        if seed_range is None and isinstance(layouts, FrozenLayouts):
            seed_range = layouts.seed_range
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
        self._requested: set[int] = set()  # envs whose seeds were requested
        self._generators: Any = None  # BatchedRNG of the envs' episodes
        self._other_seeds = _FIRST_SEEDS
        self._attempts = 0  # remaining attempts of the current reset
        self._before: tuple[NDArray[np.int64], dict[int, Layout]] = (self.layout_seeds, {})  # before the current reset
        self._found: dict[int, Layout] = {}  # by env
        self._built_with: dict[int, Layout] = {}  # by seed
        self._failed: dict[SeedPair, LayoutError] = {}  # sampling again would take long

    def start_reset(self, seed: Any, envs: list[int]) -> Any:
        """Return the seeds of a reset of some envs.

        Args:
            seed: seed of each env; a single seed is the first env's, and the others get the next seeds; None: drawn.
            envs: indices of the envs.
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
        """Return whether to reset again with a drawn seed; if not, restore the seeds of before the reset."""
        if not self._attempts:
            self.layout_seeds[:], self._found = self._before
            return False
        self._attempts -= 1
        _log.log(_level(error), "no layout for the seed of this reset; drawing another seed: %s", error)
        return True

    def within_range(self, seed: Any) -> NDArray[np.int64]:
        """Return the seeds (E,) of a reset, mapped into the range if they were not requested."""
        seed = np.atleast_1d(np.asarray(seed, dtype=np.int64))
        if self._requested or self.range is None:
            return seed
        low, high = self.range
        return np.where((seed >= low) & (seed <= high), seed, low + seed % (high - low + 1))

    def set_layout_seeds(self, envs: NDArray[np.int64], seeds: NDArray[np.int64] | None, generators: Any) -> None:
        """Set the layout seeds of some envs (E,); None: draw them with the envs' generators."""
        self._generators = generators
        for i, env in enumerate(envs):
            self.layout_seeds[env] = self._draw(env) if seeds is None else seeds[i]

    def _draw(self, env: int) -> int:
        """Draw a seed of the range with an env's generator."""
        drawn = int(self._generators[env].randint(2**31))
        low, high = self.range or (0, 2**31 - 1)
        return low + drawn % (high - low + 1)

    def choose_objects(self, seeds: NDArray[np.int64], device: torch.device, *, on_gpu: bool) -> None:
        """Choose the objects of each env from its seed (N,); a seed without a layout is replaced in place."""
        self._built_with = {}
        if isinstance(self.layouts, LayoutCache) and (self._objects_stay or on_gpu):
            self.table = self.layouts.load_table("gpu" if on_gpu else "cpu")
            self._other_seeds = _OTHER_SEEDS if self.table else self._other_seeds
        self.object_ids = [self._first_possible(self._objects_of, env, seeds) for env in range(self._num_envs)]
        self.objects_seeds = np.array(seeds)
        self.initial_state_table = InitialStateTable(self.table, self.objects_seeds, device) if self.table else None

    def find_initial_states(self, envs: NDArray[np.int64], device: torch.device) -> InitialStates:
        """Return the initial states of some envs' episodes; gathered on the device if the table has them all."""
        self.forget_layouts(envs)
        if self.initial_state_table is None:
            return InitialStates.from_layouts([self.layout(env) for env in envs.tolist()], device)
        for env in envs[~self.initial_state_table.is_usable(envs, self.layout_seeds[envs])].tolist():
            self.layout(env)  # may draw another seed that is in the table
        tabled = self.initial_state_table.is_usable(envs, self.layout_seeds[envs])
        found = self.initial_state_table.gather(envs[tabled], self.layout_seeds[envs[tabled]])
        if tabled.all():
            return found
        others = [self.layout(env) for env in envs[~tabled].tolist()]
        return found.with_rows(tabled, InitialStates.from_layouts(others, device))

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
                where, fix = f"objects seed {seed}", "Use another seed."
                raise _UnstableLayout("no stable layout of these objects", where=where, fix=fix)
            return tabled
        if seed not in self._built_with:
            self._built_with[seed] = self._layout((seed, seed))
        return self._built_with[seed].object_ids

    def _layout(self, pair: SeedPair) -> Layout:
        if pair[0] == pair[1] and pair[0] in self._built_with:
            return self._built_with[pair[0]]
        if self.table is not None:
            if self.table.status(pair) == LayoutStatus.UNSTABLE:
                where = f"objects seed {pair[0]}, seed {pair[1]}"
                what, fix = "the objects of this layout are not stable in this physics engine", "Use another seed."
                raise _UnstableLayout(what, where=where, fix=fix)
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
        """Return ``make`` of an env's seed; an unrequested seed without layout is replaced by a drawn one."""
        for _ in range(self._other_seeds):
            try:
                return make(int(seeds[env]))
            except LayoutError as error:
                if env in self._requested or self._num_envs == 1:  # a single env resets again, with other objects
                    raise
                message = "env %d: no layout for seed %d; drawing another seed: %s"
                _log.log(_level(error), message, env, seeds[env], error)
                seeds[env] = self._draw(env)
        return make(int(seeds[env]))


def _level(error: LayoutError) -> int:
    """Return the log level for a replaced seed; unstable layouts were reported by their check."""
    return logging.DEBUG if isinstance(error, _UnstableLayout) else logging.WARNING
