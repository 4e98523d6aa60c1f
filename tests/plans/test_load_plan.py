"""Plans as files: an invalid plan is an error of one line; the bundled plans are complete."""

import errno
from dataclasses import replace

import pytest
from plan_stages import StubRecorder

from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import ConfigError, ExtensionError, MissingExtraError, OutputExistsError, PlanError
from robocas_ms3.plans.folder import PLAN, PlanFolder, SeedFiles
from robocas_ms3.plans.load import (
    bundled_plans,
    check_plan,
    convert_part_errors,
    load_plan,
    max_seeds,
    recording_settings,
)
from robocas_ms3.plans.worker import Renderer
from robocas_ms3.scenes.config import load_task_config

GOOD = "parts:\n  - {task: pick, episodes: 3}\n"


@pytest.fixture
def written(tmp_path):
    def write(text):
        path = tmp_path / "plan.yaml"
        path.write_text(text)
        return path

    return write


@pytest.mark.parametrize("name", bundled_plans())
def test_bundled_plans_are_complete(name):
    plan = load_plan(name)
    assert plan.description
    assert len({part.name for part in plan.parts}) == len(plan.parts)


def test_paper_plan_has_the_numbers_of_the_paper():
    parts = load_plan("paper").parts
    of = {task: sum(part.episodes for part in parts if part.task == task) for task in ("pick", "select", "search")}
    assert of == {"pick": 2800, "select": 3000, "search": 1500}  # robocas_v0.md, data: 7300 episodes


def test_parts_with_the_same_scenes_need_separate_seeds(written):
    seed = max_seeds(5, block=10)
    text = "parts:\n  - {{task: pick, episodes: 5}}\n  - {{task: pick, episodes: 9, seed: {}}}\n"
    assert len(load_plan(written(text.format(seed))).parts) == 2
    with pytest.raises(PlanError, match="may use the same seeds"):
        load_plan(written(text.format(seed - 1)))


def test_configurations_and_packs_in_folders(written, tmp_path, monkeypatch):
    (tmp_path / "mine.yaml").write_text("extends: pick_shelf_scattered\nobjects: {count: 4}\n")
    plan = load_plan(written("parts:\n  - {task: pick, config: mine.yaml, episodes: 3}\n"))
    resolved = load_task_config("pick_shelf_scattered", set_options=["objects.count=4"])
    assert plan.parts[0].config == resolved.model_dump(mode="json")
    assert plan.parts[0].name == "00-mine"
    (tmp_path / "here" / "packs" / "mine").mkdir(parents=True)
    (tmp_path / "here" / "other.yaml").write_text(resolved.model_dump_json())
    monkeypatch.chdir(tmp_path / "here")  # the working directory comes second
    plan = load_plan(written("parts:\n  - {task: pick, config: other.yaml, pack: packs/mine, episodes: 3}\n"))
    assert plan.parts[0].config == resolved.model_dump(mode="json")
    assert plan.parts[0].pack == str(tmp_path / "here" / "packs" / "mine")


def test_changed_pack_is_an_error(written, tmp_path):
    pack, out = tmp_path / "mine", tmp_path / "out"
    pack.mkdir()
    path = written("parts:\n  - {task: pick, pack: mine, episodes: 3, name: a}\n")
    (pack / "manifest.json").write_text("{}")
    plan = load_plan(path)
    assert plan.packs.keys() == {str(pack), "builtin"}
    with PlanFolder(plan, out).open_output(shared=True) as output:
        output.start(PlanFolder(plan, out).make_record())
    PlanFolder(load_plan(path), out).open_output(shared=True).check_record()
    with convert_part_errors(plan, 0):
        pass
    (pack / "manifest.json").write_text("{ }")
    with pytest.raises(OutputExistsError, match=r"packs\..*mine: "):
        PlanFolder(load_plan(path), out).open_output(shared=True).check_record()
    with pytest.raises(PlanError) as error, convert_part_errors(plan, 0):
        pass
    assert error.value.where == str(pack)
    path.write_text(f"{path.read_text()}packs: {{{pack}: 12ab}}\n")
    with pytest.raises(PlanError, match="expected a manifest with sha256 12ab"):
        load_plan(path)


