import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from robocas_ms3.datasets.lerobot.stats import QUANTILES, Histogram, Levels, Range, vector_stats

VALUES = arrays(np.float64, st.tuples(st.integers(1, 20), st.just(3)), elements=st.floats(-10, 10))


def test_statistics_worked_out_by_hand():
    found = vector_stats(np.array([[1, 10], [2, 10], [3, 10], [4, 10], [5, 10]], np.int64))
    assert found["min"] == [1, 10]
    assert found["max"] == [5, 10]
    assert found["mean"] == [3, 10]
    assert found["std"] == pytest.approx([np.sqrt(2), 0])
    assert found["count"] == [5]
    assert found["q50"] == [3, 10]
    assert found["q10"] == pytest.approx([1.4, 10])
    assert isinstance(found["min"][0], int)


@settings(max_examples=50, deadline=None)
@given(st.lists(VALUES, min_size=1, max_size=5))
@example([np.array([[5e-324, 0.0, 0.0], [0.0, 0.0, 0.0]])])  # a 5000th of that range is 0
def test_ranges_of_episodes_are_those_of_all(episodes):
    whole, found = np.concatenate(episodes), Range()
    for episode in episodes:
        found.add(episode)
    histogram = Histogram(found.low, found.high)
    for episode in episodes:
        histogram.add(episode)
    stats = found.stats(histogram, integer=False)
    np.testing.assert_allclose(stats["min"], whole.min(axis=0))
    np.testing.assert_allclose(stats["max"], whole.max(axis=0))
    np.testing.assert_allclose(stats["mean"], whole.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(stats["std"], whole.std(axis=0), atol=1e-6)
    assert stats["count"] == [len(whole)]
    bin_width = np.ptp(whole, axis=0) / 5000 + 1e-9
    for name, share in QUANTILES.items():
        exact = np.quantile(whole, share, axis=0, method="inverted_cdf")
        assert (np.abs(np.array(stats[name]) - exact) <= bin_width).all()


def test_pictures_are_counted_exactly():
    rng = np.random.default_rng(0)
    pictures = rng.integers(0, 256, (4, 12, 16, 3), np.uint8)
    pictures[..., 1] //= 2
    found, other = Levels.rgb(), Levels.rgb()
    for picture in pictures[:3]:
        found.add(picture)
    other.add(pictures[3])
    found.merge(other)
    stats = found.stats()
    channels = pictures.reshape(-1, 3) / 255
    for name, values in (("mean", channels.mean(0)), ("std", channels.std(0)), ("max", channels.max(0))):
        np.testing.assert_allclose(np.array(stats[name]).reshape(3), values, atol=1e-9)
        assert np.shape(stats[name]) == (3, 1, 1)
    median = np.quantile(channels, 0.5, axis=0, method="inverted_cdf")
    np.testing.assert_allclose(np.array(stats["q50"]).reshape(3), median)
    assert stats["count"] == [4]


def test_large_pictures_are_thinned():
    found = Levels.rgb()
    found.add(np.zeros((480, 640, 3), np.uint8))
    assert found.counts.sum() == 3 * 120 * 160
