import shutil

import pytest
from managing import DAMAGES, change, edit, files_of, make, read
from managing import convert_made_up as convert
from synthetic import write_trajectory

from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import DatasetError, OutputExistsError, RobocasError
from robocas_ms3.core.locks import lock_folder
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.manage.copy_episodes import CopyOptions, FileCopier
from robocas_ms3.datasets.manage.merge import merge
from robocas_ms3.datasets.manage.split import SplitOptions, resplit
from robocas_ms3.datasets.sources.reader import Dataset


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """Two datasets of two episodes, for reading only."""
    folder = tmp_path_factory.mktemp("parts")
    return make(folder, "a", (10, 11)), make(folder, "b", (20, 21))


def spoiled(part, tmp_path):
    return shutil.copytree(part, tmp_path / part.name)


def test_episodes_are_numbered_in_order_and_keep_their_split(parts, tmp_path):
    a, b = parts
    out = tmp_path / "out"
    done = merge([b, a], out)
    assert (done.episodes, done.skipped, done.copied) == (4, 0, 0)
    assert Dataset(out).numbers == [0, 1, 2, 3]
    for number, (source, old) in enumerate([(b, 0), (b, 1), (a, 0), (a, 1)]):
        assert files_of(out / f"episode_{number:07d}") == files_of(source / f"episode_{old:07d}")
    ledger = read(out / "conversion.json")["episodes"]
    assert [entry["from"] for entry in ledger.values()] == [
        {"dataset": "b", "episode": 0}, {"dataset": "b", "episode": 1},
        {"dataset": "a", "episode": 0}, {"dataset": "a", "episode": 1},
    ]  # fmt: skip
    assert [entry["seed"] for entry in ledger.values()] == [20, 21, 10, 11]
    info = read(out / "data_info.json")
    sides = [read(part / "data_info.json")["val_eps"] for part in (b, a)]
    assert info["val_eps"] == sorted([*sides[0], *(n + 2 for n in sides[1])])
    assert sorted(info["train_eps"] + info["val_eps"]) == [0, 1, 2, 3]
    assert validate(out).violations == []


def test_files_are_hard_linked_unless_copied(parts, tmp_path):
    pixels = "episode_0000001/base_camera/rgb/0003.png"
    merge([parts[0]], tmp_path / "linked")
    merge([parts[0]], tmp_path / "copied", options=CopyOptions(link=False))
    inode = (parts[0] / pixels).stat().st_ino
    assert (tmp_path / "linked" / pixels).stat().st_ino == inode
    assert (tmp_path / "copied" / pixels).stat().st_ino != inode
    assert files_of(tmp_path / "linked") == files_of(tmp_path / "copied")


