import pytest

from robocas_ms3.scenes.language.templates import GOAL_TYPES, SUBGOALS, subgoal


@pytest.mark.parametrize(
    ("goal_type", "text"),
    [
        ("find the object", "find the apple on the table"),
        ("operate the target", "open the table"),
        ("move and grasp", "grasp the apple on the table"),
        ("transfer object", "Drop the apple into the basket"),
        ("grasp object", "grasp the apple"),
        ("release object", "release the apple"),
        ("lift object", "lift the apple"),
        ("grasp and lift the object", "grasp and lift the apple"),
    ],
)
def test_subgoal_texts(goal_type, text):
    assert subgoal(goal_type, "apple", "table") == {"goal_type": goal_type, "goal_description": text}


def test_every_type_has_a_text():
    assert len(GOAL_TYPES) == 8
    assert tuple(SUBGOALS) == GOAL_TYPES
