import shutil
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from managing import DAMAGES, edit, files_of, make, read

from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.manage import split
from robocas_ms3.datasets.manage.merge import merge
from robocas_ms3.datasets.manage.split import (
    SplitOptions,
    divide_episodes,
    group_episodes,
    make_folder_names,
    resplit,
    split_by_fractions,
)
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.sources.split import split_by_seed


@pytest.fixture(scope="module")
def six(tmp_path_factory):
    """A dataset of six seeds, for reading only."""
    return make(tmp_path_factory.mktemp("six"), "six", range(6))


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(0, 30), min_size=3, max_size=80),
    st.sampled_from([[0.9, 0.1], [0.5, 0.5], [0.6, 0.3, 0.1]]),
)
def test_groups_stay_together_and_no_list_is_empty(values, shares):
    groups = {number: str(value) for number, value in enumerate(values)}
    if len(set(values)) < len(shares):
        with pytest.raises(DatasetError, match="too few groups of episodes to split"):
            divide_episodes(groups, shares)
        return
    parts = divide_episodes(groups, shares)
    assert sorted(number for part in parts for number in part) == list(groups)
    inside = [{groups[number] for number in part} for part in parts]
    assert all(inside)
    assert sum(map(len, inside)) == len(set(values))


@pytest.mark.parametrize("count", [2, 10, 47, 200])
def test_tenth_by_seed_equals_the_split_of_convert(count):
    seeds = {number: 1000 + number for number in range(count)}
    assert divide_episodes({n: str(seed) for n, seed in seeds.items()}, [0.9, 0.1]) == list(split_by_seed(seeds))


def test_parts_have_training_and_validation_episodes():
    """With 800 episodes, as in `reproduce_small.sh`."""
    seeds = {number: 510000 + number for number in range(800)}
    dataset = SimpleNamespace(splits=split_by_seed(seeds))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(split, "group_episodes", lambda dataset, by: {n: str(seed) for n, seed in seeds.items()})
        for share in (0.5, 0.25, 0.0625):
            for train, val in split_by_fractions(dataset, [share, 1 - share], "seed", None).values():
                assert 0.04 < len(val) / (len(train) + len(val)) < 0.2


def test_fractions():
    groups = {number: str(number) for number in range(100)}
    assert [len(part) for part in divide_episodes(groups, [0.7, 0.2, 0.1])] == [70, 20, 10]
    for wrong in ([1.0], [0.5, 0.6], [1.0, 0.0]):
        with pytest.raises(DatasetError, match="invalid fractions"):
            divide_episodes(groups, wrong)


def test_training_and_validation_as_datasets(six, tmp_path):
    train, val = tmp_path / "train", tmp_path / "val"
    assert run(["split", str(six), "--out-train", str(train), "--out-val", str(val)]) == 0
    info = read(six / "data_info.json")
    for out, side, empty in ((train, "train_eps", "val_eps"), (val, "val_eps", "train_eps")):
        old = info[side]
        new = read(out / "data_info.json")
        assert (new[side], new[empty]) == (list(range(len(old))), [])
        for number, source in enumerate(old):
            assert files_of(out / f"episode_{number:07d}") == files_of(six / f"episode_{source:07d}")
            entry = read(out / "conversion.json")["episodes"][str(number)]
            assert entry["from"] == {"dataset": "six", "episode": source}
        assert validate(out).violations == []


def test_split_and_merge_again(six, tmp_path, capsys):
    words = ["split", str(six), "--fractions", "0.5", "0.5", "--out", str(tmp_path / "parts")]
    assert run(words) == 0
    assert capsys.readouterr().out.count("3 episodes") == 2
    parts = [tmp_path / "parts" / f"part_{index}" for index in range(2)]
    assert all(validate(part).violations == [] for part in parts)
    merge(parts, tmp_path / "back")
    old, new = (read(root / "conversion.json")["episodes"] for root in (six, tmp_path / "back"))
    assert sorted(e["seed"] for e in new.values()) == sorted(e["seed"] for e in old.values())
    seeds = []
    for root, ledger in ((six, old), (tmp_path / "back", new)):
        validates = read(root / "data_info.json")["val_eps"]
        seeds.append({ledger[str(number)]["seed"] for number in validates})
    assert seeds[0] == seeds[1]
    assert run(["split", str(six), "--fractions", "0.3", "0.7", "--out", str(tmp_path / "parts")]) == 1
    assert "written with other settings" in capsys.readouterr().err
    shutil.rmtree(parts[1])
    assert run(words) == 0


def test_by_target_and_task(six, tmp_path):
    root = shutil.copytree(six, tmp_path / "ds")
    for number, (task, target) in enumerate([("pick", "cup"), ("pick", "can"), ("search", "cup")] * 2):
        scene = root / f"episode_{number:07d}" / "scene.json"
        whole = {"slot": 0, "asset_id": target, "name": target}
        edit(scene, lambda s, task=task, whole=whole: s.update(task=task, target=whole))
    assert run(["split", str(root), "--group-by", "task", "--out", str(tmp_path / "tasks")]) == 0
    assert {path.name: len(Dataset(path).numbers) for path in (tmp_path / "tasks").iterdir()} == {
        "pick": 4,
        "search": 2,
    }
    again = tmp_path / "again"
    assert run(["split", str(root), "--group-by", "task", "--out", str(again), "--val-fraction", "0.3"]) == 0
    assert {path.name: len(read(path / "data_info.json")["val_eps"]) for path in again.iterdir()} == {
        "pick": 1,
        "search": 1,
    }
    assert "seeds in the order of sha256(seed)" in read(again / "pick" / "conversion.json")["split"]
    assert run(["split", str(root), "--in-place", "--group-by", "target", "--val-fraction", "0.3"]) == 0
    info, targets = read(root / "data_info.json"), group_episodes(Dataset(root), "target")
    sides = [{targets[n] for n in info[side]} for side in ("train_eps", "val_eps")]
    assert sorted(map(len, sides)) == [1, 1]
    assert not sides[0] & sides[1]
    assert validate(root).violations == []


