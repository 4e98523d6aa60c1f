import pytest

from robocas_ms3.language.templates import GOAL_TYPES, SUBGOALS, pick_instruction, search_instruction, subgoal


def test_instructions_are_upstreams_word_for_word():
    assert pick_instruction("sugar box", "table") == "grasp the sugar box on the table and move it to the basket"
    assert (
        search_instruction("apple", "shelf")
        == "search the apple from the objects on the shelf and transfer it to the basket"
    )


@pytest.mark.parametrize(
    ("goal_type", "text"),
    [
        ("find the object", "find the apple on the table"),
        ("operate the target", "open the table"),
        ("move and grasp", "grasp the apple on the table"),
        ("transfer object", "Drop the apple into the basket"),
    ],
)
def test_subgoal_texts(goal_type, text):
    assert subgoal(goal_type, "apple", "table") == {"goal_type": goal_type, "goal_description": text}


def test_types_without_a_text_are_refused():
    assert len(GOAL_TYPES) == 8
    assert set(SUBGOALS) < set(GOAL_TYPES)
    with pytest.raises(KeyError):
        subgoal("lift object", "apple", "table")
