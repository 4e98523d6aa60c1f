import contextlib
import json
import os
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh
from asset_entries import furniture_asset

from asset_tools import pipeline
from asset_tools.pipeline import AssetJob, build_assets, compute_content_hash, is_up_to_date, write_pack
from robocas_ms3.assets.hulls import write_hulls
from robocas_ms3.assets.pack import HULLS, VISUALS, load_pack, sha256
from robocas_ms3.core.errors import AssetError, OutputExistsError

CUBE = np.array([[x, y, z] for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1)])
BALL = 0.05 * np.asarray(trimesh.creation.icosphere(subdivisions=1).vertices)  # 80 faces: too many for a GPU


def make(id_, folder, log, fail="", seconds=0.0, hull=CUBE):
    """An asset of four small files; says in a log that it was made."""
    with log.open("a") as file:
        file.write(f"{id_}\n")
    time.sleep(seconds)
    if fail:
        raise AssetError(fail)
    for name in VISUALS.values():
        (folder / name).write_text(f"{id_} {name}")
    write_hulls(folder / HULLS, [hull])
    return furniture_asset(id_, files={path.name: sha256(path) for path in folder.iterdir()})


def jobs(log, **contents):
    return [AssetJob(id_, partial(make, id_, log=log), content) for id_, content in contents.items()]


def made_in(log):
    return log.read_text().split() if log.exists() else []


def test_a_finished_asset_is_not_built_again(tmp_path):
    log, kept = tmp_path / "log", tmp_path / "kept"
    write_pack(jobs(log, a="1" * 64, b="2" * 64), tmp_path / "first", kept)
    results = write_pack(jobs(log, a="1" * 64, b="3" * 64), tmp_path / "second", kept)
    assert made_in(log) == ["a", "b", "b"]
    assert {result.id: result.reused for result in results} == {"a": True, "b": False}
    assert load_pack(tmp_path / "second").furniture.keys() == {"a", "b"}
    first, second = (tmp_path / name / "a" / HULLS for name in ("first", "second"))
    assert first.read_bytes() == second.read_bytes()
    assert not (tmp_path / "second" / "a" / "asset.json").exists()


def test_a_damaged_cached_asset_is_built_again(tmp_path):
    log, kept = tmp_path / "log", tmp_path / "kept"
    write_pack(jobs(log, a="1" * 64), tmp_path / "pack", kept)
    (hulls,) = kept.glob(f"*/{HULLS}")
    hulls.write_text("v 0 0")
    write_pack(jobs(log, a="1" * 64), tmp_path / "pack", kept)
    assert made_in(log) == ["a", "a"]
    load_pack(tmp_path / "pack")


def test_hulls_that_the_engine_shrinks_stop_the_build(tmp_path):
    log = tmp_path / "log"
    todo = [*jobs(log, cube="1" * 64), AssetJob("ball", partial(make, "ball", log=log, hull=BALL), "2" * 64)]
    with pytest.raises(AssetError, match=r"ball: hull 0 shrinks by \d+\.\d mm on a GPU"):
        write_pack(todo, tmp_path / "pack", tmp_path / "kept")
    assert not (tmp_path / "pack").exists()
    results = write_pack(todo, tmp_path / "pack", tmp_path / "kept", skip_errors=True)
    assert [(made.id, made.asset is None) for made in sorted(results, key=lambda m: m.id)] == [
        ("ball", True),
        ("cube", False),
    ]
    assert load_pack(tmp_path / "pack").furniture.keys() == {"cube"}


def test_a_failure_names_the_asset_and_keeps_finished_assets(tmp_path):
    log, kept = tmp_path / "log", tmp_path / "kept"
    bad = AssetJob("bad", partial(make, "bad", log=log, fail="it has no faces"), "9" * 64)
    todo = [*jobs(log, a="1" * 64), bad]
    with pytest.raises(AssetError, match="bad: it has no faces"):
        write_pack(todo, tmp_path / "pack", kept)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["kept", "log"]
    assert [path.name for path in kept.iterdir()] == ["a-" + "1" * 20]
    results = write_pack(todo, tmp_path / "pack", kept, skip_errors=True)
    assert [result.id for result in results if result.asset is None] == ["bad"]
    assert made_in(log) == ["a", "bad", "bad"]
    assert is_up_to_date(todo, tmp_path / "pack", skip_errors=True) and not is_up_to_date(todo, tmp_path / "pack")
    with pytest.raises(AssetError, match="no asset could be built"):
        write_pack([bad], tmp_path / "none", kept, skip_errors=True)


