import errno
import inspect
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from robocas_ms3 import __version__
from robocas_ms3.cli import main as cli
from robocas_ms3.cli.list import List
from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.datasets import ConversionSettings

ROOT = Path(__file__).resolve().parents[2]
HEAVY = {"torch", "scipy", "sapien", "mani_skill", "pydantic", "h5py", "trimesh"}


@pytest.fixture
def failing(monkeypatch):
    """Make `robocas list` raise something."""

    def fail(error: BaseException | Callable[[], object]) -> None:
        def main(cfg: List) -> int:
            raise error if isinstance(error, BaseException) else AssertionError(error())

        monkeypatch.setattr("robocas_ms3.cli.list.main", main)

    return fail


def test_help_lists_every_command_and_imports_nothing_heavy():
    code = (
        "import sys; from robocas_ms3.cli.main import run\n"
        "try: run(['--help'])\n"
        f"finally: sys.stderr.write(' '.join(sorted({HEAVY!r} & set(sys.modules))))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"COLUMNS": "80"},
    )
    lines = done.stdout.splitlines()
    assert all(sum(line.startswith(f"  {name} ") for line in lines) == 1 for name in cli.COMMANDS)
    assert all(len(line) <= 80 for line in lines)
    assert done.stderr == ""


def subcommands(name: str) -> dict[str, Any]:
    return getattr(cli.module_of(name), "COMMANDS", {})


def command_of(name: str, word: str = "") -> Callable[[Any], int]:
    return subcommands(name)[word] if word else cli.module_of(name).main


