"""`robocas eval clutter-scale` with synthetic results on a protocol with difficulties."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import asdict, replace

import numpy as np
import pytest
from synthetic_results import of_protocol, write

from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.demos.difficulty.records import SceneDifficulty
from robocas_ms3.evaluation.clutter_scale.scale_file import SCALE_FILE
from robocas_ms3.evaluation.clutter_scale.study import make_study
from robocas_ms3.evaluation.protocols.bundled_protocols import bundled_protocols
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.protocols.scene_difficulties import DIFFICULTIES
from robocas_ms3.evaluation.results.result_files import OUTCOMES, read_result

SPEC = {"track": "modular", "rate_hz": 20}
ABILITIES = {"weak": 0.5, "middle": 1.5, "strong": 2.5}  # removals at which the policy succeeds half of the time


def make_policy(name):
    return {"name": name, "class": "mine:Policy", "spec": SPEC}


def write_part(folder, result, outcomes):
    """Write a result with the settings of another and some of its outcomes."""
    return write(folder, outcomes, **result.run.to_dict())


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """Return a protocol with difficulties, and the folders of the results of three policies."""
    folder, rng = tmp_path_factory.mktemp("scale"), np.random.default_rng(0)
    shutil.copytree(bundled_protocols()["clutter-v1"], folder / "protocol")
    protocol = load_protocol(folder / "protocol")
    scenes = [
        SceneDifficulty(
            seed=episode.seed,
            target=episode.target,
            objects=8,
            visible_fraction=float(rng.uniform()),
            obstacles=int(rng.integers(4)),
            free_grasps=int(rng.integers(9)),
            fewest_blockers=0,
            gap=0.01,
            removals=[None, 0, 1, 2, 3][number % 5],
            first_removals=[],
            scripted_removal=None,
            simulated_removals=0,
            complete=True,
        )
        for number, episode in enumerate(protocol.episodes)
    ]
    lines = "".join(json.dumps(asdict(scene)) + "\n" for scene in scenes)
    (folder / "protocol" / DIFFICULTIES).write_text(lines)
    of_protocol(folder / "template", protocol)
    results = {}
    for name, ability in ABILITIES.items():
        removals = np.array([4 if scene.removals is None else scene.removals for scene in scenes])
        chance = 1 / (1 + np.exp(-3 * (ability - removals)))
        failed = [number for number, p in enumerate(chance) if rng.uniform() >= p]
        results[name] = of_protocol(folder / name, protocol, failed, policy=make_policy(name))
    return folder, protocol, results


@pytest.mark.parametrize("task", ["pick", "search"])
def test_policies_are_placed_by_their_abilities(study, task):
    _, protocol, results = study
    found = make_study(list(results.values()), protocol).tasks[task]
    assert [policy.name for policy in found.policies] == ["strong", "middle", "weak"]
    halves = [policy.curve.half for policy in found.policies if policy.curve.half is not None]
    assert len(halves) == 3
    assert halves == sorted(halves, reverse=True)
    for policy, half in zip(found.policies, halves, strict=True):
        assert policy.curve.low < half < policy.curve.high
        assert policy.curve.episodes == 80, "scenes without a number of removals are left out"
    assert found.mean_auc is not None
    assert found.mean_auc > 0.8
    assert max(found.standard_weights, key=lambda name: found.standard_weights[name]) == "removals"


def test_tasks_have_the_scenes_with_a_number_of_removals(study):
    _, protocol, results = study
    tasks = make_study(list(results.values()), protocol).tasks
    assert list(tasks) == ["pick", "search"]
    for name, task in tasks.items():
        expected = [n for n, episode in enumerate(protocol.episodes) if episode.task == name and n % 5]
        assert task.episodes.tolist() == expected
        assert task.difficulty.shape == (80,)


def test_command_writes_numbers_and_a_plot(study, tmp_path, capsys):
    folder, _, results = study
    command = ["eval", "clutter-scale", *(str(folder / name) for name in results)]
    assert run([*command, "--protocol", str(folder / "protocol"), "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "strong" in printed
    assert "not audited" in printed
    written = json.loads((tmp_path / "curves.json").read_text())
    assert written["left_out"] == {}
    for task in ("pick", "search"):
        assert [policy["name"] for policy in written["tasks"][task]["policies"]] == ["strong", "middle", "weak"]
        assert len(written["tasks"][task]["difficulty"]) == len(written["tasks"][task]["episodes"]) == 80
    assert (tmp_path / "clutter_scale.png").read_bytes().startswith(b"\x89PNG")


def test_command_identifies_the_scale_by_the_hashes_of_its_files(study, tmp_path, capsys):
    """A scale that was fitted and then fixed has the same hash in both studies."""
    folder, protocol, results = study
    shutil.copytree(protocol.folder, tmp_path / "protocol")
    command = ["eval", "clutter-scale", *(str(folder / name) for name in results)]
    command += ["--protocol", str(tmp_path / "protocol"), "--out"]
    assert run([*command, str(tmp_path / "fitted")]) == 0
    shutil.copy(tmp_path / "fitted" / SCALE_FILE, tmp_path / "protocol")
    assert capsys.readouterr().out.count("sha256") == 1
    assert run([*command, str(tmp_path / "fixed")]) == 0
    files = {name: (tmp_path / "protocol" / name).read_bytes() for name in (DIFFICULTIES, SCALE_FILE)}
    hashes = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    output = capsys.readouterr().out
    assert all(digest[:8] in output for digest in hashes.values())
    for name, is_fixed in {"fitted": False, "fixed": True}.items():
        written = json.loads((tmp_path / name / "curves.json").read_text())
        assert (written["is_fixed"], written["sha256"]) == (is_fixed, hashes)


def test_fixed_scale_of_the_protocol_places_one_policy(study, tmp_path):
    """The scale that was fitted to three policies gives one of them the same place alone."""
    _, protocol, results = study
    fitted = make_study(list(results.values()), protocol)
    assert not fitted.is_fixed
    folder = tmp_path / "protocol"
    shutil.copytree(protocol.folder, folder)
    fitted.write(folder)
    fixed = load_protocol(folder)
    assert fixed.hash == protocol.hash, "the scale is not part of the protocol"
    alone = make_study([results["middle"]], fixed)
    assert alone.is_fixed
    for name, task in alone.tasks.items():
        (policy,) = task.policies
        among = next(policy for policy in fitted.tasks[name].policies if policy.name == "middle")
        assert policy.curve.half == pytest.approx(among.curve.half)
        assert policy.auc is not None
        assert policy.auc > 0.8
        assert sorted(task.fitted) == ["middle", "strong", "weak"]
    again = make_study(list(results.values()), fixed, fit=True)
    assert not again.is_fixed
    assert again.tasks["pick"].scale.weights == pytest.approx(fitted.tasks["pick"].scale.weights)


def test_fixed_scale_without_the_task_of_a_result_is_an_error(study, tmp_path):
    _, protocol, results = study
    folder = tmp_path / "protocol"
    shutil.copytree(protocol.folder, folder)
    make_study(list(results.values()), protocol).write(folder)
    content = json.loads((folder / SCALE_FILE).read_text())
    del content["tasks"]["search"]
    (folder / SCALE_FILE).write_text(json.dumps(content))
    fixed = load_protocol(folder)
    both = make_study([results["middle"]], fixed)
    assert (list(both.tasks), list(both.left_out)) == (["pick"], ["search"])
    outcomes = [outcome for outcome in results["middle"].outcomes.values() if outcome.task == "search"]
    with pytest.raises(EvaluationError, match="no fixed scale"):
        make_study([write_part(tmp_path / "search", results["middle"], outcomes)], fixed)


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content["tasks"]["pick"]["weights"].pop("removals"),
        lambda content: content["tasks"]["pick"].pop("offset"),
        lambda content: content["tasks"]["pick"].update(offset="3"),
        lambda content: content.clear(),
    ],
)
def test_damaged_scale_is_an_error(study, tmp_path, change):
    _, protocol, results = study
    folder = tmp_path / "protocol"
    shutil.copytree(protocol.folder, folder)
    make_study(list(results.values()), protocol).write(folder)
    content = json.loads((folder / SCALE_FILE).read_text())
    change(content)
    (folder / SCALE_FILE).write_text(json.dumps(content))
    with pytest.raises(EvaluationError):
        make_study(list(results.values()), load_protocol(folder))


def test_policy_that_always_succeeds_is_the_first_and_is_not_fitted(study):
    folder, protocol, results = study
    always = read_result(folder / "template")
    found = make_study([*results.values(), always], protocol).tasks["pick"]
    assert [policy.name for policy in found.policies] == ["mine", "strong", "middle", "weak"]
    assert found.policies[0].curve.half is None
    assert found.policies[0].auc is None
    assert sorted(found.fitted) == ["middle", "strong", "weak"]


def test_one_policy_is_too_few(study):
    _, protocol, results = study
    with pytest.raises(EvaluationError):
        make_study([results["middle"]], protocol)


def test_few_episodes_are_too_few(study):
    folder, protocol, results = study
    few = []
    for name in ("middle", "weak"):
        outcomes = [outcome for number, outcome in results[name].outcomes.items() if number < 15]
        few.append(write_part(folder / f"few_{name}", results[name], outcomes))
    with pytest.raises(EvaluationError, match="too few policies"):
        make_study(few, protocol)


def test_task_without_enough_policies_is_left_out(study):
    folder, protocol, results = study
    only_pick = []
    for name in ("middle", "weak"):
        outcomes = [outcome for outcome in results[name].outcomes.values() if outcome.task == "pick"]
        only_pick.append(write_part(folder / f"pick_{name}", results[name], outcomes))
    found = make_study([*only_pick, results["strong"]], protocol)
    assert list(found.tasks) == ["pick"]
    assert len(found.left_out["search"]) == 1


def test_result_of_another_protocol_is_refused(study):
    folder, protocol, results = study
    outcomes = list(results["weak"].outcomes.values())
    run = results["weak"].run.to_dict() | {"policy": make_policy("other"), "protocol_hash": "0" * 64}
    other = write(folder / "other", outcomes, **run)
    with pytest.raises(EvaluationError, match="result of another protocol"):
        make_study([results["middle"], other], protocol)


def test_two_results_of_the_same_policy_are_refused(study):
    folder, protocol, results = study
    shutil.copytree(results["weak"].folder, folder / "again")
    with pytest.raises(EvaluationError, match="two results of the same policy"):
        make_study([*results.values(), read_result(folder / "again")], protocol)


def test_results_of_the_same_policy_may_have_different_tasks(study):
    _, protocol, results = study
    parts = []
    for result in results.values():
        for task in ("pick", "search"):
            outcomes = {number: one for number, one in result.outcomes.items() if one.task == task}
            parts.append(replace(result, folder=result.folder / task, outcomes=outcomes))
    whole, joined = (make_study(list(found), protocol, fit=True) for found in (results.values(), parts))
    assert {name: task.policies for name, task in whole.tasks.items()} == {
        name: task.policies for name, task in joined.tasks.items()
    }


def test_episodes_that_are_not_in_the_protocol_are_refused(study):
    folder, protocol, results = study
    copy = shutil.copytree(results["weak"].folder, folder / "longer")
    path = copy / OUTCOMES
    line = json.loads(path.read_text().splitlines()[0]) | {"episode": len(protocol.episodes)}
    path.write_text(path.read_text() + json.dumps(line) + "\n")
    with pytest.raises(EvaluationError, match="violation"):
        make_study([results["middle"], read_result(copy)], protocol)


def test_results_with_violations_are_refused(study):
    _, protocol, results = study
    failed = next(one for one in results["weak"].outcomes.values() if not one.success)
    outcomes = results["weak"].outcomes | {failed.episode: replace(failed, success=True)}
    with pytest.raises(EvaluationError, match="violation"):
        make_study([results["middle"], replace(results["weak"], outcomes=outcomes)], protocol)


def test_results_without_stored_actions_are_placed(study, tmp_path):
    _, protocol, results = study
    without = [replace(result, folder=tmp_path / name, folders={}) for name, result in results.items()]
    assert list(make_study(without, protocol).tasks) == ["pick", "search"]
