"""Marks of the recorded episode in the decisions of a seed."""

from synthetic_candidates import make_record

from robocas_ms3.demos.candidates.records import PathDecision, mark_episode


def make_records(count):
    records = [make_record(3, number) for number in range(count)]
    for record in records:
        record.values["in_episode"] = False
        for candidate in record.candidates:
            candidate["chosen"] = False
    return records


def test_chosen_moves_get_the_number_of_moves_that_follow():
    records = make_records(4)
    undone = records[1]  # by a failed attempt
    path = [
        PathDecision("move", 0, 2),
        PathDecision("move", 2, 0),
        PathDecision("move", None),
        PathDecision("grasp", 3, 1),
    ]
    mark_episode(records, path)
    assert [record.values["in_episode"] for record in records] == [True, False, True, True]
    assert [[i for i, one in enumerate(record.candidates) if one["chosen"]] for record in records] == [
        [2],
        [],
        [0],
        [1],
    ]
    assert records[0].candidates[2]["moves_to_grasp"] == 2
    assert records[2].candidates[0]["moves_to_grasp"] == 1
    assert records[3].candidates[1]["moves_to_grasp"] == -1
    assert {one["moves_to_grasp"] for one in undone.candidates} == {-1}


def test_decision_without_a_known_choice_is_in_the_episode():
    records = make_records(1)
    mark_episode(records, [PathDecision("move", 0)])
    assert records[0].values["in_episode"]
    assert not any(one["chosen"] for one in records[0].candidates)
