"""Protocols are frozen from protocol sources."""

import pytest
import yaml

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.cli import eval as command
from robocas_ms3.core.errors import EvaluationError, OutputExistsError, RobocasError
from robocas_ms3.evaluation.protocols.freeze import ProtocolSource, freeze_protocol, read_protocol_source
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.layout_table import FrozenLayouts

SOURCE = {
    "rules": {"name": "tiny", "description": "One episode.", "max_seconds": {"pick": 5}},
    "parts": [{"config": "pick_table_scattered", "count": 1, "first_seed": 110000, "split": "mine"}],
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frozen") / "tiny"
    steps = freeze_protocol(ProtocolSource.model_validate(SOURCE), folder)
    assert next(steps) == (1, 1)
    assert not folder.exists()  # the folder is written atomically
    assert list(steps) == []
    return folder


def test_episode_equals_the_episode_of_the_bundled_protocol_with_the_same_seed(made):
    protocol = load_protocol(made)
    assert (protocol.rules.name, protocol.rules.max_seconds) == ("tiny", {"pick": 5.0})
    assert [path.name for path in made.parent.iterdir()] == ["tiny"]
    (mine,), shipped = protocol.episodes, load_protocol("smoke").episodes[0]
    assert (mine.split, mine.config) == ("mine", "pick_table_scattered-mine")
    assert mine.model_copy(update={"split": shipped.split, "config": shipped.config}) == shipped


def test_listed_seeds_are_frozen_in_their_order(tmp_path):
    part = {"config": "pick_table_scattered", "seeds": [110012, 110010], "change": {"objects": {"count": 2}}}
    steps = freeze_protocol(ProtocolSource.model_validate({**SOURCE, "parts": [part]}), tmp_path / "out")
    assert list(steps) == [(1, 2), (2, 2)]
    assert [episode.seed for episode in load_protocol(tmp_path / "out").episodes] == [110012, 110010]


@pytest.mark.parametrize("keys", [{}, {"seeds": [1], "count": 1}, {"seeds": [1], "first_seed": 1}, {"seeds": [-1]}])
def test_a_part_has_either_a_count_or_seeds(tmp_path, keys):
    content = {**SOURCE, "parts": [{"config": "pick_table_scattered", **keys}]}
    (tmp_path / "source.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(EvaluationError):
        read_protocol_source(tmp_path / "source.yaml")


def test_existing_folder_is_refused_before_scenes_are_sampled(made, tmp_path):
    (tmp_path / "source.yaml").write_text(yaml.safe_dump(SOURCE))
    with pytest.raises(OutputExistsError):
        command.freeze(command.Freeze(tmp_path / "source.yaml", made))


def test_changed_configurations_and_wrong_or_empty_instructions_are_frozen(tmp_path):
    fewer = {"objects": {"count": 2}, "layout": {"kind": "orderly", "copies": 1, "rows": 1}}
    scene = {"config": "pick_table_scattered", "count": 1, "first_seed": 110010, "change": fewer}
    parts = [{**scene, "split": words, "instruction": words, "name": "two"} for words in ("correct", "wrong", "empty")]
    train = [{"config": "pick_table_scattered", "change": {"objects": {"count": 1}}, "name": "one"}] * 2
    list(freeze_protocol(ProtocolSource.model_validate({**SOURCE, "parts": parts, "train": train}), tmp_path / "out"))
    protocol = load_protocol(tmp_path / "out")
    asked, wrong, empty = protocol.episodes
    config = load_task_config(protocol.config_file("two"))
    assert (config.objects.count, config.layout.kind) == (2, "orderly")
    assert {path.name for path in (tmp_path / "out" / "layouts").iterdir()} == {"two.npy"}
    layouts = FrozenLayouts(protocol.layouts_file("two"), load_pack("builtin").objects)
    (other,) = set(layouts(asked.seed, asked.seed).object_ids) - {asked.target}
    names = {one: load_pack("builtin").objects[one].asset.name for one in (asked.target, other)}
    assert asked.instruction == f"grasp the {names[asked.target]} on the table and move it to the basket"
    assert wrong.instruction == f"grasp the {names[other]} on the table and move it to the basket"
    assert (empty.instruction, empty.target) == ("", asked.target)
    assert [path.name for path in protocol.training_configs()] == ["one.yaml"]
    before = protocol.hash
    protocol.training_configs()[0].write_text("task: pick")
    assert load_protocol(tmp_path / "out").hash != before


def test_a_configuration_is_found_next_to_the_source(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sources").mkdir()
    config = load_task_config("pick_table_scattered").model_dump(mode="json")
    (tmp_path / "sources" / "mine.yaml").write_text(yaml.safe_dump(config))
    scenes = [{"config": name} for name in ("mine.yaml", "pick_table_scattered")]
    source = {**SOURCE, "parts": [{**SOURCE["parts"][0], **scene} for scene in scenes], "train": scenes}
    (tmp_path / "sources" / "source.yaml").write_text(yaml.safe_dump(source))
    read = read_protocol_source(tmp_path / "sources" / "source.yaml")
    assert [part.file_stem for part in read.parts] == ["mine-mine", "pick_table_scattered-mine"]
    assert [scene.load_config().task for scene in (*read.parts, *read.train)] == ["pick"] * 4


@pytest.mark.parametrize("text", ["parts: []", "rules: [", "rules: {}\nparts: [{config: x}]"])
def test_invalid_sources_are_errors(tmp_path, text):
    (tmp_path / "source.yaml").write_text(text)
    with pytest.raises(EvaluationError, match=r"source.yaml: invalid protocol source") as caught:
        command.freeze(command.Freeze(tmp_path / "source.yaml", tmp_path / "out"))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


FIRST = SOURCE["parts"][0]


@pytest.mark.parametrize(
    "changed",
    [
        {"parts": [FIRST, {**FIRST, "change": {"objects": {"count": 3}}}]},  # two configurations with the same name
        {"parts": [{**FIRST, "change": {"objects": {"number": 3}}}]},
        {"parts": [{**FIRST, "config": "nothing"}]},
        {"parts": [{**FIRST, "instruction": "wrong", "change": {"objects": {"count": 1}}}]},  # no second object
        *({"parts": [{**FIRST, "split": split}]} for split in ("../../evil", "x" * 300)),
        {"parts": [FIRST], "rules": SOURCE["rules"] | {"name": "../../evil"}},
        {"train": [{"config": FIRST["config"], "change": {"objects": {"count": n}}} for n in (3, 4)]},
    ],
)
def test_sources_that_cannot_be_frozen_leave_no_files(tmp_path, changed):
    source = ProtocolSource.model_validate({**SOURCE, **changed})
    with pytest.raises(RobocasError):
        list(freeze_protocol(source, tmp_path / "inside" / "out"))
    assert not [path for path in tmp_path.rglob("*") if path != tmp_path / "inside"]
