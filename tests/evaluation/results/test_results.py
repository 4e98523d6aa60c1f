"""Results are appended, continued, read as partial results, and merged."""

import json

import numpy as np
import pytest
from synthetic_results import RUN_OF, actions_of, outcome, write

from robocas_ms3.core.errors import EvaluationError, OutputExistsError
from robocas_ms3.evaluation.results.outcomes import EvaluatedEpisode, find_failure_stage
from robocas_ms3.evaluation.results.result_files import (
    OUTCOMES,
    RUN,
    append_episode,
    group_partial_results,
    merge_results,
    open_result,
    read_result,
)
from robocas_ms3.evaluation.results.run_record import RunRecord
from robocas_ms3.evaluation.results.stored_episodes import hash_actions

SEARCH = dict.fromkeys(("obstacles_cleared", "reached_any", "target_grasped", "target_lifted", "success"))


def start(folder, run=RUN_OF, new=(), **options):
    """Start or continue a result, add outcomes, and return the numbers of the existing outcomes."""
    with open_result(folder, RunRecord.from_values(run, folder / RUN), **options) as done:
        for one in new:
            append_episode(folder, EvaluatedEpisode(one, actions_of(one)))
        return list(done)


def stored(folder):
    """Return the numbers of the episodes with stored actions."""
    return sorted(int(path.stem) for path in folder.glob("actions/*.npz"))


def test_appended_outcomes_are_read_and_an_incomplete_line_is_overwritten(tmp_path):
    start(tmp_path / "a", new=[outcome(3), outcome(1)])
    assert read_result(tmp_path / "a").outcomes == {1: outcome(1), 3: outcome(3)}
    assert read_result(tmp_path / "a").run == RunRecord.from_values(RUN_OF, "")
    path = tmp_path / "a" / OUTCOMES
    path.write_bytes(path.read_bytes()[:-20])
    assert list(read_result(tmp_path / "a").outcomes) == [3]
    assert start(tmp_path / "a", new=[outcome(2)]) == [3]
    assert list(read_result(tmp_path / "a").outcomes) == [2, 3]
    assert stored(tmp_path / "a") == [2, 3]  # the actions of the incomplete line were deleted


def test_damaged_line_is_an_error_with_its_number(tmp_path):
    write(tmp_path / "a", [outcome(0)])
    with (tmp_path / "a" / OUTCOMES).open("a") as file:
        file.write('{"episode": 1}\n')
    with pytest.raises(EvaluationError, match=r"episodes.jsonl:2: invalid outcome"):
        read_result(tmp_path / "a")


@pytest.mark.parametrize("record", [None, {}, *({**RUN_OF, key: ["other"]} for key in ("protocol", "policy", "weld"))])
def test_folder_without_a_valid_record_is_refused(tmp_path, record):
    if record is not None:
        (tmp_path / RUN).write_text(json.dumps(record))
    what = "no evaluation result here" if record is None else "invalid evaluation result"
    with pytest.raises(EvaluationError, match=what):
        read_result(tmp_path)


def test_folder_of_results_suggests_a_result(tmp_path):
    write(tmp_path / "protocol" / "random", [outcome(0)])
    for folder in (tmp_path, tmp_path / "protocol"):
        with pytest.raises(EvaluationError) as error:
            read_result(folder)
        assert error.value.fix == f"Did you mean {tmp_path / 'protocol' / 'random'}?"


def test_result_of_another_policy_is_not_continued(tmp_path):
    """The error names both policies, and no other settings."""
    write(tmp_path / "a", [outcome(0)])
    other = {**RUN_OF, "policy": {"name": "other", "spec": {"rate_hz": 5}}}
    with pytest.raises(OutputExistsError) as error:
        start(tmp_path / "a", other)
    assert (error.value.found, error.value.expected) == ("mine", "other")
    assert start(tmp_path / "a", other, overwrite=True) == []
    assert stored(tmp_path / "a") == []


@pytest.mark.parametrize(
    "said", [{"server": 5}, {"server": ["x"]}, {"name": 3}, {"notes": float("nan")}, {"notes": "\ud800"}]
)
def test_run_with_an_invalid_record_does_not_start(tmp_path, said):
    run = {**RUN_OF, "policy": {**RUN_OF["policy"], **said}}
    with pytest.raises(EvaluationError) as error:
        start(tmp_path / "a", run)
    assert str(error.value.where).startswith(str(tmp_path / "a" / RUN))
    assert not (tmp_path / "a").exists()


