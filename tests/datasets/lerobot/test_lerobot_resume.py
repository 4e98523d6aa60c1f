"""Conversions that stop and are resumed."""

import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import h5py
import pytest
from lerobot_folders import convert, files_of
from synthetic import RayCaster

pytest.importorskip("av", reason="needs the extra 'lerobot'")
pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra 'lerobot'")

from robocas_ms3.core.errors import DatasetError, IncompleteError, OutputExistsError
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.check import check_lerobot
from robocas_ms3.datasets.lerobot.convert import convert_lerobot
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.manage.importing import import_robocas
from robocas_ms3.datasets.manage.survey import survey
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.sources.tolerant import arrays_fingerprint
from robocas_ms3.datasets.writing.settings import ConversionSettings


def test_an_episode_with_an_error_is_converted_on_resume(trajectory, lerobot, tmp_path):
    class Breaking(RayCaster):
        def frames(self, recording, samples):
            for step, frame in enumerate(super().frames(recording, samples)):
                if recording.seed == 5 and step == 3:
                    raise DatasetError("it broke")
                yield frame

    out = tmp_path / "out"
    with pytest.raises(DatasetError, match="it broke"):
        convert_lerobot(ConversionSettings(trajectory, out, open_renderer=Breaking))
    assert {path.name for path in out.iterdir()} == {".parts"}
    assert not (out / ".parts" / "episode_0000001").exists()
    done = convert(trajectory, out)
    assert (done.kept, [e.number for e in done.episodes]) == (1, [1])
    assert files_of(out) == files_of(lerobot)


def test_resuming_with_other_package_versions_is_refused(lerobot, trajectory, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(lerobot, out)
    path = out / "meta/robocas/conversion.json"
    about = json.loads(path.read_text())
    about["made_with"]["sapien"] = "2.2.2"
    path.write_text(json.dumps(about))
    with pytest.raises(OutputExistsError, match='made_with.sapien: "2.2.2" -> '):
        convert(trajectory, out)


def test_a_repaired_recording_is_converted_on_resume(lerobot, trajectory, tmp_path):
    broken, out = tmp_path / trajectory.name, tmp_path / "out"
    shutil.copy(trajectory.with_suffix(".json"), broken.with_suffix(".json"))
    shutil.copy(trajectory, broken)
    with h5py.File(broken, "a") as file:
        del file["traj_2/actions"]
    with pytest.raises(IncompleteError, match="found episode_0000001: .*traj_2: this episode is damaged"):
        convert(broken, out)
    shutil.copy(trajectory, broken)
    convert(broken, out)
    assert files_of(out) == files_of(lerobot)


def test_an_imported_folder_can_be_resumed(dataset, tmp_path):
    """Nobody knows its recordings, so its episodes are told by their arrays."""
    for path in [dataset / "conversion.json", *dataset.glob("*/scene.json")]:
        path.unlink()
    imported, out, whole = tmp_path / "imported", tmp_path / "out", tmp_path / "whole"
    import_robocas(survey(dataset), imported)

    def stop(episode):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        convert(imported, out, on_episode=stop)
    assert {path.name for path in out.iterdir()} == {".parts"}
    done = convert(imported, out)
    assert (done.kept, [e.number for e in done.episodes]) == (1, [1])
    convert(imported, whole)
    assert files_of(out) == files_of(whole)
    marks = [f"arrays {arrays_fingerprint(Dataset(imported).episode(number).arrays)}" for number in (0, 1)]
    assert [entry["recording"] for entry in LeRobotDataset(out).settings["episodes"]] == marks
    assert convert(imported, out).kept == 2
    with pytest.raises(OutputExistsError, match="other episodes"):
        shutil.rmtree(imported / "episode_0000001")
        convert(imported, out)


@pytest.mark.parametrize("moment", ["frame", "part", "plan", "join", "table", "overview", "rename", "joined", "sweep"])
def test_a_killed_and_resumed_conversion_gives_the_same_bytes(trajectory, lerobot, tmp_path, moment):
    """kill -9 in a process of its own; nothing lies under a final name that is not whole."""
    out = tmp_path / "out"
    command = [
        sys.executable,
        str(Path(__file__).parents[2] / "support" / "dying_lerobot.py"),
        moment,
        str(trajectory),
        str(out),
    ]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    if (out / schema.INFO_FILE).exists():
        assert check_lerobot(out).violations == []
    convert(trajectory, out)
    assert files_of(out) == files_of(lerobot)
    assert {path.name for path in out.iterdir()} == {"meta", "data", "videos", ".annotate_staging"}