def test_content_hash_depends_on_files_settings_and_code(tmp_path):
    path = tmp_path / "mesh.obj"
    path.write_text("v 0 0 0")
    first = compute_content_hash("m", files=[path])
    assert first == compute_content_hash("m", files=[path])
    assert first != compute_content_hash("cm", files=[path])
    assert first != compute_content_hash("m", files=[path], packages=["builtin"])
    path.write_text("v 0 0 1")
    assert first != compute_content_hash("m", files=[path])


def trip(folder):
    raise IndexError("list index out of range")


def die(folder):
    os._exit(9)


def test_any_error_names_its_asset_and_affects_no_other(tmp_path):
    log = tmp_path / "log"
    todo = [AssetJob("odd", trip, "7" * 64), AssetJob("deadly", die, "8" * 64), *jobs(log, a="1" * 64, b="2" * 64)]
    results = write_pack(todo, tmp_path / "pack", tmp_path / "kept", skip_errors=True, processes=2)
    errors = {made.id: made.error for made in results}
    assert errors["odd"] == "odd: IndexError: list index out of range"
    assert errors["deadly"].startswith("deadly: the worker process crashed (exit status 9)")
    assert load_pack(tmp_path / "pack").furniture.keys() == {"a", "b"}


def test_a_folder_that_is_not_a_pack_is_not_replaced(tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter").write_text("1")
    todo = jobs(tmp_path / "log", a="1" * 64)
    with pytest.raises(OutputExistsError, match="was not written by this command"):
        write_pack(todo, tmp_path / "thesis", tmp_path / "kept")
    with pytest.raises(AssetError, match="invalid name of a pack"):
        write_pack(todo, tmp_path / "My.Pack", tmp_path / "kept")
    assert made_in(tmp_path / "log") == []


SUPPORT = Path(__file__).resolve().parents[1] / "support"
SCRIPT = """
import sys
from functools import partial
from pathlib import Path
sys.path[:0] = {tests!r}
from test_pipeline import make
from asset_tools.pipeline import AssetJob, write_pack
if __name__ == "__main__":
    root = Path({root!r})
    make_one = partial(make, log=root / "log", seconds=0.3)
    todo = [AssetJob(f"asset_{{i}}", partial(make_one, f"asset_{{i}}"), str(i) * 64) for i in range(8)]
    write_pack(todo, root / "pack", root / "kept", processes=2)
"""


def workers_of(script):
    """Return the processes of the script's session from /proc."""
    found = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):
            found += [path] if f"ROBOCAS_TEST_RUN={script}".encode() in path.read_bytes() else []
    return found


def test_a_killed_run_continues_where_it_stopped(tmp_path):
    script = tmp_path / "run.py"
    script.write_text(SCRIPT.format(tests=[os.path.dirname(__file__), str(SUPPORT)], root=str(tmp_path)))
    quick = {**os.environ, "ROBOCAS_TEST_RUN": str(script)}
    run = subprocess.Popen([sys.executable, script], start_new_session=True, env=quick)
    while len(list((tmp_path / "kept").glob("asset_*/asset.json"))) < 3:
        time.sleep(0.02)
        assert run.poll() is None
    run.kill()  # the parent alone: its workers must end too
    run.wait()
    deadline = time.monotonic() + 5
    while workers_of(script) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not workers_of(script)
    assert not (tmp_path / "pack").exists()
    finished = len(list((tmp_path / "kept").glob("asset_*/asset.json")))
    before = len(made_in(tmp_path / "log"))
    assert subprocess.run([sys.executable, script], check=False, env=quick).returncode == 0
    assert len(load_pack(tmp_path / "pack").furniture) == 8
    assert len(made_in(tmp_path / "log")) - before == 8 - finished
    assert len(json.loads((tmp_path / "pack" / "made_from.json").read_text())["content"]) == 8


def test_content_hash_depends_on_code_and_yaml(tmp_path, monkeypatch):
    monkeypatch.setattr(pipeline, "__file__", str(tmp_path / "pipeline.py"))
    for folder in ("quality", "readers", "products"):
        (tmp_path / folder).mkdir()
    found = []
    for name, text in (("toys.yaml", "a: 1"), ("toys.yaml", "a: 2"), ("toys.py", "A = 2"), ("notes.txt", "none")):
        (tmp_path / "products" / name).write_text(text)
        pipeline._code.cache_clear()
        found.append(compute_content_hash(packages=["products"]))
    pipeline._code.cache_clear()
    assert len(set(found)) == 3 and found[2] == found[3]


def test_unused_cached_assets_are_deleted_after_months(tmp_path):
    log, kept = tmp_path / "log", tmp_path / "kept"
    (tmp_path / "one").mkdir()
    list(build_assets(jobs(log, a="1" * 64), tmp_path / "one", kept))
    (place,) = kept.iterdir()
    os.utime(place, (0, 0))
    list(build_assets([], tmp_path / "one", kept))
    assert not place.exists()
