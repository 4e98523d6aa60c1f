import numpy as np
import pytest

from robocas_ms3.datasets.lerobot.stats import Levels, vector_stats


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
