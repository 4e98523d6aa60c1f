import json

import pytest

from robocas_ms3.cli.list import List, list_all, main
from robocas_ms3.cli.main import run
from robocas_ms3.core.paths import data_dir
from robocas_ms3.scenes.config import bundled_configs, load_task_config


def test_tasks_and_configs_are_listed():
    found = list_all()
    assert {"name": "pick", "env_id": "RoboCASPick-v1"}.items() <= found["tasks"][0].items()
    configs = {row["name"]: row for row in found["configs"]}
    assert configs.keys() == bundled_configs().keys()
    for name, row in configs.items():
        assert row["description"], f"{name} has no description"
        assert row["scene"].startswith(f"{load_task_config(name).objects.count} objects")
        assert row["needs_pack"] == (["partnet"] if "partnet" in name else [])
    assert sum(bool(row["needs_pack"]) for row in configs.values()) == 6


def test_builtin_pack_is_listed():
    packs = {row["name"]: row for row in list_all()["packs"]}
    assert len(packs["builtin"]["objects"]) >= 10
    assert {"table", "basket", "room"} <= set(packs["builtin"]["furniture"])
    assert packs["builtin"]["error"] == ""
    assert 0.1 < packs["builtin"]["megabytes"] < 100


@pytest.fixture
def damaged_pack():
    folder = data_dir() / "packs" / "broken"
    folder.mkdir(parents=True)
    (folder / "manifest.json").write_text("{")
    yield
    (folder / "manifest.json").unlink()
    folder.rmdir()


def test_damaged_pack_is_listed_with_its_error(damaged_pack, capsys):
    assert main(List(json=True)) == 0
    packs = {row["name"]: row for row in json.loads(capsys.readouterr().out)["packs"]}
    assert "manifest" in packs["broken"]["error"]
    assert packs["broken"]["objects"] == []
    assert main(List()) == 0
    assert "damaged" in capsys.readouterr().out
    assert run(["assets", "list"]) == 0
    listed = capsys.readouterr().out
    assert "broken" in listed and "builtin" in listed


def test_names_are_not_wrapped(capsys, monkeypatch):
    names = [*bundled_configs(), "RoboCASOpenPick-v1"]
    assert main(List()) == 0
    piped = capsys.readouterr().out
    assert [name for name in names if f" {name} " not in piped] == []
    assert max(map(len, piped.splitlines())) == 200
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "dumb")
    assert main(List()) == 0
    narrow = capsys.readouterr().out
    assert [name for name in names if f" {name} " not in narrow] == []