def test_result_without_the_key_weld_has_no_weld(tmp_path):
    run = {name: value for name, value in RUN_OF.items() if name != "weld"}
    start(tmp_path / "a", run, [outcome(0)])
    write(tmp_path / "b", [outcome(1)])
    assert read_result(tmp_path / "a").run == RunRecord.from_values(RUN_OF, "")
    assert list(read_result(tmp_path / "a", tmp_path / "b").outcomes) == [0, 1]
    assert start(tmp_path / "a") == [0]
    with pytest.raises(OutputExistsError, match="weld: false -> true"):
        start(tmp_path / "a", {**RUN_OF, "weld": True})


def test_partial_results_with_other_clock_times_and_machines_are_merged(tmp_path):
    """Integers stay integers."""
    counts = {"path_length": 1.0, "fallen": 3, "disturbed_most": 0}
    write(tmp_path / "a", [outcome(0, measures=counts, seconds=40, p_vis=1, inference_ms=2, flag_seconds={"fail": 5})])
    write(
        tmp_path / "b",
        [outcome(1), outcome(0, measures=counts, seconds=40, p_vis=1, flag_seconds={"fail": 5})],
        machine={"processor": "arm64"},
    )
    both = merge_results([tmp_path / "a", tmp_path / "b"], tmp_path / "c")
    assert list(both.outcomes) == [0, 1]
    assert [part.episodes for part in both.run.merged_from] == [1, 2]
    first, second, merged = ((tmp_path / name / OUTCOMES).read_text() for name in "abc")
    assert merged == first + second.splitlines(keepends=True)[0]
    assert '"fallen": 3,' in merged
    assert [both.read_actions(number)[0, 0] for number in (0, 1)] == [0, 1] and both.folder == tmp_path / "c"
    assert start(tmp_path / "c") == [0, 1]
    with pytest.raises(OutputExistsError):
        merge_results([tmp_path / "a", tmp_path / "b"], tmp_path / "c")


def test_partial_results_whose_actions_differ_in_the_last_bit_are_merged(tmp_path):
    """The first partial result has its outcome and its actions in the merged result."""
    write(tmp_path / "a", [outcome(0)])
    almost = actions_of(outcome(0)) + np.float32(1e-7)
    write(tmp_path / "b", [])
    append_episode(tmp_path / "b", EvaluatedEpisode(outcome(0, actions_hash=hash_actions(almost)), almost))
    merged = merge_results([tmp_path / "a", tmp_path / "b"], tmp_path / "c")
    assert (merged.read_actions(0) == actions_of(outcome(0))).all()


def test_partial_results_without_actions_are_not_merged(tmp_path):
    write(tmp_path / "a", [outcome(0)])
    (tmp_path / "a" / "actions" / "000000.npz").unlink()
    with pytest.raises(EvaluationError):
        merge_results([tmp_path / "a"], tmp_path / "c")
    assert not (tmp_path / "c").exists()


def test_partial_results_with_different_outcomes_are_refused(tmp_path):
    write(tmp_path / "a", [outcome(0)])
    write(tmp_path / "b", [outcome(0, seconds=3.6)])
    with pytest.raises(EvaluationError, match=r"different outcomes of episode 0.*seconds: 3\.5 -> 3\.6"):
        merge_results([tmp_path / "a", tmp_path / "b"], tmp_path / "both")
    with pytest.raises(EvaluationError, match=r"jsonl:2: different outcomes of episode 0"):
        write(tmp_path / "c", [outcome(0), outcome(0, came_to=3)])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "c"]


OTHERS = {
    "protocol_hash": "ef" * 32,
    "policy": {"name": "other"},
    "weld": True,
    "versions": {"torch": "other"},
    "source_hash": "12" * 32,
    "pack_hashes": {"builtin": "other"},
    "backend": "gpu",
}