@pytest.mark.parametrize(
    ("error", "raised", "match"),
    [
        (ConfigError("no such thing"), PlanError, "part a: .*found no such thing"),
        (RuntimeError("no device\nat all"), PlanError, "found RuntimeError: no device at all"),
        (OSError("can't be read"), PlanError, "found OSError: can't be read"),
        (OSError(errno.EIO, "Input/output error", "x"), OSError, "Input/output error"),
        (MissingExtraError("nothing to render with"), MissingExtraError, "nothing to render with"),
    ],
)
def test_error_while_opening_a_part_ends_the_run(written, tmp_path, error, raised, match):
    class Fails(Renderer):
        def open_env(self, *_):
            raise error

    plan = load_plan(written("embeddings: false\nparts:\n  - {task: pick, episodes: 3, name: a}\n"))
    files = SeedFiles(0, 7, tmp_path / "a" / "b" / "c" / "d")
    files.folder.mkdir(parents=True)
    StubRecorder(plan).run(files)
    with pytest.raises(raised, match=match) as found:
        Fails(plan).run(files)
    assert "\n" not in str(found.value)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("parts: []\n", "at least 1 item"),
        ("parts:\n  - {task: fly, episodes: 1}\n", "unknown task .expected pick, select, search, open_pick"),
        (GOOD + "block: 10\nblok: 3\n", "unknown key 'blok'.*Did you mean block"),
        (GOOD + "formats: [lerobot]\n", "expected the first format to be robocas"),
        (GOOD + "stages: [datasets]\n", "datasets needs the stage demonstrations"),
        (GOOD + "stages: [demonstrations]\nformats: [robocas, lerobot]\n", "lerobot needs the stage datasets"),
        (GOOD + "images: {cameras: [nose]}\n", "unknown camera"),
        (GOOD + "split: {group_by: task}\n", "group_by task needs plan parts of at least two tasks"),
        ("parts:\n  - {task: pick, episodes: 1, name: ../up}\n", "parts.0.name"),
        (
            "parts:\n  - {task: pick, episodes: 1, name: a}\n  - {task: pick, episodes: 1, name: a}\n",
            "two plan parts have the same name .found a",
        ),
        (
            "parts:\n" + 2 * "  - {task: pick, episodes: 1}\n",
            "two plan parts may use the same seeds .expected one of the two at least",
        ),
        ("[", "cannot read this plan"),
        (GOOD + "control_freq: 7\n", "plan.yaml, control_freq: the control rate must divide the rate of physics"),
        (GOOD + "rate: 7\n", "plan.yaml, rate: "),
    ],
)
def test_invalid_plan_is_one_line(written, text, match):
    with pytest.raises(PlanError, match=match) as error:
        load_plan(written(text))
    assert "\n" not in str(error.value)


def test_cameras_are_those_of_the_configurations_or_of_the_plan(written, tmp_path):
    camera = "cameras: {side_camera: {position: [1, 0, 1], look_at: [0, 0, 0]}}\n"
    (tmp_path / "mine.yaml").write_text(f"extends: pick_shelf_scattered\n{camera}")
    four = "parts:\n  - {task: pick, episodes: 3, config: mine.yaml}\n"
    standard = ["base_camera", "gripper_camera", "static_camera"]
    assert load_plan(written(GOOD)).images.cameras == standard
    assert load_plan(written(four)).images.cameras == [*standard, "side_camera"]
    assert load_plan(written(four + "images: {cameras: [side_camera]}\n")).images.cameras == ["side_camera"]
    mixed = four + "  - {task: select, episodes: 3}\n"
    with pytest.raises(PlanError, match="different cameras"):
        load_plan(written(mixed))
    assert load_plan(written(mixed + "images: {cameras: [base_camera]}\n")).images.cameras == ["base_camera"]
    without_images = mixed + "stages: [layouts, demonstrations]\nformats: [robocas]\n"
    assert load_plan(written(without_images)).images.cameras == standard
    with pytest.raises(PlanError, match="unknown camera"):
        load_plan(written(mixed + "images: {cameras: [side_camera]}\n"))


def test_configuration_of_another_task_is_an_error(written):
    with pytest.raises(ConfigError, match="can't run the configuration select_table_orderly"):
        load_plan(written("parts:\n  - {task: pick, config: select_table_orderly, episodes: 1}\n"))


def test_unknown_plan_suggests_the_nearest(capsys):
    assert run(["plan", "run", "tinny", "--out", "x"]) == 2
    assert "tinny: no such plan (expected a YAML file, or one of paper, tiny). Did you mean tiny?" in (
        capsys.readouterr().err
    )


def test_recording_settings_are_those_of_the_plan(written):
    text = "rate: 10\ncontrol_freq: 20\nrecording: {check_trials: 0, max_attempts: 3}\n"
    settings = recording_settings(load_plan(written(GOOD + text)), 0)
    assert (settings.check_rate, settings.check_trials, settings.max_attempts) == (10, 0, 3)
    assert settings == replace(
        recording_settings(load_plan(written(GOOD)), 0), check_rate=10, check_trials=0, max_attempts=3
    )


def test_demonstrations_with_action_noise_have_no_open_loop_check_by_default(written):
    settings = recording_settings(load_plan(written(GOOD + "recording: {action_noise: [3, 1]}\n")), 0)
    assert (settings.action_noise, settings.check_rate) == ((3.0, 1.0), 0)
    checked = recording_settings(load_plan(written(GOOD + "recording: {action_noise: [3, 1], check_rate: 5}\n")), 0)
    assert checked.check_rate == 5


def test_recording_settings_are_checked_before_the_run(written):
    with pytest.raises(ExtensionError, match="no such planner"):
        check_plan(load_plan(written(GOOD + "recording: {planner: mplip}\nembeddings: false\n")))
    with pytest.raises(PlanError, match="max_attempts"):
        check_plan(load_plan(written(GOOD + "recording: {max_attempts: 0}\nembeddings: false\n")))


def test_invalid_executor_option_overwrites_nothing(tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / PLAN).write_text('{"versions": {}, "plan": {}}')
    assert run(["plan", "run", "tiny", "--out", str(out), "--overwrite", "--executor-option", "partition=cpu"]) == 2
    assert "--executor-option" in capsys.readouterr().err
    assert (out / PLAN).is_file()


@pytest.mark.parametrize("words", [["--overwrite"], ["--executor", "ray"]])
def test_shard_excludes_overwrite_and_other_executors(tmp_path, words):
    assert run(["plan", "run", "tiny", "--out", str(tmp_path / "out"), "--shard", "0/2", *words]) == 2
    assert not (tmp_path / "out").exists()
