"""Checks of layouts in the physics engine that runs them."""

from __future__ import annotations

import numpy as np
import pytest

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.cli.layouts import check_stability
from robocas_ms3.scenes.cache import LayoutCache, count_layouts, seed_pairs
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.layout import write_layout
from robocas_ms3.scenes.layout_table import LayoutStatus
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.tasks import layout_stability
from robocas_ms3.tasks.layout_stability import find_unchecked_layouts, measure_layout_shifts, status_from_shift


@pytest.fixture
def cache(tmp_path) -> LayoutCache:
    """Return a cache with four layouts of small heaps; in layout (1, 0) an object floats in the air."""
    pack = load_pack("builtin")
    cache = LayoutCache(SceneModel.load(load_task_config("search_table_small_heap"), pack, pack), tmp_path)
    pairs = seed_pairs([0, 1], [0, 1])
    assert not any(problem for _, problem in cache.fill(pairs))
    layout = cache.get(1, 0)
    poses = layout.object_poses.copy()
    poses[np.argmax(poses[:, 2, 3]), 2, 3] += 0.03
    write_layout(type(layout)(**{**vars(layout), "object_poses": poses}), cache.layout_path(1, 0))
    cache.write_table("cpu", pairs)
    return cache


@pytest.mark.slow
def test_unstable_heap_is_found(cache):
    assert find_unchecked_layouts(cache, "gpu") == {}
    seeds = find_unchecked_layouts(cache, "cpu")
    assert seeds == {0: [0, 1], 1: [0, 1]}
    moved = dict(measure_layout_shifts(cache, "cpu", seeds))
    assert moved.keys() == {(0, 0), (0, 1), (1, 0), (1, 1)}
    assert moved.pop((1, 0)) > 0.02
    assert max(moved.values()) < 0.003
    cache.write_statuses("cpu", {pair: status_from_shift(by) for pair, by in moved.items()})
    table = cache.load_table("cpu")
    assert table is not None
    assert table.find_pairs(LayoutStatus.STABLE) == [(0, 0), (0, 1), (1, 1)]
    assert find_unchecked_layouts(cache, "cpu") == {1: [0]}
    assert count_layouts(cache.folder) == 4  # the check added no layouts


@pytest.mark.slow
def test_statuses_found_before_an_interruption_are_stored(cache, monkeypatch):
    def check_until_interrupted(*args, **kwargs):
        yield (0, 0), 0.001
        yield (0, 1), 0.02
        raise KeyboardInterrupt

    monkeypatch.setattr(layout_stability, "measure_layout_shifts", check_until_interrupted)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            check_stability(cache, "cpu")
    table = cache.load_table("cpu")
    assert table is not None
    assert (table.find_pairs(LayoutStatus.STABLE), table.find_pairs(LayoutStatus.UNSTABLE)) == ([(0, 0)], [(0, 1)])
    assert table.find_pairs(LayoutStatus.UNCHECKED) == [(1, 0), (1, 1)]


def test_shift_of_3_mm_is_stable():
    assert status_from_shift(0.0029) == LayoutStatus.STABLE
    assert status_from_shift(0.0031) == status_from_shift(float("nan")) == LayoutStatus.UNSTABLE
