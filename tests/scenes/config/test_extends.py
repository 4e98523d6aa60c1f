"""The key ``extends``: finding base files, merging values, and the file named by an error."""

import os

import pytest
import yaml

from robocas_ms3.core.errors import ConfigError
from robocas_ms3.scenes.config import bundled_configs, load_task_config
from robocas_ms3.scenes.config.load import CHAIN_LIMIT, check_no_extends


def write(folder, **files):
    for name, values in files.items():
        text = values if isinstance(values, str) else yaml.safe_dump(values, sort_keys=False)
        (folder / f"{name}.yaml").write_text(text)
    return folder / f"{next(iter(files))}.yaml"


def error_of(path, **kwargs) -> ConfigError:
    with pytest.raises(ConfigError) as caught:
        load_task_config(path, **kwargs)
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize(
    ("base", "mine", "expected"),  # expected: keys of the block that differ from the shipped ones
    [
        ("", "objects: {count: 6}", {"count": 6}),
        (
            "target: {max_distance: 0.5}",
            "target: {relations: [leftmost]}",
            {"max_distance": 0.5, "relations": ["leftmost"]},
        ),
        ("objects: {ids: [14], count: 2}", "objects: {ids: [12, 13]}", {"ids": [12, 13], "count": 2}),
        ("layout: {min_gap: 0.03}", "layout: {kind: scattered}", {"min_gap": 0.03}),
        ("lights: {ambient: 1.0}", "lights: {ambient: null}", {"ambient": 0.4}),  # the default
        ("randomisation: {robot: {yaw_deg: 9}}", "randomisation: {robot: null}", {"robot": None}),
        ("", "target: {max_visible_share: null}", {"max_visible_share": None}),  # null is its value
    ],
)
def test_mappings_are_merged_other_values_replaced_and_null_removes(tmp_path, base, mine, expected):
    path = write(tmp_path, mine=f"extends: base.yaml\n{mine}", base=f"extends: pick_table_scattered\n{base}")
    data = load_task_config("pick_table_scattered").model_dump(mode="json")
    data[mine.partition(":")[0]] |= expected
    assert load_task_config(path) == load_task_config(data)


def test_layout_of_another_kind_replaces_the_base_layout(tmp_path):
    path = write(tmp_path, mine={"extends": "pick_table_scattered", "layout": {"kind": "orderly", "copies": 1}})
    assert load_task_config(path).layout.copies == 1


def test_a_path_is_relative_to_the_extending_file(tmp_path, monkeypatch):
    (tmp_path / "near").mkdir()
    write(tmp_path / "near", mine={"extends": "../base.yaml", "objects": {"count": 3}})
    write(tmp_path, base={"extends": "pick_table_scattered", "support": "plate"})
    monkeypatch.chdir("/")
    config = load_task_config(tmp_path / "near" / "mine.yaml")
    assert (config.objects.count, config.support) == (3, "plate")


def test_a_base_may_be_incomplete(tmp_path):
    data = load_task_config("pick_table_scattered").model_dump(mode="json")
    base = {"room": data.pop("room"), "layout": data.pop("layout")}
    path = write(tmp_path, mine={"extends": "base.yaml", **data}, base=base)
    assert load_task_config(path) == load_task_config("pick_table_scattered")
    assert error_of(tmp_path / "base.yaml").found == "nothing"


def test_null_removes_furniture_and_a_new_name_takes_its_position(tmp_path):
    table = load_task_config("pick_table_scattered").model_dump(mode="json")["furniture"]["table"]
    furniture = {"shelf": None, "desk": table}
    path = write(
        tmp_path,
        mine={"extends": "pick_shelf_scattered", "furniture": furniture, "surface": {"furniture": "desk"}},
    )
    assert list(load_task_config(path).furniture) == ["desk", "side_table"]
    path = write(tmp_path, mine={"extends": "pick_shelf_scattered", "furniture": {"side_tabel": None}})
    error = error_of(path)
    assert error.where == str(path)
    assert error.fix == "Did you mean side_table?"


