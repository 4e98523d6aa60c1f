"""Overrides of keys (``--set``), and their effect on commands."""

import json

import pytest
import yaml

from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import ConfigError
from robocas_ms3.evaluation.protocols.freeze import ProtocolSource
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.config.compose import parse_set_option

NAME = "pick_table_scattered"
FILE_CHANGED = {"extends": NAME, "objects": {"count": 5, "repeats": True}}


@pytest.mark.parametrize(
    ("text", "nested"),
    [
        ("objects.count=12", {"objects": {"count": 12}}),
        ("support=a=b", {"support": "a=b"}),
        ("target.max_distance=3e-1", {"target": {"max_distance": 0.3}}),
        ("surface.min_xy=[1e-1, -2.5E+0]", {"surface": {"min_xy": [0.1, -2.5]}}),
        ("support='1e5'", {"support": "1e5"}),
        ("support=1e5x", {"support": "1e5x"}),
        ("support=nan", {"support": "nan"}),
        ("support=''", {"support": ""}),
        ("opening=~", {"opening": None}),
        ("opening=null", {"opening": None}),
    ],
)
def test_values_are_yaml_and_dots_separate_keys(text, nested):
    assert parse_set_option(text, ConfigError, "a=1") == nested


@pytest.mark.parametrize("text", ["objects.count", "=3", "objects.=3", ".count=3", "a=[1", " a=1", "", "a=", "a=#3"])
def test_an_invalid_override_is_an_error(text):
    with pytest.raises(ConfigError) as caught:
        parse_set_option(text, ConfigError, "a=1")
    assert (caught.value.where, caught.value.found) == ("--set", text)


def test_overrides_are_merged_over_a_file_in_order(tmp_path):
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(FILE_CHANGED))
    overrides = ("objects.count=6", "objects.count=7", "layout.kind=stacked")
    config = load_task_config(tmp_path / "mine.yaml", set_options=overrides)
    assert (config.objects.count, config.objects.repeats, config.layout.kind) == (7, True, "stacked")
    loaded = load_task_config(NAME)
    assert load_task_config(loaded, set_options=["objects.count=3"]).objects.count == 3
    assert load_task_config(NAME, set_options=["objects.count=3", "objects.count=null"]) == loaded
    source = ProtocolSource.model_validate(
        {"rules": {}, "parts": [{"config": NAME, "count": 1, "first_seed": 0, "change": {"objects": {"count": 3}}}]}
    )
    assert source.parts[0].load_config(["objects.count=4"]).objects.count == 4


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("objects.cout=3", ["'objects.cout'", "one of count, ids", "Did you mean count?"]),
        ("room=null", ["'room'", "this key"]),
        ("furniture.tabel=null", ["furniture.tabel", "Did you mean table?"]),
        ("extends=pick_heap", ["extends", "YAML files"]),
    ],
)
def test_errors_name_the_option(text, words):
    with pytest.raises(ConfigError) as caught:
        load_task_config(NAME, set_options=["objects.repeats=true", text])
    assert caught.value.where == f"--set {text}"
    assert [word for word in words if word not in str(caught.value)] == []
    with pytest.raises(ConfigError) as caught:  # a rule between keys is violated
        load_task_config(NAME, set_options=["surface.furniture=desk"])
    assert str(caught.value.where).endswith(f"{NAME}.yaml with --set surface.furniture=desk")


def test_show_prints_a_resolved_configuration_that_loads_again(tmp_path, capsys):
    words = ["show", "select_shelf_orderly", "--set", "objects.count=12", "--set", "layout.copies=4", "--print-config"]
    assert run([*words, "--out", str(tmp_path / "out")]) == 0
    (tmp_path / "printed.yaml").write_text(capsys.readouterr().out)
    overrides = ("objects.count=12", "layout.copies=4")
    assert load_task_config(tmp_path / "printed.yaml") == load_task_config(
        "select_shelf_orderly", set_options=overrides
    )
    assert "extends" not in yaml.safe_load((tmp_path / "printed.yaml").read_text())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "words",
    [
        ["generate", "pick", "--out", "out"],
        ["layouts", "build", NAME, "--out", "out"],
        ["eval", "freeze", "plan.yaml", "--out", "out"],
    ],
)
def test_invalid_key_is_an_error_of_commands_and_writes_nothing(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    part = {"config": NAME, "count": 1, "first_seed": 0}
    plan = {"rules": {"name": "a", "description": "b", "max_seconds": {"pick": 5}}, "parts": [part]}
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(plan))
    assert run([*words, "--set", "objects.cout=3"]) == 2
    assert capsys.readouterr().err.startswith("error: --set objects.cout=3: unknown key 'objects.cout'")
    assert [path.name for path in tmp_path.iterdir()] == ["plan.yaml"]


@pytest.mark.slow
def test_recording_stores_the_resolved_configuration_and_rejects_another(tmp_path, capsys):
    out = tmp_path / "out"
    words = ["generate", "pick", "-n", "1", "--out", str(out), "--check-rate", "0", "--set"]
    assert run([*words, "objects.count=3"]) == 0
    expected = load_task_config(NAME, set_options=["objects.count=3"]).model_dump(mode="json")
    assert json.loads((out / "run.json").read_text())["settings"]["config"] == expected
    recorded = json.loads((out / "trajectory.json").read_text())["env_info"]["env_kwargs"]["config"]
    assert recorded == expected
    before = {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}
    capsys.readouterr()
    assert run([*words, "objects.count=4"]) == 1
    assert "settings.config.objects.count: 3 -> 4" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()} == before
    assert run([*words, "objects.count=3"]) == 0
