"""Marks of the recorded episode in the decisions of a seed."""

from synthetic_candidates import make_record

from robocas_ms3.demos.candidates.records import PathDecision, mark_episode


def make_records(count):
    records = [make_record(3, number) for number in range(count)]
    for record in records:
        record.values |= {"in_episode": False, "moves_left": -1}
        for candidate in record.candidates:
            candidate["chosen"] = False
    return records


def test_decisions_of_the_episode_get_their_choice_and_the_number_of_moves_that_follow():
    records = make_records(4)  # the second one is of an undone attempt
    path = [PathDecision("move", 0, chosen=2), PathDecision("move", 2, chosen=0)]
    path += [PathDecision("move", None), PathDecision("grasp", 3, chosen=1)]
    mark_episode(records, path)
    assert [record.values["in_episode"] for record in records] == [True, False, True, True]
    chosen = [[i for i, one in enumerate(record.candidates) if one["chosen"]] for record in records]
    assert chosen == [[2], [], [0], [1]]
    assert [record.values["moves_left"] for record in records] == [2, -1, 1, 0]


def test_decision_without_a_known_choice_is_in_the_episode():
    records = make_records(1)
    mark_episode(records, [PathDecision("move", 0)])
    assert records[0].values["in_episode"]
    assert not any(one["chosen"] for one in records[0].candidates)
