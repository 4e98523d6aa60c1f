"""Where the time of a conversion goes."""

import time

import pytest
from synthetic import RayCaster

from robocas_ms3.datasets.writing.convert import convert
from robocas_ms3.datasets.writing.settings import ConversionSettings, Timing


class Slow(RayCaster):
    """Takes 0.2 s to load a scene and 0.02 s to render a step."""

    def load(self, recording):
        time.sleep(0.2)

    def frames(self, recording, samples):
        for frame in super().frames(recording, samples):
            time.sleep(0.02)
            yield frame


def test_sums_and_parts():
    total = sum([Timing(load=1, wait=2), Timing(load=0.5, write=4, total=9)], start=Timing(render=3))
    assert total == Timing(load=1.5, render=3, wait=2, write=4, total=9)


@pytest.mark.parametrize("to", ["robocas", "lerobot"])
def test_each_stage_is_measured(trajectory, tmp_path, to):
    settings = ConversionSettings(trajectory, tmp_path / "out", embeddings=False, video=False, open_renderer=Slow)
    if to == "robocas":
        done = convert(settings)
    else:
        pytest.importorskip("av", reason="needs the extra 'lerobot'")
        pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")
        from robocas_ms3.datasets.lerobot.convert import convert_lerobot

        done = convert_lerobot(settings)
        assert 0 < done.joining <= done.timing.write
    assert done.timing.load >= 2 * 0.2
    assert done.timing.render >= 2 * 7 * 0.02
    assert done.timing.encode > 0
    assert done.timing.write > 0
    assert done.timing.total + done.joining <= done.seconds
    assert [episode.timing.load >= 0.2 for episode in done.episodes] == [True, True]