@pytest.mark.parametrize("key", OTHERS)
def test_results_with_other_settings_are_neither_continued_nor_merged(tmp_path, key):
    write(tmp_path / "a", [outcome(0)])
    with pytest.raises(OutputExistsError, match=key):
        start(tmp_path / "a", {**RUN_OF, key: OTHERS[key]})
    write(tmp_path / "b", [outcome(1)], **{key: OTHERS[key]})
    with pytest.raises(EvaluationError, match=f"the settings {key} differ.*{key}"):
        merge_results([tmp_path / "a", tmp_path / "b"], tmp_path / "both")
    assert group_partial_results([tmp_path / "a", tmp_path / "b"]) == [[tmp_path / "a"], [tmp_path / "b"]]
    assert start(tmp_path / "a", {**RUN_OF, key: OTHERS[key]}, overwrite=True) == []


def test_folders_with_common_episodes_are_separate_results(tmp_path):
    """For example two checkpoints with the same name."""
    for name, numbers in (("a", (0, 1)), ("b", (2,)), ("c", (1, 2))):
        write(tmp_path / name, [outcome(number) for number in numbers])
    folders = [tmp_path / name for name in "abc"]
    assert group_partial_results(folders) == [folders[:2], folders[2:]]


@pytest.mark.parametrize(
    ("reached", "stage"),
    [
        ((), "reached_any"),
        (("reached_any",), "obstacles_cleared"),
        (("reached_any", "obstacles_cleared"), "target_grasped"),
        (("reached_any", "target_grasped"), "target_lifted"),  # pulled out of the heap
        (("reached_any", "target_grasped", "target_lifted"), "placed"),
        (("reached_any", "success"), ""),
    ],
)
def test_failure_stage(reached, stage):
    assert find_failure_stage(SEARCH | dict.fromkeys(reached, 5)) == stage
    assert find_failure_stage({"reached_any": None, "furniture_opened": 7 if reached else None}) == (
        "reached_any" if reached else "furniture_opened"
    )
    assert find_failure_stage({"reached_any": 5}, "policy died") == "error"


SERVED = {"server": {"name": "mine", "class": "m:Mine"}, "n_action_steps": None, "spec": {}}


def test_address_of_a_server_is_not_part_of_the_settings(tmp_path):
    """For example two servers that serve one shard each."""
    write(tmp_path / "a", [outcome(0)], policy={"name": "ws://a:8001?connect_s=3", **SERVED})
    write(tmp_path / "b", [outcome(1)], policy={"name": "ws://b:8002", **SERVED})
    assert list(read_result(tmp_path / "a", tmp_path / "b").outcomes) == [0, 1]
    assert group_partial_results([tmp_path / "a", tmp_path / "b"]) == [[tmp_path / "a", tmp_path / "b"]]
    assert start(tmp_path / "a", {**RUN_OF, "policy": {"name": "ws://c:1", **SERVED}}) == [0]
    assert read_result(tmp_path / "a").run.policy.name.startswith("ws://a")
    other = {**SERVED, "server": {"name": "other"}}
    with pytest.raises(OutputExistsError, match='policy.server.name: "mine" -> "other"'):
        start(tmp_path / "a", {**RUN_OF, "policy": {"name": "ws://c:1", **other}})
    silent = {**SERVED, "server": None}  # a plain openpi server: its policy is unknown
    write(tmp_path / "c", [outcome(0)], policy={"name": "ws://a:1", **silent})
    write(tmp_path / "d", [outcome(1)], policy={"name": "ws://a:2", **silent})
    with pytest.raises(EvaluationError, match="the settings policy differ"):
        read_result(tmp_path / "c", tmp_path / "d")


def test_episodes_with_an_error_run_again_with_retry_errors(tmp_path):
    broken = outcome(1, 0, error="no server", failure_stage="error")
    write(tmp_path / "a", [outcome(0), broken, outcome(2)])
    assert start(tmp_path / "a") == [0, 1, 2]
    assert read_result(tmp_path / "a").count_errors() == 1
    assert start(tmp_path / "a", retry_errors=True) == [0, 2]
    assert stored(tmp_path / "a") == [0, 2]
    assert start(tmp_path / "a", new=[outcome(1)]) == [0, 2]
    assert read_result(tmp_path / "a").outcomes[1].success


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("notes", ['{"settings": {"task": "pick"}, "first_seed": 0}', "[]", "{"])
def test_folder_of_another_command_is_not_changed(tmp_path, notes, overwrite):
    """Folders of demonstrations also have a run.json."""
    (tmp_path / RUN).write_text(notes)
    with pytest.raises(OutputExistsError):
        start(tmp_path, overwrite=overwrite)
    assert (tmp_path / RUN).read_text() == notes
