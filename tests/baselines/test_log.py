"""The log of a run that goes on: whole lines of before, and none of what came after the checkpoint."""

from robocas_ms3.baselines.log import MetricsLog

HEAD = "step,split,epoch,seconds,learning_rate,loss\n"


def test_it_is_cut_back(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text(HEAD + "1000,train,1,60,0.1,2\n1000,val,1,61,0.1,3\n1050,train,1,63,0.1,1.5\n")
    log = MetricsLog(tmp_path, 1000)
    log.close()
    assert path.read_text() == HEAD + "1000,train,1,60,0.1,2\n1000,val,1,61,0.1,3\n"
    assert log.seconds == 61
    assert log.has(1000, "val") and not log.has(1050, "train")


def test_a_line_that_was_cut_off_is_none(tmp_path):
    """As a full disk leaves it: 10 of 1050 is no step 10."""
    path = tmp_path / "metrics.csv"
    path.write_text(HEAD + "1000,train,1,60,0.1,2\n10")
    log = MetricsLog(tmp_path, 1000)
    log.add(1050, "train", {"epoch": 1.0, "seconds": 70.0, "learning_rate": 0.1}, {"loss": 1.0})
    log.close()
    assert path.read_text() == HEAD + "1000,train,1,60,0.1,2\n1050,train,1,70,0.1,1\n"
    assert log.seconds == 60


def test_a_run_without_a_checkpoint_begins_its_curves_anew(tmp_path):
    """What TensorBoard has of before goes."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    for loss in (5.0, 1.0):
        log = MetricsLog(tmp_path, 0)
        for step in (50, 100) if loss == 5.0 else (50,):
            about = {"epoch": 1.0, "seconds": 70.0, "learning_rate": 0.1}
            log.add(step, "train", about, {"loss": loss})
        log.close()
    board = EventAccumulator(str(tmp_path / "tensorboard"))
    board.Reload()
    assert [(point.step, point.value) for point in board.Scalars("train/loss")] == [(50, 1.0)]
