"""Batches and learning rate of each step."""

import math
from collections import Counter

import pytest

from robocas_ms3.baselines.baseline import TrainSettings
from robocas_ms3.baselines.training.supervised import batch_indices, epoch_at, learning_rate_at


def settings(**values):
    return TrainSettings(**values)


def test_each_epoch_has_every_sample_once():
    batches = list(batch_indices(10, settings(steps=5, batch_size=4)))  # 20 samples: two epochs
    places = [index for batch in batches for index in batch]
    assert Counter(places[:10]) == Counter(range(10)) == Counter(places[10:])
    assert places[:10] != places[10:]


def test_batches_depend_on_seed_and_step_only():
    whole = list(batch_indices(10, settings(steps=6, batch_size=4)))
    assert list(batch_indices(10, settings(steps=6, batch_size=4), first_step=3)) == whole[3:]
    assert list(batch_indices(10, settings(steps=6, batch_size=4, seed=1))) != whole


def test_processes_share_a_batch():
    whole = list(batch_indices(10, settings(steps=3, batch_size=4)))
    parts = [list(batch_indices(10, settings(steps=3, batch_size=4), rank=rank, world_size=2)) for rank in (0, 1)]
    assert [sorted(one + other) for one, other in zip(*parts, strict=True)] == [sorted(batch) for batch in whole]


def test_cosine_and_constant_schedules():
    chosen = settings(steps=110, warmup_steps=10, learning_rate=1.0, min_learning_rate=0.2)
    assert learning_rate_at(0, 99, chosen) == pytest.approx(0.1)
    assert learning_rate_at(9, 99, chosen) == pytest.approx(1.0)
    assert learning_rate_at(10, 99, chosen) == pytest.approx(1.0)
    assert learning_rate_at(60, 99, chosen) == pytest.approx(0.6)  # halfway
    assert learning_rate_at(110, 99, chosen) == pytest.approx(0.2)
    assert learning_rate_at(77, 99, chosen.model_copy(update={"schedule": "constant"})) == 1.0


def test_restart_schedule():
    """Periods of 2, 4, 8 epochs of 5 steps: restarts after 10 and 30 steps."""
    chosen = settings(
        steps=100,
        batch_size=2,
        warmup_steps=0,
        schedule="restarts",
        restart_epochs=2,
        learning_rate=1.0,
        min_learning_rate=0.1,
    )
    assert epoch_at(10, 10, chosen) == 2
    for step, expected in ((0, 1.0), (5, 0.55), (10, 1.0), (20, 0.55), (30, 1.0), (50, 0.55)):
        assert learning_rate_at(step, 10, chosen) == pytest.approx(expected)
    assert learning_rate_at(9, 10, chosen) == pytest.approx(0.1 + 0.9 * (1 + math.cos(0.9 * math.pi)) / 2)
