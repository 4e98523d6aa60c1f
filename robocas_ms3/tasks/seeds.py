"""Which seed an env's objects, layout and looks come from, and what happens where a seed has no layout."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.utils.randomization.batched_rng import BatchedRNG
from numpy.typing import NDArray

from robocas_ms3.core.errors import ConfigError, LayoutError, RobocasError
from robocas_ms3.scenes.bank import LayoutBank
from robocas_ms3.scenes.frozen import FrozenLayouts
from robocas_ms3.scenes.layout import Layout, ObjectIds
from robocas_ms3.scenes.source import LayoutSource
from robocas_ms3.scenes.table import LayoutTable, Pair, State
from robocas_ms3.tasks.starts import Starts, TabledStarts

SEVERAL_ENVS_SEEDS = (0, 99)  # least and greatest seed of several envs' unseeded resets
_OTHER_SEEDS = 20  # tried where a seed has no layout
_FIRST_SEEDS = 2  # the same before any had one: that a configuration can't be laid out should not take long to find
_T = TypeVar("_T")
_log = logging.getLogger(__name__)


class _Moves(LayoutError):
    """The engine does not leave the objects where a layout has them."""


def _level(error: LayoutError) -> int:
    """Of a message that another seed is drawn: how many layouts move was told when they were tried."""
    return logging.DEBUG if isinstance(error, _Moves) else logging.WARNING


def following_seeds(first: int, count: int, within: tuple[int, int] | None) -> list[int]:
    """Seeds one after the other; where the first is of the range ``within``, its least comes after its greatest."""
    if within is None or not within[0] <= first <= within[1]:
        return [first + i for i in range(count)]
    low, high = within
    return [low + (first - low + i) % (high - low + 1) for i in range(count)]


class SeededEnv(BaseEnv):
    """Environment whose episodes follow from seeds, each env's from its own.

    An env's objects and looks come from the seed it was built with, its layout from the seed of its episode. One env
    is built anew at each reset, so that both are the same. Several envs are built with the seeds of their range, one
    after the other, and keep their objects.

    A seed without a layout is an error where it was asked for; a reset without a seed goes on to another one.

    Args:
        layouts: where layouts come from.
        seeds: least and greatest seed of resets without one; default: any, for several envs `SEVERAL_ENVS_SEEDS`; of
            frozen layouts theirs.
        num_envs: see ``BaseEnv``.
        reconfiguration_freq: see ``BaseEnv``; default 1 for one env, 0 for several.
        kwargs: passed to ``BaseEnv``.

    Raises:
        ConfigError: ``seeds`` is no range.
    """

    def __init__(
        self,
        *args: Any,
        layouts: LayoutSource,
        seeds: tuple[int, int] | None,
        num_envs: int,
        reconfiguration_freq: int | None,
        **kwargs: Any,
    ) -> None:
        if seeds is not None and not 0 <= seeds[0] <= seeds[1]:
            raise ConfigError("seeds are a range", expected="0 <= first <= last", found=seeds)
        self._layouts = layouts
        self._table: LayoutTable | None = None
        self._tabled: TabledStarts | None = None
        self._found: dict[int, Layout] = {}  # of envs
        self._own: dict[int, Layout] = {}  # of the seeds that envs are built with
        self._object_ids: list[ObjectIds] = []  # of each env
        if seeds is None and isinstance(layouts, FrozenLayouts):
            seeds = layouts.seeds
        self._seed_range = seeds or (SEVERAL_ENVS_SEEDS if num_envs > 1 else None)
        self._resets_seeded = False
        self._asked_for: set[int] = set()  # envs whose seeds were asked for
        self._layout_seeds = np.zeros(num_envs, dtype=np.int64)
        self._objects_seeds = np.zeros(num_envs, dtype=np.int64)
        if reconfiguration_freq is None:
            reconfiguration_freq = 1 if num_envs == 1 else 0
        self._objects_stay = reconfiguration_freq == 0
        self._failed: dict[Pair, LayoutError] = {}
        self._other_seeds = _FIRST_SEEDS
        self._made = False
        super().__init__(*args, num_envs=num_envs, reconfiguration_freq=reconfiguration_freq, **kwargs)
        self._made = True

    def reset(self, seed: int | list[int] | None = None, options: dict | None = None) -> tuple[Any, dict]:
        """Reset; see ``BaseEnv``. The same seed gives the same layout, whichever envs are reset.

        Args:
            seed: of each env. With several envs a single one is the first env's, and the others take those after it,
                within the range if it is of the range.
            options: of ``BaseEnv``, but not ``reset_to_env_states``.

        Raises:
            LayoutError: there is no layout for a seed that was asked for, or for many that were drawn.
            RobocasError: ``reset_to_env_states`` was given.
        """
        if options and "reset_to_env_states" in options:
            fix = "Reset with the seed of the recorded episode, then call set_state_dict."
            raise RobocasError("a state lacks objects, target and stages", where="reset_to_env_states", fix=fix)
        if options and "env_idx" in options:  # a list, or an array as of ManiSkill's wrapper for Stable-Baselines3
            index = options["env_idx"]
            index = index if isinstance(index, torch.Tensor) else torch.as_tensor(index, device=self.device)
            options = {**options, "env_idx": index.nonzero()[:, 0] if index.dtype == torch.bool else index}
        self._resets_seeded = self._made and seed is not None
        if self.num_envs > 1:
            envs = options["env_idx"].tolist() if options and "env_idx" in options else range(self.num_envs)
            self._asked_for = set(envs) if self._resets_seeded else set()
            within = self._seed_range or SEVERAL_ENVS_SEEDS
            if not self._made:
                seed = following_seeds(within[0], self.num_envs, within)
            elif seed is not None and np.ndim(seed) == 0:
                self._asked_for = set(list(envs)[:1])
                seed = following_seeds(int(np.asarray(seed)), len(envs), within)  # ManiSkill's own would lie outside
        before = self._layout_seeds.copy(), dict(self._found)
        try:
            return super().reset(seed, options) if self.num_envs > 1 else self._reset_one(seed, options)
        except LayoutError:  # the envs are where they were
            self._layout_seeds[:], self._found = before
            raise

    def _reset_one(self, seed: int | list[int] | None, options: dict | None) -> tuple[Any, dict]:
        """Reset the only env; without a seed, one without a layout gives way to another."""
        for _ in range(self._other_seeds):
            try:
                return super().reset(seed, options)
            except LayoutError as error:
                if self._resets_seeded:
                    raise
                _log.log(_level(error), "no layout for the seed of this reset, another is drawn: %s", error)
                seed = None
        return super().reset(seed, options)

    def _set_episode_rng(self, seed: Any, env_idx: torch.Tensor) -> None:
        """Seed the episodes of some envs and no others; ManiSkill's own forgets the others' seeds."""
        index = env_idx.cpu().numpy()
        if seed is not None:
            seed = np.atleast_1d(np.asarray(seed, dtype=np.int64))
            if not self._resets_seeded and self._seed_range is not None:
                low, high = self._seed_range
                seed = np.where((seed >= low) & (seed <= high), seed, low + seed % (high - low + 1))
        if seed is None or self._batched_episode_rng is None or len(index) == self.num_envs:
            super()._set_episode_rng(seed, env_idx)
        else:
            if len(seed) == 1 and len(index) > 1:
                seed = np.concatenate([seed, np.random.RandomState(seed[0]).randint(2**31, size=len(index) - 1)])
            self._episode_seed[index] = seed
            self._batched_episode_rng[index] = BatchedRNG.from_seeds(seed, backend=self._batched_rng_backend)
        for i in index:
            self._layout_seeds[i] = self._draw_seed(i) if seed is None else self._episode_seed[i]

    def _draw_seed(self, env: int) -> int:
        """A seed of the range; the env's generator goes on."""
        assert self._batched_episode_rng is not None
        drawn = int(self._batched_episode_rng[env].randint(2**31))
        low, high = self._seed_range or (0, 2**31 - 1)
        return low + drawn % (high - low + 1)

    @property
    def _scene_seeds(self) -> list[int]:
        """What each sub-scene is built from; looks stay until the scene is built anew."""
        assert self._episode_seed is not None
        return [int(seed) for seed in self._episode_seed]

    def _reconfigure(self, options: dict | None = None) -> None:
        """Build anew; see ``BaseEnv``. Where a seed has no layout, what was built before stays."""
        self._choose_objects()
        super()._reconfigure(options)

    def _choose_objects(self) -> None:
        """The objects that each env is to be built with: those of its seed, which decides its looks, too."""
        assert self._episode_seed is not None
        self._own = {}
        on_gpu = self._sim_device.is_cuda()
        if isinstance(self._layouts, LayoutBank) and (self._objects_stay or on_gpu):
            self._table = self._layouts.table("gpu" if on_gpu else "cpu")
            self._other_seeds = _OTHER_SEEDS if self._table else self._other_seeds
        seeds = self._episode_seed
        self._object_ids = [self._first_possible(self._objects_of, env, seeds) for env in range(self.num_envs)]
        self._objects_seeds = np.array(seeds)
        self._tabled = TabledStarts(self._table, self._objects_seeds, self.device) if self._table else None

    def _objects_of(self, seed: int) -> ObjectIds:
        if self._table is not None and (tabled := self._table.object_ids(seed)) is not None:
            if not self._table.stays(seed):
                raise _Moves("no layout of these objects stays", where=f"objects seed {seed}", fix="Take another seed.")
            return tabled
        if seed not in self._own:
            self._own[seed] = self._layout((seed, seed))
        return self._own[seed].object_ids

    def _find_starts(self, envs: NDArray[np.int64]) -> Starts:
        """Where some envs' episodes begin; gathered on their device where the bank's table holds them all."""
        for env in envs.tolist():
            self._found.pop(env, None)
        if self._tabled is None:
            return Starts.of([self.layout(env) for env in envs.tolist()], self.device)
        for env in envs[~self._tabled.good(envs, self._layout_seeds[envs])].tolist():
            self.layout(env)  # of another seed perhaps, which the table holds
        tabled = self._tabled.good(envs, self._layout_seeds[envs])
        found = self._tabled.gather(envs[tabled], self._layout_seeds[envs[tabled]])
        if tabled.all():
            return found
        return found.with_rows(tabled, Starts.of([self.layout(env) for env in envs[~tabled].tolist()], self.device))

    def layout(self, env: int = 0) -> Layout:
        """The layout of an env's episode."""
        if env not in self._found:
            self._found[env] = self._find_layout(env)
        return self._found[env]

    def _find_layout(self, env: int) -> Layout:
        objects_seed = int(self._objects_seeds[env])
        return self._first_possible(lambda seed: self._layout((objects_seed, seed)), env, self._layout_seeds)

    def _layout(self, pair: Pair) -> Layout:
        """A layout; that there is none takes long to find out, and is remembered."""
        tabled = self._tabled_layout(pair)
        if tabled is not None:
            return tabled
        if pair in self._failed:
            raise self._failed[pair].with_traceback(None)
        try:
            layout = self._layouts(*pair)
        except LayoutError as error:
            self._failed[pair] = error
            raise
        self._other_seeds = _OTHER_SEEDS
        return layout

    def _tabled_layout(self, pair: Pair) -> Layout | None:
        if pair[0] == pair[1] and pair[0] in self._own:
            return self._own[pair[0]]
        if self._table is None:
            return None
        if self._table.state(pair) == State.MOVES:
            where = f"objects seed {pair[0]}, seed {pair[1]}"
            raise _Moves("objects move as soon as this engine runs", where=where, fix="Take another seed.")
        return self._table.layout(pair)

    def _first_possible(self, make: Callable[[int], _T], env: int, seeds: np.ndarray) -> _T:
        """What ``make`` makes of an env's seed; where that can't be and nobody asked for the seed, of another one."""
        for _ in range(self._other_seeds):
            try:
                return make(int(seeds[env]))
            except LayoutError as error:
                if env in self._asked_for or self.num_envs == 1:  # one env starts over, as its objects change too
                    raise
                _log.log(_level(error), "env %d: no layout for seed %d, another is drawn: %s", env, seeds[env], error)
                seeds[env] = self._draw_seed(env)
        return make(int(seeds[env]))
