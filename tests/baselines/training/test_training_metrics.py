"""Log of a continued run: complete lines up to the checkpoint."""

import math

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from robocas_ms3.baselines.training.metrics import MetricsLog, read_training_seconds

HEAD = "step,split,epoch,seconds,learning_rate,loss\n"


def test_lines_after_the_checkpoint_are_removed(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text(HEAD + "1000,train,1,60,0.1,2\n1000,val,1,61,0.1,3\n1050,train,1,63,0.1,1.5\n")
    log = MetricsLog(tmp_path, 1000)
    log.close()
    assert path.read_text() == HEAD + "1000,train,1,60,0.1,2\n1000,val,1,61,0.1,3\n"
    assert log.seconds == 61
    assert log.has_line(1000, "val") and not log.has_line(1050, "train")


def test_truncated_line_is_removed(tmp_path):
    """As after a full disk: the truncated step 1050 must not be read as step 10."""
    path = tmp_path / "metrics.csv"
    path.write_text(HEAD + "1000,train,1,60,0.1,2\n10")
    log = MetricsLog(tmp_path, 1000)
    log.add(1050, "train", {"epoch": 1.0, "seconds": 70.0, "learning_rate": 0.1}, {"loss": 1.0})
    log.close()
    assert path.read_text() == HEAD + "1000,train,1,60,0.1,2\n1050,train,1,70,0.1,1\n"
    assert log.seconds == 60


@pytest.mark.parametrize(("step", "seconds"), [(1000, 61.0), (1049, 61.0), (1050, 63.5), (10, None)])
def test_training_time_is_that_of_the_last_line_up_to_the_step(tmp_path, step, seconds):
    lines = "1000,train,1,60,0.1,2\n1000,val,1,61,0.1,3\n1050,train,1,63.5,0.1,1.5\n1050,val"
    (tmp_path / "metrics.csv").write_text(HEAD + lines)
    assert read_training_seconds(tmp_path, step) == seconds


@pytest.mark.parametrize("content", [None, b"", b"\xff\xfe", b"step,loss\n1,2\n"])
def test_training_time_is_unknown_without_a_readable_log(tmp_path, content):
    if content is not None:
        (tmp_path / "metrics.csv").write_bytes(content)
    assert read_training_seconds(tmp_path, 1000) is None


def test_run_without_checkpoint_starts_new_curves(tmp_path):
    """Older TensorBoard events are removed."""
    for loss in (5.0, 1.0):
        log = MetricsLog(tmp_path, 0)
        for step in (50, 100) if loss == 5.0 else (50,):
            about = {"epoch": 1.0, "seconds": 70.0, "learning_rate": 0.1}
            log.add(step, "train", about, {"loss": loss})
        log.close()
    assert read_curve(tmp_path, "train/loss") == [(50, 1.0)]


def test_continued_run_hides_events_after_its_checkpoint(tmp_path):
    for first, losses in ((0, {50: 3.0, 100: 2.0, 150: 9.0}), (100, {150: 1.0, 200: math.nan})):
        log = MetricsLog(tmp_path, first)
        for step, loss in losses.items():
            log.add(step, "train", {"epoch": 1.0, "seconds": 1.0, "learning_rate": 0.5}, {"loss": loss})
            assert read_curve(tmp_path, "train/learning_rate")[-1] == (step, 0.5)  # without buffering
        log.close()
    assert read_curve(tmp_path, "train/loss") == [(50, 3.0), (100, 2.0), (150, 1.0)]


def read_curve(folder, name):
    """Return (step, value) of a curve as TensorBoard reads it."""
    board = EventAccumulator(str(folder / "tensorboard"))
    board.Reload()
    return [(point.step, point.value) for point in board.Scalars(name)]
