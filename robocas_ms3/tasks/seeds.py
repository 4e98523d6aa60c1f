"""Objects seeds, layout seeds and layouts of the envs of a batch."""

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
_OTHER_SEEDS = 20  # number of other seeds to draw after a seed without a layout
_FIRST_SEEDS = 2  # number of other seeds while none has had a layout: a configuration without layouts fails early
_T = TypeVar("_T")
_log = logging.getLogger(__name__)


class _UnstableLayoutError(LayoutError):
    """Raised if the objects of a layout are not stable in the physics engine."""


def consecutive_seeds(first: int, count: int, seed_range: tuple[int, int] | None) -> list[int]:
    """Return consecutive seeds, which wrap around at the end of ``seed_range`` if ``first`` is in it.

    Args:
        first: first seed.
        count: number of seeds.
        seed_range: least and greatest seed of the range; None: no range.
    """
    if seed_range is None or not seed_range[0] <= first <= seed_range[1]:
        return [first + i for i in range(count)]
    low, high = seed_range
    return [low + (first - low + i) % (high - low + 1) for i in range(count)]


def parse_reset_options(
    options: dict[str, Any] | None, num_envs: int, device: torch.device
) -> tuple[dict[str, Any], list[int]]:
    """Return reset options in which ``env_idx`` has indices, and the indices of the envs to reset.

    Raises:
        RobocasError: the options contain ``reset_to_env_states``.
    """
    options = dict(options or {})
    if "reset_to_env_states" in options:
        fix = "Reset with the seed of the recorded episode, then call set_state_dict."
        what = "unsupported option: a state does not contain the objects, the target and the stages of its scene"
        raise RobocasError(what, where="reset_to_env_states", fix=fix)
    if "env_idx" in options:
        index = torch.as_tensor(options["env_idx"], device=device)
        options["env_idx"] = index.nonzero()[:, 0] if index.dtype == torch.bool else index
        if num_envs > 1:
            return options, options["env_idx"].tolist()
    return options, list(range(num_envs))


