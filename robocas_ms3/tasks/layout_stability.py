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


def unchecked_layouts(cache: LayoutCache, engine: Engine) -> dict[int, list[int]]:
    """Return the seeds of unchecked layouts by objects seed."""
    table = cache.load_table(engine)
    seeds: dict[int, list[int]] = {}
    for objects_seed, seed in table.find_pairs(LayoutStatus.UNCHECKED) if table else ():
        seeds.setdefault(objects_seed, []).append(seed)
    return seeds


def check_layouts(
    cache: LayoutCache, engine: Engine, seeds: dict[int, list[int]], **kwargs: Any
) -> Generator[tuple[SeedPair, float]]:
    """Start an episode with each layout, hold the robot for 1 s, and measure the objects' motion.

    Args:
        cache: cache of the layouts.
        engine: physics engine to check.
        seeds: layout seeds by objects seed (`unchecked_layouts`).
        kwargs: arguments of ``gym.make``: the packs of the cache.

    Yields:
        Seed pair, and the greatest shift of an object in m.
    """
    first_row = next(iter(seeds))

    def layouts(objects_seed: int, seed: int) -> Layout:  # unlike the cache, it also returns unstable layouts
        known = objects_seed in seeds  # otherwise the env is being built
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
    """Return the status of a layout from the greatest shift of its objects, m."""
    return LayoutStatus.STABLE if moved <= MAX_SHIFT else LayoutStatus.UNSTABLE