COMMANDS = [[name] for name in cli.COMMANDS] + [[name, word] for name in cli.COMMANDS for word in subcommands(name)]


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_command_has_a_help_that_fits_a_narrow_terminal_and_a_valid_example(words, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as exit_info:
        cli.run([*words, "--help"])
    shown = capsys.readouterr().out
    assert exit_info.value.code == 0
    assert f"usage: robocas {' '.join(words)} " in shown
    commands = subcommands(words[0]) if len(words) == 1 else ()
    assert all(f"\n  {word} " in shown for word in commands)
    assert all(len(line) <= 80 for line in shown.splitlines() if commands or "│" in line)
    assert not re.search(r"\(default: (None)?\)|{None}", re.sub(r"[\s│]+", " ", shown))
    if len(words) == 2 or not subcommands(words[0]):
        (example,) = re.findall(r"Example: robocas (.+)", inspect.getdoc(cli.settings_type(command_of(*words))) or "")
        assert cli.parse(shlex.split(example))[0] == command_of(*words)


@pytest.mark.parametrize(
    ("words", "groups"),
    [
        ("eval run", ["evaluation", "selection", "simulation"]),
        ("convert", ["conversion", "format", "render", "process"]),
        ("generate", ["episode"]),
    ],
)
def test_help_groups_the_options_of_large_commands(words, groups, capsys):
    with pytest.raises(SystemExit):
        cli.run([*words.split(), "--help"])
    assert re.findall(r"^\W*(\w+) options\W*$", capsys.readouterr().out, re.MULTILINE) == groups


def test_grouped_options_are_fields_of_the_settings():
    _, settings = cli.parse(shlex.split("convert demos/F.h5 --out data --to lerobot --size 64 48 --no-depth --jobs 2"))
    expected = ConversionSettings(Path("demos/F.h5"), Path("data"), to="lerobot", size=(64, 48), depth=False, jobs=2)
    assert settings == expected


MISTAKES = {  # arguments -> text of the error, printed before anything heavy is imported
    "generate pick --config pick_tabel_scattered": "Did you mean pick_table_scattered",
    "generate pik -n 3": "found 'pik'). Did you mean pick?",
    "show pick": "pick is a task, not a task configuration. Its default configuration is pick_table_scattered",
    "show pick_tabel_scattered": "Did you mean pick_table_scattered",
    "show --pack builtn": "builtn: no such asset pack",
    "show --seed -1": "--seed: number out of range (expected 0 to 4294967295, found -1)",
    "layouts build pick_tabel_scattered": "Did you mean pick_table_scattered",
    "layouts build pick_table_scattered --seeds 3": "--seeds: invalid range of seeds",
    "layouts build pick_table_scattered --jobs 0": "--jobs: number out of range",
    "replay missing.h5": "missing.h5: no such file or folder. See robocas replay --help.",
    "convert missing.h5 --out o": "missing.h5: no such file or folder",
    "validate missing": "missing: no such file or folder",
    "stats missing": "missing: no such file or folder",
    "video missing": "missing: no such file or folder",
    "view missing": "missing: no such file or folder",
    "merge missing other --out o": "missing: no such file or folder",
    "split missing": "missing: no such file or folder",
    "split .": "--out: wrong number of output options",
    "merge --out o": "DIR: missing dataset folders",
    "convert . --out o --to lerobt": "Did you mean lerobot?",
    "convert missing.h5 --out o --overwrite --append": "--overwrite: ",
    "eval report": "DIR: missing result folder",
    "plan status missing": "missing: no such file or folder",
    "import-robocas missing": "missing: no such file or folder",
    "eval pik": "Did you mean pick?",
    "eval comparre x": "Did you mean compare?",
    "eval --policy scriptd": "Did you mean scripted",
    "eval --policy runs/missing": "runs/missing: unknown policy",
    "eval --protocol ms3-v2": "ms3-v2: unknown protocol",
    "eval --shard 3": "--shard: invalid shard",
    "eval --episodes 0": "--episodes: number out of range",
    "eval report missing": "missing: no such file or folder",
    "eval merge missing --out o": "missing: no such file or folder",
    "eval compare missing other": "missing: no such file or folder",
    "eval verify missing": "missing: no such file or folder",
    "eval videos missing": "missing: no such file or folder",
    "serve-policy scriptd": "Did you mean scripted",
    "assets info builtn": "builtn: no such asset pack",
}


def test_invalid_arguments_are_reported_before_anything_heavy_is_imported(tmp_path):
    """All run in one process: a heavy module that one of them imports fails the test."""
    code = (
        "import sys; from robocas_ms3.cli.main import run\n"
        f"for words in {list(MISTAKES)!r}:\n"
        "    heavy = {'torch', 'sapien', 'mani_skill', 'matplotlib', 'trimesh', 'fcl'}\n"
        "    print(run(words.split()))\n"
        "    assert not heavy & set(sys.modules), (words, heavy & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for line, (words, said) in zip(done.stderr.splitlines(), MISTAKES.items(), strict=True):
        assert line.startswith("error: ") and said in line, words
    codes = dict(zip(MISTAKES, map(int, done.stdout.split()), strict=True))
    assert {words: code for words, code in codes.items() if code != 2} == {}
    assert "open_pick_cabinet_door" not in done.stderr  # not all forty
    assert list(tmp_path.iterdir()) == []


SLOW_MISTAKES = [  # reported after the imports of their commands
    "eval --policy missing_module:Policy",
    "eval --policy json:Missing",
    "eval --policy replay:missing.h5",
    "eval --policy noop --split missing",
    "eval open_pick --policy noop --protocol paper-v1",
    "generate pick --pack missing",
    "generate search --config pick_upstream_eval",
    "generate pick --robot missing",
    "generate pick --planner missing",
    "generate pick --after-policy missing",
    "generate pick --set objects.cont=3",
    "generate pick -n 0",
    "plan run missing --out o",
    "plan run missing.yaml --out o",
    "plan run tiny --out o --shard 2/2",
    "layouts build pick_table_scattered --furniture-pack missing",
    "train small --data missing",
    "train bc-state --data missing.h5",
    "train small --data . --init-from missing",
    "train small --data . --config missing.yaml",
    "train small --data . --set x",
    "serve-policy random --protocol missing",
    "assets import-partnet",
    "assets import-scans missing --pack mine",
    "assets import-scans . --pack mine --masses missing.yaml",
    "assets sheet builtin --ids missing",
]


@pytest.mark.parametrize("words", SLOW_MISTAKES)
def test_invalid_arguments_exit_with_2_and_one_line(words, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    assert cli.run(words.split()) == 2
    shown = capfd.readouterr()
    assert shown.out == ""
    assert re.fullmatch(r"error: .+\n", shown.err)
    assert list(tmp_path.iterdir()) == []


def test_list_commands_import_nothing_heavy(tmp_path):
    code = (
        "import sys; from robocas_ms3.cli.main import run\n"
        "for words in ('list', 'eval protocols', 'assets list', 'assets info builtin'):\n"
        "    assert run(words.split()) == 0, words\n"
        "assert not {'torch', 'sapien', 'mani_skill', 'matplotlib', 'h5py', 'trimesh'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("words", "suggestion"),
    [
        ("generat pick", "generate"),
        ("generate pick --episodez=3", "--episodes"),
        ("generate pick -n three", "expected a whole number, found 'three'"),
        ("convert a.h5 --out o --rate five", "expected a number, found 'five'"),
        ("convert a.h5 --out o --size 64", "'--size'. Expected 2 values"),
        ("convert a.h5 --out o --size 64 x", "expected 2 values, each a whole number, found '64 x'"),
        ("convert", "--out"),
        ("plan rn", "run"),
        ("plan run tiny --out x --jbos 3", "--jobs"),
    ],
)
def test_invalid_arguments_exit_with_2_and_a_suggestion(words, suggestion, capsys):
    with pytest.raises(SystemExit) as exit_info:
        cli.run(words.split())
    shown = capsys.readouterr()
    assert (exit_info.value.code, shown.out) == (2, "")
    assert suggestion in shown.err


def test_eval_without_a_command_runs_a_protocol():
    for words in ("eval", "eval pick", "eval --policy random", "eval pick search --out a"):
        short, long = cli.parse(words.split()), cli.parse(["eval", "run", *words.split()[1:]])
        assert short == long
    assert cli.parse(["eval", "report", "a", "b"])[1].folders == (Path("a"), Path("b"))


def test_debug_gives_the_traceback(failing, monkeypatch):
    failing(RobocasError("broken"))
    with pytest.raises(RobocasError):
        cli.run(["list", "--debug"])
    monkeypatch.setenv("ROBOCAS_DEBUG", "1")
    with pytest.raises(RobocasError):
        cli.run(["list"])
    monkeypatch.setenv("ROBOCAS_DEBUG", "0")
    assert cli.run(["list"]) == 1


def test_help_and_version(capsys):
    with pytest.raises(SystemExit) as exit_info:
        cli.run([])
    assert exit_info.value.code == 0
    assert "generate" in capsys.readouterr().out
    assert cli.run(["--version"]) == 0
    assert capsys.readouterr().out == f"robocas {__version__}\n"


def test_interrupt_exits_with_130(failing, capsys):
    failing(KeyboardInterrupt())
    assert cli.run(["list"]) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_exit_inside_a_command_is_an_error(failing, capsys):
    failing(SystemExit(0))
    assert cli.run(["list"]) == 1
    assert capsys.readouterr().err.startswith("error: robocas list: ")


def test_full_disk_is_one_line_and_a_bug_a_traceback(failing, capsys):
    failing(OSError(errno.ENOSPC, "No space left on device", "out/x.h5"))
    assert cli.run(["list"]) == 1
    said = r"error: out/x.h5: No space left on device \(\d+ MB free\)\. Free disk space, then run the command again\.\n"
    assert re.fullmatch(said, capsys.readouterr().err)

    failing(OSError(errno.EIO, "Input/output error", "out/x.h5"))  # as a file server may raise it
    assert cli.run(["list"]) == 1
    assert capsys.readouterr().err == "error: out/x.h5: Input/output error\n"
    failing(FileNotFoundError(errno.ENOENT, "No such file or directory", "x"))
    with pytest.raises(FileNotFoundError):
        cli.run(["list"])


def test_damaged_document_is_one_line_with_its_path(failing, tmp_path, capsys):
    path = tmp_path / "report.json"
    path.write_text("")
    failing(lambda: load_json(path))
    assert cli.run(["list"]) == 1
    assert capsys.readouterr().err == f"error: {path}: Expecting value: line 1 column 1 (char 0)\n"
    failing(ValueError("a bug"))
    with pytest.raises(ValueError, match="a bug"):
        cli.run(["list"])


def test_full_or_read_only_cache_names_its_variable(failing, monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("ROBOCAS_CACHE", str(tmp_path))
    for number, said in (
        (
            errno.ENOSPC,
            r"No space left on device \(\d+ MB free\)\. Free disk space, or set ROBOCAS_CACHE to a folder on another",
        ),
        (errno.EACCES, r"Permission denied\. Set ROBOCAS_CACHE to a writable folder"),
    ):
        failing(OSError(number, os.strerror(number), str(tmp_path / "robots" / "x")))
        assert cli.run(["list"]) == 1
        assert re.search(f"^error: {tmp_path}/robots/x: {said}", capsys.readouterr().err)


def test_libraries_get_a_temporary_folder_when_home_is_read_only(monkeypatch, tmp_path):
    (tmp_path / "home").write_text("")
    for name in ("MPLCONFIGDIR", "MESA_SHADER_CACHE_DIR", "XDG_CONFIG_HOME", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, "")  # so that what the command sets is undone
        monkeypatch.delenv(name)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    cli.run(["--version"])
    cli.run(["validate", "nothing"])
    assert "MPLCONFIGDIR" not in os.environ  # the home is writable
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    cli.run(["validate", "nothing"])
    assert os.environ["MPLCONFIGDIR"] == f"{tmp_path}/robocas-{os.getuid()}/matplotlib"
    assert os.environ["MESA_SHADER_CACHE_DIR"].startswith(f"{tmp_path}/robocas-")


def test_closed_pipe_prints_no_traceback():
    script = f"{sys.executable} {ROOT / 'robocas_cli.py'} list --json | head -c 1; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
