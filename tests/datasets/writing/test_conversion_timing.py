"""Where the time of a conversion goes, by a clock that stands still but where the test moves it."""

import time
from collections import Counter

import pytest
from synthetic import RayCaster

from robocas_ms3.datasets.writing import convert as conversion
from robocas_ms3.datasets.writing import episode_folder
from robocas_ms3.datasets.writing.settings import ConversionSettings, Timing


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(time, "perf_counter", clock)
    return clock


def slow(function, clock, seconds):
    """The same, but it takes so long."""

    def slower(*args, **kwargs):
        clock.now += seconds
        return function(*args, **kwargs)

    return slower


def slow_source(clock):
    class Slow(RayCaster):
        def __init__(self, *args):
            super().__init__(*args)
            clock.now += 5  # once, however many episodes

        def load(self, recording):
            clock.now += 3

        def frames(self, recording, samples):
            for frame in super().frames(recording, samples):
                clock.now += 2
                yield frame

    return Slow


def test_sums_and_parts():
    total = sum([Timing(load=1, wait=2), Timing(load=0.5, write=4, total=9)], start=Timing(render=3))
    assert total == Timing(load=1.5, render=3, wait=2, write=4, total=9)


def test_of_a_robocas_dataset(trajectory, tmp_path, monkeypatch, clock):
    calls, write = Counter(), episode_folder.write_picture

    def encode(path, picture):
        calls[picture.ndim] += 1
        write(path, picture)
        return 0.5

    monkeypatch.setattr(episode_folder, "write_picture", encode)
    monkeypatch.setattr(episode_folder, "write_cameras", slow(episode_folder.write_cameras, clock, 0.25))
    monkeypatch.setattr(episode_folder.np, "savez", slow(episode_folder.np.savez, clock, 0.5))
    done = conversion.convert(
        ConversionSettings(trajectory, tmp_path / "out", embeddings=False, open_renderer=slow_source(clock))
    )
    assert calls == {3: 2 * 7 * 3, 2: 2 * 7 * 3}
    # two episodes of 7 steps, three cameras of two kinds; encoding is beside the rest and not in the total
    expected = Timing(load=5 + 2 * 3, render=2 * 7 * 2, encode=2 * 42 * 0.5, write=2 * 0.75, total=5 + 2 * (3 + 14.75))
    assert done.timing == expected
    assert done.seconds == expected.total
    assert [episode.timing.load for episode in done.episodes] == [8, 3]
    again = conversion.convert(
        ConversionSettings(trajectory, tmp_path / "out", embeddings=False, open_renderer=RayCaster)
    )
    assert again.timing == Timing()


def test_of_a_lerobot_dataset(trajectory, made, tmp_path, monkeypatch, clock):
    pytest.importorskip("av", reason="needs the extra 'lerobot'")
    pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")
    from robocas_ms3.datasets.lerobot import parts, writer
    from robocas_ms3.datasets.lerobot.convert import convert_lerobot
    from robocas_ms3.datasets.sources.reader import Episode

    monkeypatch.setattr(parts.Encoder, "add", slow(parts.Encoder.add, clock, 0.5))
    monkeypatch.setattr(parts.pq, "write_table", slow(parts.pq.write_table, clock, 0.25))
    monkeypatch.setattr(writer, "join_parts", slow(writer.join_parts, clock, 10))
    done = convert_lerobot(
        ConversionSettings(trajectory, tmp_path / "out", open_renderer=slow_source(clock), lerobot_version="0.5")
    )
    assert done.joining == 10 + 2 * 0.25  # with the tables of tasks and sub-goals
    seconds = {"encode": 2 * 42 * 0.5, "write": 2 * 0.25 + done.joining}
    assert done.timing == Timing(load=11, render=28, **seconds, total=11 + 28 + 42 + 0.5)
    assert done.seconds == done.timing.total + done.joining
    # of a dataset pictures are read, not rendered
    monkeypatch.setattr(Episode, "rgb", slow(Episode.rgb, clock, 1))
    done = convert_lerobot(ConversionSettings(made, tmp_path / "again", lerobot_version="0.5"))
    assert done.timing == Timing(load=2 * 7 * 3, **seconds, total=42 + 42 + 0.5)
