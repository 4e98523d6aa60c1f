import copy

import pytest
import yaml

from robocas_ms3.core.errors import ConfigError
from robocas_ms3.scenes.config import TaskConfig, load_task_config, shipped_configs

SHIPPED = yaml.safe_load(shipped_configs()["pick_table_scattered"].read_text())


def changed(path: str, value=None, *, remove: bool = False) -> dict:
    data = copy.deepcopy(SHIPPED)
    *folders, last = path.split(".")
    node = data
    for part in folders:
        node = node[part]
    if remove:
        del node[last]
    else:
        node[last] = value
    return data


@pytest.mark.parametrize("name", sorted(shipped_configs()))
def test_shipped_configurations_load(name):
    config = load_task_config(name)
    assert isinstance(config, TaskConfig)
    assert config.description


def test_the_scattered_pick_has_upstreams_numbers():
    config = load_task_config("pick_table_scattered")
    assert config.furniture["table"].pose.position == (0.9, 1.0, 0.0)
    assert config.robot.position == (0.7, 0.15, 0.0)
    assert config.robot.yaw_deg == 90
    assert (config.surface.min_xy, config.surface.max_xy) == ((0.0, -0.45), (0.3, 0.25))
    assert config.basket.pose.position == (1.3, 0.9, 0.61)
    assert config.objects.count == 10


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("colour", "red", ["unknown key 'colour'", "layout", "found 'colour'"]),
        ("layout.min_gapp", 0.1, ["unknown key 'layout.min_gapp'", "min_gap"]),
        ("furniture.table.pose.x", 1, ["'furniture.table.pose.x'", "position"]),
        ("objects.count", "ten", ["'objects.count'", "a whole number", "'ten'"]),
        ("objects.count", 0, ["'objects.count'", "greater than or equal to 1", "0"]),
        ("robot.yaw_deg", "90", ["'robot.yaw_deg'", "a number", "'90'"]),
        ("surface.furniture", "desk", ["surface.furniture", "['table']", "'desk'"]),
        ("surface.min_xy", [0.4, 0.0], ["min_xy", "below max_xy"]),
        ("randomisation", {"object_sets": []}, ["'randomisation.object_sets'", "at least 1 item", "[]"]),
        ("robot_start", "folded", ["'robot_start'", "'rest'", "'evaluation'", "'folded'"]),
        ("task", "juggle", ["'task'", "'pick'", "'juggle'"]),
    ],
)
def test_mistakes_name_file_key_expected_and_found(tmp_path, path, value, words):
    file = tmp_path / "mine.yaml"
    file.write_text(yaml.safe_dump(changed(path, value)))
    with pytest.raises(ConfigError) as error:
        load_task_config(file)
    message = str(error.value)
    assert message.startswith(str(file))
    assert "\n" not in message
    for word in words:
        assert word in message


def test_a_missing_key_is_named():
    with pytest.raises(ConfigError, match="'room'.*expected this key, found nothing"):
        load_task_config(changed("room", remove=True))


def test_a_key_given_twice_is_an_error(tmp_path):
    file = tmp_path / "twice.yaml"
    file.write_text("task: pick\ntask: pick\n")
    with pytest.raises(ConfigError, match="'task' is given twice"):
        load_task_config(file)


def test_broken_yaml_and_missing_files_are_errors(tmp_path):
    file = tmp_path / "broken.yaml"
    file.write_text("task: [pick")
    with pytest.raises(ConfigError, match="not valid YAML"):
        load_task_config(file)
    with pytest.raises(ConfigError, match="no such task configuration.*pick_table_scattered"):
        load_task_config("pick_table_scatered")


def test_a_loaded_configuration_survives_a_round_trip():
    config = load_task_config("pick_table_scattered")
    assert load_task_config(config.model_dump(mode="json")) == config


def test_a_missing_file_is_called_missing(tmp_path):
    with pytest.raises(ConfigError, match="no such file") as found:
        load_task_config(tmp_path / "mine_of_the_lab.yaml")
    assert "pick_table_scattered" not in str(found.value)


def test_a_light_needs_a_direction():
    with pytest.raises(ConfigError, match="direction"):
        load_task_config("pick_table_scattered", changes={"lights.direction": [0, 0, 0]})
