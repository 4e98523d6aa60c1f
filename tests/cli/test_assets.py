"""`robocas assets` on scans of two boxes."""

import json

import pytest
import trimesh

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.cli import main as cli
from robocas_ms3.core.paths import builtin_packs_dir


@pytest.fixture
def scans(tmp_path, monkeypatch):
    """Two boxes in centimetres, with temporary data and cache folders."""
    monkeypatch.setenv("ROBOCAS_DATA", str(tmp_path / "data"))
    monkeypatch.setenv("ROBOCAS_CACHE", str(tmp_path / "cache"))
    folder = tmp_path / "scans"
    folder.mkdir()
    for name, size in (("red_box", (4.0, 6.0, 10.0)), ("blue_box", (3.0, 3.0, 8.0))):
        trimesh.creation.box(size).export(folder / f"{name}.ply")
    return folder


def run(capsys, *words):
    """Return the exit status and the text of both streams."""
    code = cli.run(["assets", *map(str, words)])
    shown = capsys.readouterr()
    return code, shown.out + shown.err


@pytest.mark.slow
def test_import_verify_repair_and_replace(scans, tmp_path, capsys):
    importing = ("import-scans", scans, "--pack", "mine", "--jobs", 1)
    code, shown = run(capsys, *importing)
    assert code == 0 and "red_box" in shown
    pack = tmp_path / "data" / "packs" / "mine"
    assert (pack / "contact_sheet.png").is_file() or "no contact sheet" in shown
    assert run(capsys, *importing)[1].strip().endswith("unchanged, nothing to import")
    code, shown = run(capsys, "verify", "mine", "--physics", "--jobs", 1, "--json", tmp_path / "quality.json")
    measured = json.loads((tmp_path / "quality.json").read_text())
    assert code == 0, shown
    assert measured["violations"] == [] and measured["assets"].keys() == {"red_box", "blue_box"}
    (pack / "red_box" / "hulls.obj").unlink()
    code, shown = run(capsys, "verify", "mine")
    assert code == 1 and "hulls.obj" in shown and "missing" in shown
    assert run(capsys, *importing)[0] == 0
    load_pack("mine")
    # other masses need --overwrite
    masses = tmp_path / "masses.yaml"
    masses.write_text("red_box: 0.2\n")
    code, shown = run(capsys, *importing, "--masses", masses)
    assert code == 1 and "--overwrite" in shown
    assert run(capsys, *importing, "--masses", masses, "--overwrite")[0] == 0
    assert load_pack("mine").objects["red_box"].asset.mass == 0.2


@pytest.mark.slow
def test_skip_errors_imports_the_other_scans(scans, capsys):
    (scans / "cut.ply").write_bytes(b"ply\nformat binary")
    (scans / "no_mesh").mkdir()
    code, shown = run(capsys, "import-scans", scans, "--pack", "mine", "--jobs", 1)
    assert code == 1 and "cut" in shown and "--skip-errors" in shown
    code, shown = run(capsys, "import-scans", scans, "--pack", "mine", "--jobs", 1, "--skip-errors")
    assert code == 0 and "skipped" in shown and "cut.ply" in shown and "skipped no_mesh/" in shown
    assert load_pack("mine").objects.keys() == {"red_box", "blue_box"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--pack", "builtin"), "invalid name for an imported pack"),
        (("--pack", "../escaped"), "invalid name for an imported pack"),
        (("--pack", "My.Pack"), "invalid name of a pack"),
        (("--pack", "mine", "--masses", "lost.yaml"), "lost.yaml"),
        (("--pack", "mine", "--jobs", "0"), "--jobs"),
    ],
)
def test_invalid_options_are_reported_before_any_work(scans, tmp_path, capsys, words, message):
    code, shown = run(capsys, "import-scans", scans, *words)
    assert code == 2 and message in shown
    assert not (tmp_path / "data").exists() and not (tmp_path / "cache").exists()


@pytest.mark.parametrize("words", [(), ("--template",)])
def test_partnet_without_a_model(capsys, words):
    code, shown = run(capsys, "import-partnet", *words)
    assert code == 2 and "Traceback" not in shown


def test_masses_must_be_positive(scans, tmp_path, capsys):
    (tmp_path / "masses.yaml").write_text("red_box: 0\n")
    code, shown = run(capsys, "import-scans", scans, "--pack", "mine", "--masses", tmp_path / "masses.yaml")
    assert code == 2 and "out of range" in shown


def test_build_replaces_neither_other_folders_nor_the_whole_pack_by_a_part(scans, tmp_path, capsys):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter").write_text("1")
    code, shown = run(capsys, "build", "--ids", "plate", "--out", tmp_path / "thesis")
    assert code == 1 and (tmp_path / "thesis" / "chapter").exists()
    code, shown = run(capsys, "build", "--ids", "plate")
    assert code == 2 and "--out" in shown
    assert len(list((builtin_packs_dir() / "builtin").iterdir())) > 50


def test_contact_sheet_of_unknown_format_is_an_error(scans, tmp_path, capsys):
    code, shown = run(capsys, "sheet", "builtin", "--out", tmp_path / "sheet.txt")
    assert code == 2 and ".png" in shown
