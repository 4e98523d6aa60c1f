from robocas_ms3.demos.ledger import Failure, Ledger, count_by_stage, failed_attempts


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


def test_settled_it_holds_what_it_should(tmp_path):
    ledger = Ledger(tmp_path / "failures.jsonl")
    lines = [Failure(seed, 0, "grasp", "missed", 1.0) for seed in (1, 2, 3)]
    ledger.settle([])
    assert not ledger.path.exists()
    ledger.append([lines[2], lines[0], lines[0], Failure(9, 0, "grasp", "missed", 1.0)])
    assert ledger.by_seed()[1] == [lines[0]]
    ledger.settle(lines)
    assert ledger.read() == lines
    written = ledger.path.stat().st_mtime_ns
    ledger.settle(lines)
    assert ledger.path.stat().st_mtime_ns == written
    ledger.path.write_bytes(ledger.path.read_bytes() + b"{damaged}\n")
    ledger.settle(lines)
    assert b"damaged" not in ledger.path.read_bytes()


def test_what_a_record_says_of_failures_fills_what_the_file_has_lost():
    noted = [Failure(4, 1, "reach", "far: too far", 2.5), Failure(4, 2, "lift", "slipped", 1.0)]
    found = failed_attempts(4, ["lift: slipped", "reach: far: too far", "grasp: missed"], noted)
    assert found == [Failure(4, 0, "lift", "slipped", 0.0), noted[0], Failure(4, 2, "grasp", "missed", 0.0)]


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