def test_folder_names_stay_inside_the_output(six, tmp_path):
    root = shutil.copytree(six, tmp_path / "ds")
    for number in range(6):
        target = {"asset_id": "../../pack/cup"}
        edit(root / f"episode_{number:07d}" / "scene.json", lambda s, target=target: s.update(target=target))
    assert run(["split", str(root), "--group-by", "target", "--out", str(tmp_path / "targets")]) == 0
    assert [path.name for path in (tmp_path / "targets").iterdir()] == ["_.._pack_cup"]


def test_folder_names_are_distinct():
    names = make_folder_names(["a b", "a_b", "c"])
    assert len(set(names.values())) == 3
    assert names["c"] == "c"
    assert names["a b"].startswith("a_b-")
    assert make_folder_names(["a b", "c"])["a b"] == "a_b"


def test_in_place_writes_two_files_only(six, tmp_path):
    root = shutil.copytree(six, tmp_path / "ds")
    before = files_of(root)
    train, val = resplit(root, SplitOptions(0.5))
    assert (len(train), len(val)) == (3, 3)
    after = files_of(root)
    assert {name for name in after if after[name] != before.get(name)} == {"data_info.json", "conversion.json"}
    assert "first 0.5 of the episodes" in read(root / "conversion.json")["split"]
    assert validate(root).violations == []
    again = resplit(root)  # sides stay
    assert again == (train, val)
    assert files_of(root) == after


def test_in_place_accepts_the_episodes_on_disk(six, tmp_path):
    root = shutil.copytree(six, tmp_path / "ds")
    info = read(root / "data_info.json")
    gone = info["train_eps"][0]
    shutil.rmtree(root / f"episode_{gone:07d}")
    assert validate(root).violations
    train, val = resplit(root)
    assert (train, val) == (info["train_eps"][1:], info["val_eps"])
    assert validate(root).violations == []
    (root / "data_info.json").unlink()
    assert sorted(sum(resplit(root), [])) == sorted(train + val)


def test_invalid_options(six, tmp_path, capsys):
    out = str(tmp_path / "out")
    for words, code, text in [
        ([], 2, "--out: wrong number of output options"),
        (["--out-train", out], 2, "--out-train: missing second output folder"),
        (["--in-place", "--out", out, "--group-by", "task"], 2, "found --in-place, --out)"),
        (["--fractions", "0.5", "0.5", "--in-place"], 2, "--fractions: missing output folder"),
        (["--out", out], 2, "--out: missing rule of the split"),
        (["--out-train", out, "--out-val", f"{out}/val"], 1, "overlaps the validation folder"),
        (["--in-place", "--group-by", "seed"], 2, "--group-by: missing fraction"),
        (
            ["--in-place", "--val-fraction", "1.5"],
            2,
            "--val-fraction: invalid fraction (expected > 0 and < 1, found 1.5",
        ),
        (
            ["--in-place", "--val-fraction", "0"],
            2,
            "--val-fraction: invalid fraction (expected > 0 and < 1, found 0.0",
        ),
        (
            ["--in-place", "--val-fraction", "nan"],
            2,
            "--val-fraction: invalid fraction (expected > 0 and < 1, found nan",
        ),
        (["--fractions", "0.9", "0.2", "--out", out], 2, "--fractions: invalid fractions"),
    ]:
        assert run(["split", str(six), *words]) == code
        assert text in capsys.readouterr().err
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("damage", ["pickles", "cut off"])
def test_damaged_episode_is_reported_before_writing(six, tmp_path, capsys, damage):
    root = shutil.copytree(six, tmp_path / "ds")
    spoil, file = DAMAGES[damage]
    spoil(root / "episode_0000004")
    assert run(["split", str(root), "--fractions", "0.5", "0.5", "--out", str(tmp_path / "out")]) == 1
    assert f"{root}/episode_0000004/{file}: " in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("damage", ["infinite ee_pos", "no archive"])
def test_in_place_changes_nothing_if_arrays_are_damaged(six, tmp_path, damage):
    root = shutil.copytree(six, tmp_path / "ds")
    spoil, file = DAMAGES[damage]
    spoil(root / "episode_0000004")
    before = files_of(root)
    with pytest.raises(DatasetError, match=f"episode_0000004/{file}: this episode is damaged"):
        resplit(root, SplitOptions(0.5))
    assert files_of(root) == before


def test_unknown_targets(six, tmp_path):
    root = shutil.copytree(six, tmp_path / "ds")
    edit(root / "episode_0000003" / "scene.json", lambda s: s.update(target=None))
    with pytest.raises(DatasetError, match="episode_0000003.*unknown target.*another --group-by"):
        group_episodes(Dataset(root), "target")
    edit(root / "episode_0000003" / "scene.json", lambda s: s.update(seed=None))
    assert group_episodes(Dataset(root), "seed")[3] == "3"
