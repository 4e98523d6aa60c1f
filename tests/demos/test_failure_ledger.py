from robocas_ms3.demos.ledger import Failure, Ledger, count_by_stage


def test_lines_survive_and_a_cut_one_is_dropped(tmp_path):
    ledger = Ledger(tmp_path / "failures.jsonl")
    assert ledger.read() == []
    first, last = Failure(3, 0, "lift", "slipped", 1.5), Failure(3, -1, "episode", "gave_up", 0.0)
    ledger.append([first])
    ledger.append([last])
    with ledger.path.open("a") as file:
        file.write('{"seed": 4, "attem')
    assert ledger.read() == [first, last]
    assert [failure.gave_up for failure in ledger.read()] == [False, True]


def test_keep_only_forgets_seeds_that_run_again(tmp_path):
    ledger = Ledger(tmp_path / "failures.jsonl")
    ledger.append([Failure(seed, 0, "grasp", "missed", 1.0) for seed in (1, 2, 3)])
    ledger.keep_only({1, 3})
    assert [failure.seed for failure in ledger.read()] == [1, 3]


def test_failures_are_counted_by_stage_and_reason():
    failures = [
        Failure(1, 0, "lift", "slipped", 1.0),
        Failure(1, 1, "reach", "no_ik", 1.0),
        Failure(2, 0, "lift", "slipped", 1.0),
    ]
    assert count_by_stage([*failures, Failure(2, -1, "episode", "gave_up", 0.0)]) == {
        "lift: slipped": 2,
        "reach: no_ik": 1,
    }
