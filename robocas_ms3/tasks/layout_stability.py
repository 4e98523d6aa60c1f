"""Whether objects stay where layouts put them, tried by the very engine that is to run them."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import gymnasium as gym

from robocas_ms3.scenes.cache import LayoutCache
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.scenes.layout_table import Engine, LayoutStatus, SeedPair
from robocas_ms3.scenes.settle import CHECK_SECONDS, MAX_SHIFT
from robocas_ms3.scenes.task_specs import TASKS

_ENVS = {"cpu": 1, "gpu": 256}  # at once
_BACKENDS = {"cpu": "physx_cpu", "gpu": "physx_cuda"}


def unchecked_layouts(cache: LayoutCache, engine: Engine) -> dict[int, list[int]]:
    """Seeds of layouts that are to be tried, by objects seed."""
    table = cache.table(engine)
    seeds: dict[int, list[int]] = {}
    for objects_seed, seed in table.pairs(LayoutStatus.UNCHECKED) if table else ():
        seeds.setdefault(objects_seed, []).append(seed)
    return seeds


def check_layouts(
    cache: LayoutCache, engine: Engine, seeds: dict[int, list[int]], **kwargs: Any
) -> Generator[tuple[SeedPair, float]]:
    """Let an environment begin with each layout and do nothing for a second.

    Args:
        cache: where the layouts are.
        engine: that is to run them.
        seeds: of layouts, by objects seed (`unchecked_layouts`).
        kwargs: for ``gym.make``: the packs that the cache is of.

    Yields:
        Objects seed and seed, and how far the object that moved farthest has moved then, m.
    """
    first_row = next(iter(seeds))

    def layouts(objects_seed: int, seed: int) -> Layout:  # a cache as an env's own would tell what moves
        known = objects_seed in seeds  # else the env is only being made
        return cache.get(objects_seed, seed) if known else cache.get(first_row, first_row)

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


def status_of(moved: float) -> LayoutStatus:
    """What is known of a layout whose objects moved that far, m."""
    return LayoutStatus.STABLE if moved <= MAX_SHIFT else LayoutStatus.UNSTABLE
