"""`robocas eval verify` finds changes of a result."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from synthetic_results import of_protocol

from robocas_ms3.cli.eval_results import Verify, verify
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.results import verify as verify_module
from robocas_ms3.evaluation.results.result_files import OUTCOMES, RUN, read_result
from robocas_ms3.evaluation.results.stored_episodes import hash_actions, write_actions
from robocas_ms3.evaluation.results.verify import find_violations
from robocas_ms3.scenes.task_specs import TASKS


@pytest.fixture(scope="module")
def protocol():
    return load_protocol("smoke")


@pytest.fixture
def folder(tmp_path, protocol):
    of_protocol(tmp_path / "result", protocol)
    return tmp_path / "result"


MOVE = {"object": "lid", "step": 5, "needed": True, "in_order": True}
ORDER = {"moved": [MOVE], "needed": ["lid"], "left": 1, "score": 0.5}


def tamper(folder, line, **values):
    path = folder / OUTCOMES
    lines = path.read_text().splitlines()
    lines[line] = json.dumps(json.loads(lines[line]) | values)
    path.write_text("\n".join(lines) + "\n")


def seconds_of(flags):
    return {name: None if step is None else step / 20 for name, step in flags.items()}


@pytest.mark.parametrize(
    ("changes", "violation"),
    [
        (
            {"reached_any": None},
            "reached_target held at step 30, expected reached_any at the same step or before, found None",
        ),
        (
            {"target_lifted": None},
            "success held at step 70, expected target_lifted at the same step or before, found None",
        ),
        (
            {"target_in_basket": None},
            "success held at step 70, expected target_in_basket at the same step or before, found None",
        ),
        ({"picked_any": 55}, "target_lifted held at step 50, expected picked_any at the same step or before, found 55"),
        (
            {"reached_target": 45},
            "target_grasped held at step 40, expected reached_target at the same step or before, found 45",
        ),
    ],
)
def test_flags_in_an_impossible_order_are_found(folder, protocol, changes, violation):
    flags = read_result(folder).outcomes[0].flags | changes
    tamper(folder, 0, flags=flags, flag_seconds=seconds_of(flags))
    assert f"episode 0: flags: {violation}" in find_violations(read_result(folder), protocol)


@pytest.mark.parametrize("name", ["target_in_basket", "success_v0"])
def test_flags_of_the_basket_must_exist(folder, protocol, name):
    """Incident: without the flag target_in_basket, an outcome could skip the stages before success."""
    flags = {flag: step for flag, step in read_result(folder).outcomes[0].flags.items() if flag != name}
    flags |= {"target_lifted": None}
    tamper(folder, 0, flags=flags, flag_seconds=seconds_of(flags), success_v0=False)
    found = find_violations(read_result(folder), protocol)
    assert f"episode 0: flags: missing {name}" in found
    assert any("expected target_lifted at the same step or before" in text for text in found)


def test_an_episode_without_an_error_has_a_step(folder, protocol):
    """Incident: a result whose episodes all succeed after 0 steps had no violations."""
    flags = {name: None if step is None else 0 for name, step in read_result(folder).outcomes[0].flags.items()}
    actions = np.zeros((0, 7), np.float32)
    write_actions(folder, 0, actions)
    (folder / "checkpoints" / "000000.npz").unlink()
    values = {"steps": 0, "seconds": 0.0, "flags": flags, "flag_seconds": seconds_of(flags)}
    tamper(folder, 0, **values, actions_hash=hash_actions(actions))
    assert find_violations(read_result(folder), protocol) == [
        "episode 0: 0 steps, expected at least 1 without an error"
    ]
    failed = {"success": False, "success_at_end": False, "success_v0": False, "failure_stage": "error"}
    tamper(folder, 0, **failed, error="the worker process crashed")
    assert find_violations(read_result(folder), protocol) == []


def test_search_needs_a_retrieval_order(folder, protocol):
    number = next(one.episode for one in protocol.episodes if one.task == "search")
    tamper(folder, number, retrieval=None)
    (violation,) = find_violations(read_result(folder), protocol)
    assert violation.startswith(f"episode {number}: retrieval: ")


def test_flags_of_custom_tasks_may_differ(folder, protocol, monkeypatch):
    flags = {"success": 70, "fail": None, "success_v0": 70}
    tamper(folder, 0, flags=flags, flag_seconds=seconds_of(flags))
    assert "flags: missing reached_any" in find_violations(read_result(folder), protocol)[0]

    class CustomTasks(dict):
        builtin: ClassVar[dict] = {}

    monkeypatch.setattr(verify_module, "TASKS", CustomTasks(TASKS.builtin))
    assert not any("flags: " in text for text in find_violations(read_result(folder), protocol) if "episode 0" in text)


def test_damaged_checkpoints_are_found(folder, protocol):
    path = folder / "checkpoints" / "000003.npz"
    path.write_bytes(b"PK")
    (violation,) = find_violations(read_result(folder), protocol)
    assert violation.startswith("episode 3: ") and "000003.npz" in violation


def test_an_episode_that_nothing_ended_and_times_of_other_steps_are_found(folder, protocol):
    before = read_result(folder).outcomes[0]
    flags = {**before.flags, "success": None}
    failed = {"success": False, "success_at_end": False, "failure_stage": "placed"}
    tamper(folder, 0, flags=flags, flag_seconds=seconds_of(flags), **failed)
    assert find_violations(read_result(folder), protocol) == [
        "episode 0: 70 steps, but nothing ended the episode before step 800"
    ]
    tamper(folder, 0, flags=flags, flag_seconds=seconds_of(flags), **failed, error="lost", success_v0=False)
    found = find_violations(read_result(folder), protocol)
    assert found == ["episode 0: failure_stage is placed, expected error from the flags"]
    tamper(folder, 1, flag_seconds={**before.flag_seconds, "reached_any": 0.6})
    found = find_violations(read_result(folder), protocol)
    assert "episode 1: flag_seconds.reached_any is 0.6, expected 0.5 for 10 steps at 20 Hz" in found


def test_success_of_an_episode_with_an_error_is_refused(folder):
    tamper(folder, 0, error="the connection was lost")
    with pytest.raises(EvaluationError, match=f"{OUTCOMES}:1: "):
        read_result(folder)


def tamper_run(folder, **values):
    path = folder / RUN
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"seed": 5}, "episode 0: seed is 5, expected 110000"),
        ({"task": "search"}, "episode 0: task is search, expected pick"),
        ({"config": "easier"}, "episode 0: config is easier, expected pick_table_scattered"),
        ({"split": "train"}, "episode 0: split is train, expected test"),
        ({"p_vis": 0.9}, "episode 0: p_vis is 0.9, expected None"),
        ({"success": False}, "episode 0: success is False, but flags.success is 70"),
        ({"failure_stage": "placed"}, "episode 0: failure_stage is placed, expected empty from the flags"),
        ({"steps": 801}, "episode 0: 801 steps, expected at most 800 by the rules of the protocol"),  # 40 s at 20 Hz
        (
            {"steps": 71},
            "episode 0: success held at step 70, where the protocol ends the episode, but the episode has 71 steps",
        ),
        ({"steps": 69}, "episode 0: flags: success, success_v0 first held after the last step, expected at most 69"),
        ({"success_at_end": True, "success": False}, "episode 0: success_at_end is True, but success is False"),
        ({"flags": {"success_v0": None}}, "episode 0: success_v0 is True, but flags.success_v0 is None"),
        ({"seconds": 3.0}, "episode 0: seconds is 3, expected 3.5 for 70 steps at 20 Hz"),
        (
            {"flags": {"success": 70}},
            "episode 0: flags: missing reached_any, picked_any, reached_target, target_grasped, target_lifted, "
            "target_in_basket, fail, success_v0",
        ),
        (
            {"measures": {"path_length": 1.0, "fallen": 0.0}},
            "episode 0: measures: missing contact_impulse, disturbed_most",
        ),
        (
            {"flag_seconds": {"success": 3.6}},
            "episode 0: flag_seconds: success first held after the end of the episode at 3.5 s",
        ),
        ({"flag_seconds": {}}, "episode 0: flag_seconds and flags have different keys or values"),
        ({"episode": 99}, "episode 99: this episode is not in the protocol"),
    ],
)
def test_changed_outcomes_are_found(folder, protocol, values, said):
    assert find_violations(read_result(folder), protocol) == []
    tamper(folder, 0, **values)
    found = find_violations(read_result(folder), protocol)
    assert said in found
    assert ("1 of 8 episodes missing" in found) == ("episode" in values)


@pytest.mark.parametrize(
    "values",
    [
        {"inference_ms": math.nan},
        {"measures": {"path_length": -1.0}},
        {"episode": -1},
        {"retrieval": {**ORDER, "score": 7.5}},
        {"retrieval": {**ORDER, "moved": [{"object": "lid"}]}},
    ],
    ids=str,
)
def test_values_out_of_range_are_refused(folder, values):
    tamper(folder, 0, **values)
    with pytest.raises(EvaluationError, match=f"{OUTCOMES}:1: "):
        read_result(folder)


def test_another_protocol_or_pack_or_an_impossible_weld_is_found(folder, protocol):
    tamper(folder, 0, measures=read_result(folder).outcomes[0].measures | {"welds": 1.0})
    assert find_violations(read_result(folder), protocol) == [
        "episode 0: unexpected value measures.welds: the run has weld: False"
    ]
    tamper_run(folder, weld=True)
    found = find_violations(read_result(folder), protocol)
    assert "weld: true, but the weld needs a protocol with RoboCAS-v0's steps" in found
    assert "episode 1: missing value measures.welds: the run has weld: True" in found
    assert len(found) == 8
    tamper_run(folder, protocol_hash="ef" * 32, pack_hashes={"builtin": "00"})
    protocol_and_pack = find_violations(read_result(folder), protocol)[:2]
    assert [problem.partition(": ")[0][:13] for problem in protocol_and_pack] == ["protocol hash", "hash of pack "]


@pytest.mark.parametrize("change", [Path.unlink, lambda path: np.savez(path, actions=np.ones((70, 7), np.float32))])
def test_missing_or_changed_actions_are_found(folder, protocol, change):
    change(folder / "actions" / "000003.npz")
    (violation,) = find_violations(read_result(folder), protocol)
    assert violation.startswith("episode 3: ") and "000003.npz" in violation


def test_changed_hash_of_actions_is_found(folder, protocol):
    for changed in ("", "ab" * 32):
        tamper(folder, 0, actions_hash=changed)
        (violation,) = find_violations(read_result(folder), protocol)
        assert violation.startswith("episode 0: ")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("track", "fast"),
        ("rate_hz", "20"),
        ("rate_hz", 0),
        ("cameras", ["base_camera"]),
        ("calibration", "x"),
        ("n", 1),
        ("convention", "x"),
    ],
)
def test_invalid_specifications_of_the_policy_are_found(folder, protocol, key, value):
    tamper_run(folder, policy={"name": "mine", "spec": {"rate_hz": 20, key: value}})
    (violation,) = find_violations(read_result(folder), protocol)
    assert violation.startswith(f"policy.spec.{key}")


def test_an_outcome_of_select_is_valid_only_if_the_run_has_played_as(tmp_path):
    protocol = load_protocol("paper-v1")
    folder = of_protocol(tmp_path / "result", protocol).folder
    assert find_violations(read_result(folder), protocol) == []
    tamper(folder, 0, task="select")
    assert find_violations(read_result(folder), protocol) == ["episode 0: task is select, expected pick"]
    tamper_run(folder, played_as={"select": "pick"})
    violations = find_violations(read_result(folder), protocol)
    assert len(violations) == 199 and set(violations) == {
        f"episode {number}: task is pick, expected select" for number in range(1, 200)
    }
    tamper_run(folder, played_as={"search": "pick"})
    assert "played_as is {'search': 'pick'}, but this protocol allows no such alias" in find_violations(
        read_result(folder), protocol
    )


@pytest.mark.parametrize(
    ("changed", "well"), [({}, True), ({"score": None}, False), ({"moved": [{**MOVE, "step": 10**6}]}, False)]
)
def test_inconsistent_retrieval_orders_are_found(folder, protocol, changed, well):
    """The order is checked for every task with the stage obstacles_cleared."""
    before = read_result(folder).outcomes[0]
    flags, seconds = before.flags | {"obstacles_cleared": 20}, before.flag_seconds | {"obstacles_cleared": 1.0}
    tamper(folder, 0, flags=flags, flag_seconds=seconds, retrieval={**ORDER, **changed})
    assert len(find_violations(read_result(folder), protocol)) == (0 if well else 1)
    tamper(folder, 1, retrieval=ORDER)
    assert any(
        text.startswith("episode 1: retrieval: unexpected") for text in find_violations(read_result(folder), protocol)
    )


def test_failure_stage_is_checked_with_the_stages_of_the_task(folder, protocol, monkeypatch):
    row = replace(TASKS["pick"], stages=("reached_target", "aligned"))
    monkeypatch.setitem(TASKS.builtin, "pick", row)
    never = dict.fromkeys(read_result(folder).outcomes[0].flags)
    flags = {**never, "reached_any": 1, "reached_target": 2, "aligned": None, "fail": 70}
    failed = {"success": False, "success_at_end": False, "success_v0": False, "failure_stage": "aligned"}
    tamper(folder, 0, flags=flags, flag_seconds=seconds_of(flags), **failed)
    assert find_violations(read_result(folder), protocol) == []
    monkeypatch.undo()
    assert find_violations(read_result(folder), protocol) == [
        "episode 0: failure_stage is aligned, expected target_grasped from the flags"
    ]


def test_verify_command_fails_on_violations_and_ignores_folders_named_in_a_result(
    folder, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ms3-v1").mkdir()  # a folder with the name of a bundled protocol is not used
    assert verify(Verify((folder,))) == 0
    assert "8 episodes of smoke, no violations" in capsys.readouterr().out
    shutil.copytree(load_protocol("smoke").folder, tmp_path / "easy")
    tamper_run(folder, protocol="easy")
    with pytest.raises(EvaluationError, match="protocol of the result is not bundled.*found easy.*--protocol FOLDER"):
        verify(Verify((folder,)))
    assert verify(Verify((folder,), protocol="easy")) == 0
    tamper(folder, 3, seed=5)
    assert verify(Verify((folder,), protocol="easy")) == 1
    assert "episode 3: seed is 5, expected 110001" in capsys.readouterr().out
