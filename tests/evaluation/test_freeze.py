"""A protocol is made from a plan."""

import pytest
import yaml

from robocas_ms3.cli import eval as command
from robocas_ms3.errors import EvaluationError
from robocas_ms3.evaluation.freeze import Plan, freeze
from robocas_ms3.evaluation.protocol import load_protocol

PLAN = {
    "rules": {"name": "tiny", "description": "One episode.", "max_seconds": {"pick": 5}},
    "parts": [{"config": "pick_table_scattered", "count": 1, "first_seed": 110000, "split": "mine"}],
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frozen") / "tiny"
    steps = freeze(Plan.model_validate(PLAN), folder)
    assert next(steps) == (1, 1)
    assert not folder.exists()  # it appears whole
    assert list(steps) == []
    return folder


def test_it_appears_whole_and_loads(made):
    protocol = load_protocol(made)
    assert (protocol.rules.name, protocol.rules.max_seconds) == ("tiny", {"pick": 5.0})
    assert [path.name for path in made.parent.iterdir()] == ["tiny"]


def test_its_episode_is_that_of_the_shipped_protocol_of_the_same_seed(made):
    (mine,), shipped = load_protocol(made).episodes, load_protocol("smoke").episodes[0]
    assert mine.split == "mine"
    assert mine.model_copy(update={"split": shipped.split}) == shipped


def test_a_folder_that_is_there_is_refused_before_anything_is_drawn(made, tmp_path):
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(PLAN))
    with pytest.raises(EvaluationError, match="something already"):
        command.main(command.Eval(("freeze", str(tmp_path / "plan.yaml")), out=made))


@pytest.mark.parametrize("text", ["parts: []", "rules: [", "rules: {}\nparts: [{config: x}]"])
def test_no_plan(tmp_path, text):
    (tmp_path / "plan.yaml").write_text(text)
    with pytest.raises(EvaluationError, match=r"plan.yaml: no plan of a protocol") as caught:
        command.main(command.Eval(("freeze", str(tmp_path / "plan.yaml")), out=tmp_path / "out"))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_rules_that_no_protocol_has_leave_nothing_behind(tmp_path):
    plan = Plan.model_validate({**PLAN, "rules": {"name": "tiny", "speed": 1}})
    with pytest.raises(EvaluationError, match="no rules of a protocol.*speed"):
        list(freeze(plan, tmp_path / "out"))
    assert list(tmp_path.iterdir()) == []