class EpisodeSeeds:
    """Objects seed, layout seed and layout of each env.

    The objects seed is the seed with which an env was built; it decides objects and appearance. The layout seed is the
    seed of the episode; it decides the layout. A single env is rebuilt at each reset, so both seeds are equal. Several
    envs are built with consecutive seeds of their range and keep their objects.

    If a requested seed has no layout, the reset fails. A reset without a seed draws seeds until one has a layout.

    Args:
        num_envs: N.
        layouts: source of the layouts.
        seed_range: least and greatest seed of resets without a seed. Default: the seeds of frozen layouts; otherwise
            `SEVERAL_ENVS_SEEDS` for several envs, and any seed for one env.
        objects_stay: whether resets keep the objects.

    Raises:
        ConfigError: ``seed_range`` is invalid.

    Attributes:
        layout_seeds: (N,) layout seed of each env.
        objects_seeds: (N,) objects seed of each env.
        object_ids: ids of the objects of each env, by object slot.
        range: least and greatest seed of resets without a seed; None: any seed.
        table: layout table of the cache; None if the cache has no table.
        initial_state_table: initial states from this table, on the device of the envs.
        first_reset: whether the next reset is the one that builds the environment; its seed was not requested.
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
        self._failed: dict[SeedPair, LayoutError] = {}  # failed seed pairs, because sampling them again would take long

    def start_reset(self, seed: Any, envs: list[int]) -> Any:
        """Start a reset of some envs, and return its seed in the form of ``BaseEnv.reset``.

        Args:
            seed: seed of each env. A single seed is for the first env; the other envs get the next seeds. None: draw.
            envs: indices of the envs.
        """
        first, self.first_reset = self.first_reset, False
        seeded = seed is not None and not first
        self._requested = set(envs) if seeded else set()
        self._before = self.layout_seeds.copy(), dict(self._found)
        self._attempts = self._other_seeds if self._num_envs == 1 and not seeded else 0
        if self._num_envs == 1:
            return seed
        seed_range = self.range or SEVERAL_ENVS_SEEDS
        if first:
            return consecutive_seeds(seed_range[0], self._num_envs, seed_range)
        if seed is not None and np.ndim(seed) == 0:
            self._requested = set(envs[:1])
            return consecutive_seeds(int(np.asarray(seed)), len(envs), seed_range)
        return seed

    def retry_reset(self, error: LayoutError) -> bool:
        """Return whether to reset again with another seed; if not, restore the seeds before this reset.

        Args:
            error: error of the failed reset.
        """
        if not self._attempts:
            self.layout_seeds[:], self._found = self._before
            return False
        self._attempts -= 1
        _log.log(_log_level(error), "no layout for the seed of this reset; drawing another seed: %s", error)
        return True

    def map_to_range(self, seed: Any) -> NDArray[np.int64]:
        """Return the seeds (E,) of a reset; seeds that were not requested are mapped into the range."""
        seed = np.atleast_1d(np.asarray(seed, dtype=np.int64))
        if self._requested or self.range is None:
            return seed
        low, high = self.range
        return np.where((seed >= low) & (seed <= high), seed, low + seed % (high - low + 1))

    def set_layout_seeds(self, envs: NDArray[np.int64], seeds: NDArray[np.int64] | None, generators: Any) -> None:
        """Set the layout seeds of some envs (E,).

        Args:
            envs: (E,) indices of the envs.
            seeds: (E,) layout seeds; None: draw them.
            generators: ``BatchedRNG`` with one random generator per env.
        """
        self._generators = generators
        for i, env in enumerate(envs):
            self.layout_seeds[env] = self._draw_seed(env) if seeds is None else seeds[i]

    def _draw_seed(self, env: int) -> int:
        """Draw a seed from the range with the random generator of an env."""
        drawn = int(self._generators[env].randint(2**31))
        low, high = self.range or (0, 2**31 - 1)
        return low + drawn % (high - low + 1)

    def choose_objects(self, seeds: NDArray[np.int64], device: torch.device, *, on_gpu: bool) -> None:
        """Choose the objects of each env from its seed.

        Args:
            seeds: (N,) objects seeds. A seed without a layout that was not requested is replaced in this array.
            device: device of the envs.
            on_gpu: whether PhysX runs on a GPU.
        """
        self._built_with = {}
        if isinstance(self.layouts, LayoutCache) and (self._objects_stay or on_gpu):
            self.table = self.layouts.load_table("gpu" if on_gpu else "cpu")
            self._other_seeds = _OTHER_SEEDS if self.table else self._other_seeds
        self.object_ids = [
            self._call_with_usable_seed(self._find_object_ids, env, seeds) for env in range(self._num_envs)
        ]
        self.objects_seeds = np.array(seeds)
        self.initial_state_table = InitialStateTable(self.table, self.objects_seeds, device) if self.table else None

    def find_initial_states(self, envs: NDArray[np.int64], device: torch.device) -> InitialStates:
        """Return the initial states of envs (E,) for their layout seeds.

        They are selected on the device from the layout table if it has them; other layouts come from the source.
        """
        self.forget_layouts(envs)
        if self.initial_state_table is None:
            return InitialStates.from_layouts([self.layout(env) for env in envs.tolist()], device)
        for env in envs[~self.initial_state_table.has_usable_layout(envs, self.layout_seeds[envs])].tolist():
            self.layout(env)  # may draw another seed that is in the table
        tabled = self.initial_state_table.has_usable_layout(envs, self.layout_seeds[envs])
        found = self.initial_state_table.gather_states(envs[tabled], self.layout_seeds[envs[tabled]])
        if tabled.all():
            return found
        others = [self.layout(env) for env in envs[~tabled].tolist()]
        return found.interleave(tabled, InitialStates.from_layouts(others, device))

    def forget_layouts(self, envs: NDArray[np.int64]) -> None:
        """Forget the layouts of the last episodes of envs (E,)."""
        for env in envs.tolist():
            self._found.pop(env, None)

    def layout(self, env: int) -> Layout:
        """Return the layout of an env.

        If its seed has no layout and was not requested, another layout seed is drawn.
        """
        if env not in self._found:
            objects_seed = int(self.objects_seeds[env])
            self._found[env] = self._call_with_usable_seed(
                lambda seed: self._find_layout((objects_seed, seed)), env, self.layout_seeds
            )
        return self._found[env]

    def _find_object_ids(self, seed: int) -> ObjectIds:
        if self.table is not None and (tabled := self.table.object_ids(seed)) is not None:
            if not self.table.has_usable_layout(seed):
                where, fix = f"objects seed {seed}", "Use another objects seed."
                what = "the layout table has no stable layout with these objects"
                raise _UnstableLayoutError(what, where=where, fix=fix)
            return tabled
        if seed not in self._built_with:
            self._built_with[seed] = self._find_layout((seed, seed))
        return self._built_with[seed].object_ids

    def _find_layout(self, pair: SeedPair) -> Layout:
        if pair[0] == pair[1] and pair[0] in self._built_with:
            return self._built_with[pair[0]]
        if self.table is not None:
            if self.table.status(pair) == LayoutStatus.UNSTABLE:
                where = f"objects seed {pair[0]}, seed {pair[1]}"
                what = "the objects of this layout are not stable in this physics engine"
                fix = "Reset with another seed."
                raise _UnstableLayoutError(what, where=where, fix=fix)
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

    def _call_with_usable_seed(self, make: Callable[[int], _T], env: int, seeds: NDArray[np.int64]) -> _T:
        """Return ``make(seed)`` for the seed of an env; draw other seeds while a seed has no layout.

        Args:
            make: function of a seed; raises LayoutError if the seed has no layout.
            env: index of the env.
            seeds: (N,) seed of each env; a replaced seed is written to this array.

        Raises:
            LayoutError: the seed was requested, or no drawn seed has a layout.
        """
        for _ in range(self._other_seeds):
            try:
                return make(int(seeds[env]))
            except LayoutError as error:
                if env in self._requested or self._num_envs == 1:  # a single env resets again, with other objects
                    raise
                message = "env %d: no layout for seed %d; drawing another seed: %s"
                _log.log(_log_level(error), message, env, seeds[env], error)
                seeds[env] = self._draw_seed(env)
        return make(int(seeds[env]))


def _log_level(error: LayoutError) -> int:
    """Return the log level for a replaced seed: DEBUG if its layout is known to be unstable."""
    return logging.DEBUG if isinstance(error, _UnstableLayoutError) else logging.WARNING