def test_files_are_copied_if_links_are_not_supported(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(18, "Invalid cross-device link")

    (tmp_path / "a").write_text("1")
    monkeypatch.setattr("os.link", refuse)
    copier = FileCopier(link=True)
    copier.copy_file(tmp_path / "a", tmp_path / "b")
    assert (copier.linked, copier.copied, copier.link) == (0, 1, False)
    assert (tmp_path / "b").read_text() == "1"


def test_origin_of_a_merged_episode_is_kept(parts, tmp_path):
    merge(parts, tmp_path / "once")
    merge([tmp_path / "once"], tmp_path / "twice")
    entry = read(tmp_path / "twice" / "conversion.json")["episodes"]["3"]
    assert entry["from"] == {"dataset": "once", "episode": 3, "from": {"dataset": "b", "episode": 1}}


def test_duplicates(parts, tmp_path):
    a, b = parts
    merge([a, b], tmp_path / "ab")
    with pytest.raises(DatasetError, match="duplicate recordings .found 2: b 0 = ab 2, b 1 = ab 3.*--skip-dup"):
        merge([b, tmp_path / "ab"], tmp_path / "out")
    assert not (tmp_path / "out").exists()
    done = merge([b, tmp_path / "ab"], tmp_path / "out", skip_duplicates=True)
    assert (done.episodes, done.skipped) == (4, 2)
    seeds = [entry["seed"] for entry in read(tmp_path / "out" / "conversion.json")["episodes"].values()]
    assert seeds == [20, 21, 10, 11]
    assert validate(tmp_path / "out").violations == []


def test_duplicates_of_unknown_recordings_are_found_by_their_arrays(parts, tmp_path):
    first = spoiled(parts[0], tmp_path)
    edit(first / "conversion.json", lambda c: [e.update(recording=None) for e in c["episodes"].values()])
    second = shutil.copytree(first, tmp_path / "again")
    with pytest.raises(DatasetError, match="duplicate recordings .found 2"):
        merge([first, second], tmp_path / "out")


def in_conversion(change):
    return lambda part: edit(part / "conversion.json", change)


UNFIT = {  # what is wrong with one of the datasets -> (how it comes about, what the message says)
    "an older schema": (in_conversion(lambda c: c.pop("schema_version")), "Convert the recording again"),
    "RoboCAS-v0": (lambda part: (part / "conversion.json").unlink(), "import-robocas"),
    "a newer schema": (in_conversion(lambda c: c.update(schema_version=3)), "Update robocas_ms3"),
    "an episode of an older schema": (
        lambda part: (part / "episode_0000001/scene.json").unlink(),
        "unsupported schema version of an episode",
    ),
    "other settings": (in_conversion(lambda c: c.update(rate_hz=10.0)), "settings of the datasets differ"),
    "an episode is gone": (
        lambda part: shutil.rmtree(part / "episode_0000001"),
        "listed episodes differ from those on disk",
    ),
    "no overview": (lambda part: (part / "data_info.json").unlink(), "this dataset is unfinished"),
    "an unlisted episode": (in_conversion(lambda c: c["episodes"].pop("1")), "episodes on disk are not listed"),
    "nothing": (shutil.rmtree, "no dataset here"),
    "a split of texts": (
        lambda part: edit(part / "data_info.json", lambda c: c.update(val_eps=["x"])),
        "invalid value",
    ),
    "a split of flags": (
        lambda part: edit(part / "data_info.json", lambda c: c.update(val_eps=[True])),
        "invalid value",
    ),
    "no split": (lambda part: edit(part / "data_info.json", lambda c: c.update(val_eps=None)), "invalid value"),
}


@pytest.mark.parametrize("name", UNFIT)
def test_datasets_that_do_not_fit_together(parts, tmp_path, name):
    part, (spoil, message) = spoiled(parts[0], tmp_path), UNFIT[name]
    spoil(part)
    with pytest.raises(DatasetError, match=message) as caught:
        merge([parts[1], part], tmp_path / "out")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()
    if "split" in name:
        resplit(part, SplitOptions(0.5))  # as the message says
        merge([part], tmp_path / "out")


def test_a_split_of_texts_is_read_as_numbers(parts, tmp_path):
    part = spoiled(parts[0], tmp_path)
    sides = Dataset(part).splits
    edit(part / "data_info.json", lambda c: c.update({k: list(map(str, c[k])) for k in ("train_eps", "val_eps")}))
    merge([part], tmp_path / "out")
    assert sides[1]
    assert Dataset(tmp_path / "out").splits == sides
    assert resplit(part) == sides


def test_append_keeps_a_split_of_texts(parts, tmp_path):
    part = spoiled(parts[0], tmp_path)
    sides = Dataset(part).splits[::-1]  # not the rule's
    edit(part / "data_info.json", lambda c: c.update(train_eps=[str(*sides[0])], val_eps=[str(*sides[1])]))
    for number, seed in ((0, [10]), (1, [11])):  # as ManiSkill writes seeds
        edit(part / f"episode_000000{number}" / "scene.json", lambda c, seed=seed: c.update(seed=seed))
    trajectory = write_trajectory(tmp_path / "more.h5", seeds=(30,))
    convert(trajectory, part, append=True)
    train, val = Dataset(part).splits
    assert ([n for n in train if n < 2], [n for n in val if n < 2]) == sides


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_episode_is_reported_before_writing(parts, tmp_path, damage):
    part = spoiled(parts[0], tmp_path)
    spoil, file = DAMAGES[damage]
    spoil(part / "episode_0000001")
    with pytest.raises(DatasetError) as error:
        merge([parts[1], part], tmp_path / "out")
    assert str(error.value.where) == f"{part}/episode_0000001/{file}"
    assert not (tmp_path / "out").exists()


def test_damaged_input_does_not_overwrite_the_output(parts, tmp_path):
    part = spoiled(parts[0], tmp_path)
    merge([parts[1]], tmp_path / "out")
    before = files_of(tmp_path / "out")
    (part / "episode_0000000" / "static_camera" / "rgb" / "0000.png").unlink()
    with pytest.raises(DatasetError, match="this episode is damaged"):
        merge([part], tmp_path / "out", options=CopyOptions(overwrite=True))
    assert files_of(tmp_path / "out") == before


def test_arrays_missing_since_the_import_are_accepted(parts, tmp_path):
    part = spoiled(parts[0], tmp_path)
    change(part / "episode_0000001", base_pos=None)
    with pytest.raises(DatasetError, match="episode_0000001/episode_info.npz, base_pos"):
        merge([part], tmp_path / "out")
    edit(part / "episode_0000001" / "scene.json", lambda s: s["source"].update(missing=["base_pos"]))
    assert merge([part], tmp_path / "out").episodes == 2


def test_the_output(parts, tmp_path):
    a, b = parts
    before = files_of(a)
    for out in (a, a / "inside", a.parent):
        with pytest.raises(DatasetError, match="the output folder overlaps an input"):
            merge([a, b], out, options=CopyOptions(overwrite=True))
    assert files_of(a) == before
    merge([a], tmp_path / "out")
    assert merge([a], tmp_path / "out").existing == 2
    with pytest.raises(OutputExistsError) as error:
        merge([a, b], tmp_path / "out")
    assert error.value.where == tmp_path / "out" / "conversion.json"
    merge([a, b], tmp_path / "out", options=CopyOptions(overwrite=True))
    assert len(Dataset(tmp_path / "out").numbers) == 4
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years of work")
    for overwrite in (False, True):
        with pytest.raises(OutputExistsError):
            merge([a, b], tmp_path / "mine", options=CopyOptions(overwrite=overwrite))
    assert (tmp_path / "mine" / "thesis.tex").exists()
    with lock_folder(tmp_path / "locked"), pytest.raises(RobocasError, match="another process writes to this folder"):
        merge([a], tmp_path / "locked")


def test_command(parts, tmp_path, capsys):
    words = ["merge", *map(str, parts), str(parts[0]), "--out", str(tmp_path / "out")]
    assert run(words) == 1
    assert capsys.readouterr().err.startswith("error: ")
    assert run([*words, "--skip-duplicates", "--copy"]) == 0
    assert "4 episodes, 0 files linked, 224 copied, 2 duplicates skipped" in capsys.readouterr().out


def test_command_without_datasets(tmp_path, capsys):
    assert run(["merge", "--out", str(tmp_path / "out")]) == 2
    assert "missing dataset folders" in capsys.readouterr().err


def test_a_merged_dataset_can_be_appended_to(parts, tmp_path):
    merge(parts, tmp_path / "out")
    known = convert(parts[1].with_suffix(".h5"), tmp_path / "out", append=True)
    assert (known.existing, known.episodes) == (2, [])
    new = convert(write_trajectory(tmp_path / "c.h5", seeds=(30,)), tmp_path / "out", append=True)
    assert [episode.number for episode in new.episodes] == [4]
    assert validate(parts[0]).violations == []  # whose files are shared
    assert validate(tmp_path / "out").violations == []
