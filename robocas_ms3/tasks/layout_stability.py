"""Check that the objects of layouts are stable in the physics engine that will run the episodes."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import gymnasium as gym

from robocas_ms3.scenes.cache import LayoutCache
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.scenes.layout_table import Engine, LayoutStatus, SeedPair
from robocas_ms3.scenes.settle import CHECK_SECONDS, MAX_SHIFT
from robocas_ms3.scenes.task_specs import TASKS

_ENVS = {"cpu": 1, "gpu": 256}  # number of envs that run at once
_BACKENDS = {"cpu": "physx_cpu", "gpu": "physx_cuda"}


def find_unchecked_layouts(cache: LayoutCache, engine: Engine) -> dict[int, list[int]]:
    """Return, by objects seed, the layout seeds whose stability is unchecked in the layout table of ``engine``."""
    table = cache.load_table(engine)
    seeds: dict[int, list[int]] = {}
    for objects_seed, seed in table.find_pairs(LayoutStatus.UNCHECKED) if table else ():
        seeds.setdefault(objects_seed, []).append(seed)
    return seeds


def measure_layout_shifts(
    cache: LayoutCache, engine: Engine, seeds: dict[int, list[int]], **kwargs: Any
) -> Generator[tuple[SeedPair, float]]:
    """Simulate each layout for 1 s with a robot that does not move, and yield how far its objects shift.

    Args:
        cache: cache that has the layouts.
        engine: physics engine that simulates.
        seeds: layout seeds by objects seed, as returned by `find_unchecked_layouts`.
        kwargs: additional arguments of ``gym.make``, such as ``pack`` and ``furniture_pack``.

    Yields:
        Seed pair of a layout, and the greatest shift of an object in m.
    """
    first_objects_seed = next(iter(seeds))

    def layouts(objects_seed: int, seed: int) -> Layout:  # unlike the cache, it also returns unstable layouts
        known = objects_seed in seeds  # otherwise the env is being built
        return cache.get(objects_seed, seed) if known else cache.get(first_objects_seed, first_objects_seed)

    count = min(_ENVS[engine], len(seeds))
    env: Any = gym.make(
        TASKS[cache.model.config.task].env_id,
        num_envs=count,
        config=cache.model.config,
        layouts=layouts,
        reconfiguration_freq=0,
        sim_backend=_BACKENDS[engine],
        render_backend="none",
        obs_mode="none",
        reward_mode="none",
        **kwargs,
    )
    try:
        base: Any = env.unwrapped
        rows = list(seeds)
        for first in range(0, len(rows), count):
            some = rows[first : first + count]
            padded = some + some[:1] * (count - len(some))
            env.reset(seed=padded, options={"reconfigure": True})
            for i in range(max(len(seeds[row]) for row in some)):
                env.reset(seed=[seeds[row][min(i, len(seeds[row]) - 1)] for row in padded])
                for _ in range(round(CHECK_SECONDS * base.control_freq)):
                    env.step(None)  # the arm stays where it is
                shift = (base.object_poses - base.start_poses)[..., :3].norm(dim=-1).where(base.present, 0.0)
                for row, moved in zip(some, shift.amax(dim=-1).tolist(), strict=False):
                    if i < len(seeds[row]):
                        yield (row, seeds[row][i]), moved
    finally:
        env.close()


def status_from_shift(shift: float) -> LayoutStatus:
    """Return the status of a layout whose objects shift by at most ``shift`` m in the simulation."""
    return LayoutStatus.STABLE if shift <= MAX_SHIFT else LayoutStatus.UNSTABLE
