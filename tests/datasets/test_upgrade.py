import shutil

import pytest
from managing import die, edit, files_of, make, read
from synthetic import RayCaster, write_trajectory

from robocas_ms3.cli.main import run
from robocas_ms3.datasets.manage.upgrading import task_of, upgrade
from robocas_ms3.datasets.validate import validate
from robocas_ms3.errors import DatasetError


@pytest.fixture
def old(tmp_path):
    """(dataset of version 1, the same as today's convert writes it, its trajectory)."""
    new = make(tmp_path, "new", (3, 4, 5))
    root = shutil.copytree(new, tmp_path / "old")
    metadata = read(tmp_path / "new.json")

    def to_version_1(content):
        for key in ("schema_version", "cameras", "image_format", "depth"):
            del content[key]
        content["made_with"]["trajectory"] = metadata["robocas"]["versions"]
        content |= {"trajectory": "new.h5", "env_info": metadata["env_info"], "control_freq": 20.0}
        for entry in content["episodes"].values():
            del entry["recording"], entry["trajectory"]

    edit(root / "conversion.json", to_version_1)
    for scene in root.glob("*/scene.json"):
        scene.unlink()
    return root, new, tmp_path / "new.h5"


def test_with_the_trajectory_it_is_what_convert_writes_today(old):
    root, new, trajectory = old
    done = upgrade(root, trajectories=[trajectory], open_source=RayCaster)
    assert (done.before, done.described, done.incomplete) == (1, [0, 1, 2], [])
    assert files_of(root) == files_of(new)
    again = upgrade(root, trajectories=[trajectory], open_source=RayCaster)
    assert (again.before, again.described) == (2, [])


def test_without_it_is_as_far_as_known_and_can_be_completed(old, capsys):
    root, new, trajectory = old
    assert run(["upgrade", str(root)]) == 0
    assert "was of version 1; 3 episodes described; of 3 episodes the layout is not known" in capsys.readouterr().out
    scene, whole = (read(folder / "episode_0000002" / "scene.json") for folder in (root, new))
    unknown = {key for key, value in scene.items() if value is None}
    assert unknown == {"config", "layout", "objects", "reset_options", "recorded"}
    assert scene.pop("source") == {**whole["source"], "recording": None}
    assert {key: scene[key] for key in scene if key not in unknown} == {
        key: whole[key] for key in scene if key not in unknown
    }
    assert validate(root).violations == []
    done = upgrade(root, trajectories=[trajectory], open_source=RayCaster)
    assert (done.before, done.described, done.incomplete) == (2, [0, 1, 2], [])
    assert files_of(root) == files_of(new)


@pytest.mark.parametrize("moment", ["scene", "settings"])
def test_killed_and_called_again(old, tmp_path, moment):
    root, _, _ = old
    whole = shutil.copytree(root, tmp_path / "whole")
    upgrade(whole)
    die(moment, "upgrade", root)
    assert "schema_version" not in read(root / "conversion.json")
    upgrade(root)
    assert files_of(root) == files_of(whole)


def test_another_trajectory(old, tmp_path):
    root, _, _ = old
    before = files_of(root)
    (tmp_path / "other").mkdir()
    other = write_trajectory(tmp_path / "other" / "new.h5", seeds=(7, 8, 9))
    with pytest.raises(DatasetError, match="this episode is not of that trajectory"):
        upgrade(root, trajectories=[other], open_source=RayCaster)
    few = write_trajectory(tmp_path / "other" / "new.h5", seeds=(3,))
    with pytest.raises(DatasetError, match="no such episode in this trajectory .expected episode 1"):
        upgrade(root, trajectories=[few], open_source=RayCaster)
    assert files_of(root) == before


def test_two_trajectories_of_one_name(old, tmp_path):
    root, _, trajectory = old
    before = files_of(root)
    with pytest.raises(DatasetError, match="trajectories of one name can't be told apart"):
        upgrade(root, trajectories=[trajectory, tmp_path / "other" / trajectory.name])
    assert files_of(root) == before


def test_what_can_not_be_upgraded(old, tmp_path):
    root, _, _ = old
    with pytest.raises(DatasetError, match="no dataset here"):
        upgrade(tmp_path / "nothing")
    edit(root / "conversion.json", lambda c: c.update(schema_version=3))
    with pytest.raises(DatasetError, match="of a newer version .expected <= 2, found 3"):
        upgrade(root)
    edit(root / "conversion.json", lambda c: c.update(schema_version=1))
    (root / "data_info.json").unlink()
    with pytest.raises(DatasetError, match="this dataset is not finished"):
        upgrade(root)
    (root / "conversion.json").unlink()
    with pytest.raises(DatasetError, match="made elsewhere.*import-robocas"):
        upgrade(root)


def test_a_dataset_of_today_stays_as_it_is(old, capsys):
    _, new, _ = old
    edit(new / "conversion.json", lambda c: c.update(source={"format": "robocas v0"}, more=1))
    before = files_of(new)
    assert upgrade(new).described == []
    assert run(["upgrade", str(new)]) == 0
    assert capsys.readouterr().out == f"{new}: is of version 2 already; nothing to do\n"
    assert files_of(new) == before


def test_a_task_is_known_by_its_environment():
    from robocas_ms3.tasks.spec import TASKS

    assert [task_of(f"robocas_ms3:{spec.env_id}") for spec in TASKS.values()] == list(TASKS)
    assert task_of("PushCube-v1") is None
    assert task_of(None) is None
