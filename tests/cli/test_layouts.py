import pytest

from robocas_ms3.cli import layouts
from robocas_ms3.cli.layouts import Build, Info, parse_seeds
from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import ConfigError, LayoutError
from robocas_ms3.scenes import cache
from robocas_ms3.scenes.layout import read_layout
from robocas_ms3.scenes.sample import sample_layout


def build(folder, seeds):
    return layouts.build(Build("pick_table_scattered", seeds=seeds, jobs=1, out=folder))


def test_second_run_samples_only_missing_layouts(tmp_path, monkeypatch, capsys):
    made = []
    monkeypatch.setattr(
        cache, "sample_layout", lambda model, o, s, ids: made.append((o, s)) or sample_layout(model, o, s)
    )
    assert build(tmp_path, "0:2") == 0
    assert build(tmp_path, "0:3") == 0
    assert made == [(0, 0), (1, 1), (2, 2)]
    assert "1 layout sampled, 2 already present, 0 seeds without a layout" in capsys.readouterr().out
    layouts.info(Info(tmp_path))
    listed = capsys.readouterr().out
    assert "scattered" in listed and "builtin" in listed and " 3 " in listed


def test_seeds_without_a_layout_are_named(tmp_path, monkeypatch, capsys):
    def fussy(model, objects_seed, seed, object_ids):
        if seed == 1:
            raise LayoutError("no object qualifies as the target", where="target")
        return sample_layout(model, objects_seed, seed)

    monkeypatch.setattr(cache, "sample_layout", fussy)
    assert build(tmp_path, "0:3") == 1
    captured = capsys.readouterr()
    assert "2 layouts sampled, 0 already present, 1 seed without a layout" in captured.out
    assert "seed 1: target: no object qualifies" in captured.err
    assert "layouts sampled: 2/3" in captured.err


@pytest.mark.slow
def test_processes_write_the_same_files(tmp_path):
    for jobs in (1, 2):
        layouts.build(Build("pick_table_scattered", seeds="0:3", jobs=jobs, out=tmp_path / str(jobs)))
    one, two = (sorted((tmp_path / jobs).glob("*/*/*.npz")) for jobs in "12")
    assert [path.name for path in one] == [path.name for path in two]
    for a, b in zip(one, two, strict=True):
        first, second = read_layout(a), read_layout(b)
        assert (first.object_poses == second.object_poses).all() and first.target == second.target


def test_parse_seeds():
    assert parse_seeds("2:5", "--seeds") == parse_seeds("2:5", "--objects", listed=True) == [2, 3, 4]
    assert parse_seeds("7,3,7", "--objects", listed=True) == [7, 3]
    for text in ("", "a:b", "3:3", "4:1", "1,", "-1:2"):
        with pytest.raises(ConfigError) as caught:
            parse_seeds(text, "--objects", listed=True)
        assert (caught.value.where, caught.value.found) == ("--objects", text)
    with pytest.raises(ConfigError):
        parse_seeds("5", "--seeds")


def test_info_without_caches(tmp_path, capsys):
    assert run(["layouts", "info", "--folder", str(tmp_path)]) == 0
    assert "no layout caches in" in capsys.readouterr().out