def test_invalid_key_names_its_file(tmp_path):
    files = {
        "mine": {"extends": "middle.yaml", "objects": {"count": 3}},
        "middle": {"extends": "base.yaml", "layout": {"min_gapp": 0.1}},
        "base": {"extends": "pick_table_scattered", "objects": {"count": "ten", "repeats": True}},
    }
    path = write(tmp_path, **files)
    error = error_of(path)  # `count` is right in the extending file
    assert error.where == f"{tmp_path / 'middle.yaml'} (extended by {path})"
    assert error.fix == "Did you mean min_gap?"
    path = write(tmp_path, **{**files, "middle": {"extends": "base.yaml", "objects": {"ids": ["apple", 1.5]}}})
    error = error_of(path)
    assert "'objects.ids.1'" in error.what
    assert str(error.where).startswith(str(tmp_path / "middle.yaml"))
    path = write(tmp_path, mine={"extends": "pick_table_scattered", "layout": {"kind": "stackd"}})
    assert error_of(path).where == str(path)


def test_error_from_several_files_names_all_of_them(tmp_path):
    path = write(tmp_path, mine={"extends": "pick_table_scattered", "surface": {"min_xy": [0.4, 0.0]}})
    assert error_of(path).where == f"{path} (extends {bundled_configs()['pick_table_scattered']})"


@pytest.mark.parametrize(
    ("named", "fix"),
    [
        (["pick_heap"], ""),
        (None, ""),
        ("", ""),
        ("pick_table_scatered", "pick_table_scattered"),
        ("bsae.yaml", "base.yaml"),
        ("base", "base.yaml"),
        ("x" * 5000 + ".yaml", ""),
        ("a\0b.yaml", ""),
        ("folder.yaml", ""),
        ("pipe.yaml", ""),
    ],
    ids=lambda value: repr(value)[:20],
)
def test_a_base_is_a_name_or_a_file(tmp_path, named, fix):
    (tmp_path / "folder.yaml").mkdir()
    os.mkfifo(tmp_path / "pipe.yaml")
    path = write(tmp_path, mine={"extends": named}, base={})
    error = error_of(path)
    assert error.where == f"{path}, extends"
    assert fix in error.fix


def test_a_cycle_is_an_error(tmp_path):
    path = write(tmp_path, mine={"extends": "other.yaml"}, other={"extends": "mine.yaml"})
    error = error_of(path)
    assert error.where == f"{tmp_path / 'other.yaml'}, extends"
    assert str(error.found).count(" -> ") == 2
    assert "in a cycle" in str(error_of(write(tmp_path, self={"extends": "self.yaml"})))


def test_a_chain_has_a_limit(tmp_path):
    names = [f"base_{number}.yaml" for number in range(CHAIN_LIMIT)]
    for name, base in zip(names, [*names[1:], "pick_table_scattered"], strict=True):
        (tmp_path / name).write_text(f"extends: {base}\n")
    assert load_task_config(tmp_path / names[1]) == load_task_config("pick_table_scattered")
    assert error_of(tmp_path / names[0]).expected == f"at most {CHAIN_LIMIT} files"


@pytest.mark.parametrize("text", ["- a", "", "lights: &a {ambient: *a}"])
def test_error_names_an_invalid_base(tmp_path, text):
    path = write(tmp_path, mine={"extends": "base.yaml"}, base=text)
    assert str(error_of(path).where).startswith(str(tmp_path / "base.yaml"))


def test_files_of_protocols_may_not_extend():
    with pytest.raises(ConfigError, match="extends"):
        load_task_config({"extends": "pick_table_scattered"})
    error = error_of("pick_table_scattered", changes={"extends": "pick_table_scattered"})
    assert error.where == "changes"
    check_no_extends(bundled_configs()["pick_table_scattered"])
    with pytest.raises(ConfigError, match="not allowed in a protocol"):
        check_no_extends(bundled_configs()["pick_shelf_scattered"])
