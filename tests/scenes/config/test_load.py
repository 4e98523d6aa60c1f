"""Task configurations load; an error is one line with file, key, expected and found value."""

import copy
import logging
from typing import Any

import pytest
import yaml

from robocas_ms3.core.errors import ConfigError
from robocas_ms3.scenes.config import bundled_configs, load_task_config

SHIPPED = yaml.safe_load(bundled_configs()["pick_table_scattered"].read_text())


def changed(path: str, value: Any) -> dict:
    data = copy.deepcopy(SHIPPED)
    *folders, last = path.split(".")
    node = data
    for part in folders:
        node = node[part]
    node[last] = value
    return data


@pytest.mark.parametrize("name", sorted(bundled_configs()))
def test_bundled_configurations_load_repeatedly(name):
    config = load_task_config(name)
    assert config.description
    assert load_task_config(config.model_dump(mode="json")) == config


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("colour", "red", ["unknown key 'colour'", "layout", "found 'colour'"]),
        ("layout.min_gapp", 0.1, ["unknown key 'layout.min_gapp'", "Did you mean min_gap?"]),
        ("furniture.table.pose.x", 1, ["'furniture.table.pose.x'", "position"]),
        ("objects.count", "ten", ["'objects.count'", "a whole number", "'ten'"]),
        ("objects.count", 0, ["'objects.count'", "greater than or equal to 1", "0"]),
        ("robot.yaw_deg", "90", ["'robot.yaw_deg'", "a number", "'90'"]),
        ("surface.furniture", "desk", ["surface.furniture", "expected one of table", "'desk'"]),
        ("surface.min_xy", [0.4, 0.0], ["min_xy", "max_xy"]),
        ("layout.kind", "stackd", ["'layout.kind'", "orderly, scattered, stacked", "Did you mean stacked?"]),
        ("randomisation", {"object_sets": []}, ["'randomisation.object_sets'", "at least 1 item", "[]"]),
        ("randomisation", {"count": [3]}, ["'randomisation.count.1'", "at least 2 items"]),
        ("randomisation", {"count": [3, 2]}, ["randomisation.count", "objects.count 10", "[3, 2]"]),
        ("task", "serch", ["'task'", "one of pick, select,", "'serch'", "Did you mean search?"]),
        ("support", ["x" * 500], ["found ['" + "x" * 78 + "...)"]),
        ("lights", {"direction": [0, 0, 0]}, ["direction"]),
    ],
)
def test_errors_name_file_key_expected_and_found(tmp_path, path, value, words):
    file = tmp_path / "mine.yaml"
    file.write_text(yaml.safe_dump(changed(path, value)))
    with pytest.raises(ConfigError) as error:
        load_task_config(file)
    message = str(error.value)
    assert message.startswith(str(file)) and "\n" not in message
    assert [word for word in words if word not in message] == []


def test_a_missing_key_is_named():
    data = {key: value for key, value in SHIPPED.items() if key != "room"}
    with pytest.raises(ConfigError, match="'room'.*expected this key, found nothing"):
        load_task_config(data)


@pytest.mark.parametrize("text", ["task: pick\ntask: pick\n", "task: [pick"])
def test_invalid_yaml_is_an_error(tmp_path, text):
    file = tmp_path / "broken.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError) as error:
        load_task_config(file)
    assert error.value.where == file


def test_missing_file_gets_the_nearest_names(tmp_path):
    with pytest.raises(ConfigError, match="Did you mean pick_table_scattered") as error:
        load_task_config("pick_table_scatered")
    assert "select_table_rows" not in str(error.value)
    with pytest.raises(ConfigError, match="select_table_rows"):  # no similar name: all names are listed
        load_task_config("xyz")
    with pytest.raises(ConfigError, match="no such configuration file") as error:
        load_task_config(tmp_path / "mine_of_the_lab.yaml")
    assert "pick_table_scattered" not in str(error.value)


def test_an_unknown_support_is_a_warning(tmp_path, caplog):
    file = tmp_path / "mine.yaml"
    with caplog.at_level(logging.WARNING):
        load_task_config("pick_table_scattered")
        assert caplog.messages == []
        file.write_text(yaml.safe_dump(SHIPPED | {"support": "tabel"}))
        assert load_task_config(file).support == "tabel"
    (said,) = caplog.messages
    assert said.startswith(str(file)) and "dining table" in said
