"""`robocas eval audit` replays the stored actions of a result, and finds forged outcomes."""

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from counting_env import CountingEnv, CrashingEnv

from robocas_ms3.cli import leaderboard
from robocas_ms3.cli.eval_audit import Audit, audit
from robocas_ms3.cli.main import run as cli
from robocas_ms3.core.errors import EvaluationError, OutputExistsError
from robocas_ms3.evaluation.audit.obstacles import find_audit_obstacle, list_other_processors
from robocas_ms3.evaluation.audit.run import AuditSettings, run_audit
from robocas_ms3.evaluation.audit.sample import bound_differing_episodes, choose_episodes
from robocas_ms3.evaluation.leaderboard import entries
from robocas_ms3.evaluation.leaderboard.rows import read_leaderboard
from robocas_ms3.evaluation.policy import PolicySpec
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.report import videos
from robocas_ms3.evaluation.results.result_files import OUTCOMES, RUN, read_result
from robocas_ms3.evaluation.results.stored_episodes import hash_actions, write_actions, write_checkpoints
from robocas_ms3.evaluation.results.verify import find_violations
from robocas_ms3.evaluation.rollouts import session
from robocas_ms3.evaluation.rollouts.session import EvaluationSession
from robocas_ms3.evaluation.settings import EvaluationSettings

ENTRIES = Path(__file__).resolve().parents[3] / "leaderboard"

SMOKE = load_protocol("smoke")


class CountingPolicy:
    """Policy whose first action value is 1, 2, ... by number of the episode; a `CountingEnv` succeeds at a sum of 5."""

    spec = PolicySpec(rate_hz=5)

    def __init__(self):
        self._numbers = {}

    def reset(self, episodes):
        self._numbers.update({one.env: one.episode for one in episodes})

    def act(self, observations):
        actions = np.zeros((len(observations.envs), 7), np.float32)
        actions[:, 0] = [self._numbers[env] + 1 for env in observations.envs.tolist()]
        return actions


@pytest.fixture
def checkpoint_recording(monkeypatch):
    """Record checkpoints, which entries of the leaderboard need."""
    monkeypatch.setattr(CountingEnv, "records_checkpoints", True)


@pytest.fixture
def folder(made, tmp_path):
    """A result of four episodes with 5, 3, 2 and 2 steps."""
    out = tmp_path / "result"
    settings = EvaluationSettings(("pick", "select"), "mine", "smoke", out, envs=1, backend="processes")
    steps = [one.steps for one in EvaluationSession(CountingPolicy(), settings).run()]
    assert steps == [5, 3, 2, 2]
    return out


@pytest.fixture
def card(tmp_path):
    path = tmp_path / "card.md"
    path.write_text("# Model card: mine\n")
    return path


def replay(folder, out="audit", on_start=lambda plan: None, **settings):
    """Return the numbers of the replayed episodes and of those that differ."""
    settings = AuditSettings(jobs=0, **settings)
    audited = list(run_audit(read_result(folder), SMOKE, folder.parent / out, settings, on_start))
    return [one.episode for one in audited], [one.episode for one in audited if one.differences]


def forge(folder, number, actions=None, **values):
    """Change values of an outcome, and its stored actions together with their hash."""
    if actions is not None:
        actions = np.asarray(actions, np.float32)
        write_actions(folder, number, actions)
        values["actions_hash"] = hash_actions(actions)
    lines = [json.loads(line) for line in (folder / OUTCOMES).read_text().splitlines()]
    lines = [line | (values if line["episode"] == number else {}) for line in lines]
    (folder / OUTCOMES).write_text("".join(json.dumps(line) + "\n" for line in lines))


def test_a_true_result_has_no_differences_and_an_audit_is_continued(folder, made):
    assert replay(folder) == ([0, 1, 2, 3], [])
    seeds = [seed for env in made for seed in env.seeds]
    assert seeds[4:] == [one.seed for one in SMOKE.episodes[:4]]
    plans = []
    assert replay(folder, on_start=plans.append) == ([0, 1, 2, 3], [])
    assert plans[0].replayed_before == 4
    assert sum(len(env.seeds) for env in made) == 8  # nothing was replayed


def test_the_audit_of_a_result_that_has_changed_is_not_continued(folder):
    replay(folder)
    forge(folder, 2, measures=read_result(folder).outcomes[2].measures | {"path_length": 7.0})
    with pytest.raises(OutputExistsError):
        replay(folder)
    assert replay(folder, overwrite=True)[1] == [2]
    record = json.loads((folder / RUN).read_text())
    (folder / RUN).write_text(json.dumps(record | {"action_noise": [1.0, 1.0]}))
    with pytest.raises(OutputExistsError):
        replay(folder)


def failed(one):
    """Return the values of an outcome as if the target had fallen in the last step."""
    flags = {**one.flags, "success": None, "fail": one.steps}
    seconds = {**one.flag_seconds, "success": None, "fail": one.steps / 5}
    failed = {"success": False, "success_at_end": False, "flags": flags, "flag_seconds": seconds}
    return failed | {"failure_stage": "placed"}


def forge_longer_path(folder, one):
    forge(folder, one.episode, measures=one.measures | {"path_length": one.measures["path_length"] + 0.5})


def forge_impulse(folder, one):
    forge(folder, one.episode, measures=one.measures | {"contact_impulse": 1.0})


def forge_earlier_stage(folder, one):
    flags, seconds = one.flags | {"reached_any": 1}, one.flag_seconds | {"reached_any": 0.2}
    forge(folder, one.episode, flags=flags, flag_seconds=seconds)


def forge_failure(folder, one):
    forge(folder, one.episode, **failed(one))


def forge_smaller_actions(folder, one):
    actions = read_result(folder).read_actions(one.episode)
    forge(folder, one.episode, actions * 0.9)


def forge_exchanged_actions(folder, one):
    actions = read_result(folder).read_actions(one.episode).copy()
    actions[:, 0] = (3, 1, 1, 1, 1)
    forge(folder, one.episode, actions)


def forge_fewer_steps(folder, one):
    actions = read_result(folder).read_actions(one.episode)[:3]
    forge(folder, one.episode, actions, **failed(replace(one, steps=3)), steps=3, seconds=0.6)


def forge_more_steps(folder, one):
    actions = np.concatenate([read_result(folder).read_actions(one.episode), np.zeros((2, 7))])
    flags, seconds = {**one.flags, "success": 7}, {**one.flag_seconds, "success": 1.4}
    forge(folder, one.episode, actions, steps=7, seconds=1.4, flags=flags, flag_seconds=seconds)


def forge_success_at_end(folder, one):
    forge(folder, one.episode, success_at_end=False)


FORGERIES = [
    forge_longer_path,
    forge_impulse,
    forge_earlier_stage,
    forge_failure,
    forge_smaller_actions,
    forge_exchanged_actions,
    forge_fewer_steps,
    forge_more_steps,
    forge_success_at_end,
]


@pytest.mark.parametrize("forgery", FORGERIES)
def test_consistent_forgeries_are_found(folder, forgery):
    before = read_result(folder).outcomes[0]
    forgery(folder, before)
    assert read_result(folder).outcomes[0] != before
    assert find_violations(read_result(folder), SMOKE, is_complete=False) == []
    assert replay(folder) == ([0, 1, 2, 3], [0])


def test_the_outcome_of_another_episode_is_found(folder):
    first, second = read_result(folder).outcomes[0], read_result(folder).outcomes[1]
    moved = replace(second, episode=0, seed=first.seed)
    forge(folder, 0, read_result(folder).read_actions(1)[:, ::-1], **asdict(moved))
    assert find_violations(read_result(folder), SMOKE, is_complete=False) == []
    assert replay(folder)[1] == [0]


def test_a_sample_is_repeatable_and_leaves_out_episodes_with_errors(folder):
    result = read_result(folder)
    assert choose_episodes(result, 2, 5) == choose_episodes(result, 2, 5)
    assert {tuple(choose_episodes(result, 2, seed)) for seed in range(50)} > {(0, 1), (2, 3)}
    assert choose_episodes(result, 9, 5) == [0, 1, 2, 3]
    assert replay(folder, sample=2, seed=5)[0] == choose_episodes(result, 2, 5)
    drawn = replay(folder, "drawn", sample=2)
    assert replay(folder, "drawn", sample=2) == drawn  # an audit that is continued keeps its sample


def test_a_difference_of_an_earlier_audit_is_not_forgotten_by_another_sample(folder):
    forge_longer_path(folder, read_result(folder).outcomes[0])
    assert replay(folder)[1] == [0]
    seed = next(seed for seed in range(99) if choose_episodes(read_result(folder), 1, seed) == [2])
    assert replay(folder, sample=1, seed=seed) == ([0, 2], [0])


def test_episodes_with_errors_are_replayed_up_to_the_error(folder, tmp_path, capsys):
    lost = {"success": False, "success_at_end": False, "success_v0": False, "failure_stage": "error"}
    one = read_result(folder).outcomes[0]
    flags, seconds = {**one.flags, "success": None}, {**one.flag_seconds, "success": None}
    measures = one.measures | {"path_length": 3.0}
    actions = read_result(folder).read_actions(0)[:3]
    forge(
        folder,
        0,
        actions,
        **lost,
        error="lost",
        flags=flags,
        flag_seconds=seconds,
        steps=3,
        seconds=0.6,
        measures=measures,
    )
    assert find_violations(read_result(folder), SMOKE, is_complete=False) == []
    assert replay(folder) == ([0, 1, 2, 3], [])
    forge(folder, 0, flags=flags | {"reached_any": 1}, flag_seconds=seconds | {"reached_any": 0.2})
    assert replay(folder, overwrite=True)[1] == [0]
    none = {"flags": dict.fromkeys(flags), "flag_seconds": dict.fromkeys(flags), "steps": 0, "seconds": 0.0}
    forge(folder, 0, np.zeros((0, 7)), **lost, error="the worker process crashed", **none)
    assert choose_episodes(read_result(folder), None, 0) == [1, 2, 3]
    assert audit(Audit(folder, out=tmp_path / "complete", jobs=0)) == 0
    printed = capsys.readouterr().out
    assert "1 episode failed before the first action" in printed
    assert "sample with seed" not in printed


@pytest.mark.usefixtures("checkpoint_recording")
def test_the_sample_of_an_entry_is_replayed(folder, card, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(entries, "SAMPLE_SIZE", 3)
    entry, out = tmp_path / "entry", tmp_path / "entry" / "smoke"
    assert leaderboard.add(leaderboard.Add((folder,), card=card, out=out)) == 0
    assert leaderboard.audit(leaderboard.AuditEntries((entry,), jobs=0)) == 0
    sample = entries.list_stored_episodes(read_result(out), SMOKE)
    (other,) = {0, 1, 2, 3} - set(sample)
    path = read_result(out).outcomes[sample[0]].measures | {"path_length": 7.0}
    forge(out, sample[0], measures=path)
    assert leaderboard.audit(leaderboard.AuditEntries((out,), jobs=0)) == 1
    assert f"episode {sample[0]}, recorded -> replayed: measures.path_length" in capsys.readouterr().out
    forge(out, other, actions_hash="")
    assert leaderboard.audit(leaderboard.AuditEntries((out,), jobs=0)) == 1
    assert f"episode {other}: actions_hash is empty" in capsys.readouterr().out
    lines = (out / OUTCOMES).read_text().splitlines(keepends=True)
    (out / OUTCOMES).write_text("".join(lines[1:]))
    assert leaderboard.audit(leaderboard.AuditEntries((out,), jobs=0)) == 1
    assert "1 episode of its tasks and splits missing" in capsys.readouterr().out


@pytest.mark.usefixtures("checkpoint_recording")
def test_the_leaderboard_has_only_audited_results(folder, card, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("ROBOCAS_CACHE", str(tmp_path / "cache"))
    entry, out = tmp_path / "entries" / "mine" / "smoke", tmp_path / "page"
    assert leaderboard.add(leaderboard.Add((folder,), card=card, out=entry)) == 0
    build = leaderboard.Build(tmp_path / "entries", out, jobs=0)
    assert leaderboard.build(build) == 0
    rows = [row for row in read_leaderboard(out / "results.json").rows if not row.published]
    assert {(row.task, row.n, row.audited) for row in rows} == {("pick", 2, 2), ("select", 2, 2)}
    with monkeypatch.context() as patch:  # the replays are remembered
        patch.setattr(session, "make_vec", lambda *args, **kwargs: pytest.fail("an episode was replayed again"))
        assert leaderboard.build(build) == 0
    before = (out / "results.json").read_bytes()
    forge(entry, 1, measures=read_result(entry).outcomes[1].measures | {"path_length": 7.0})
    capsys.readouterr()
    assert leaderboard.build(build) == 1
    printed = capsys.readouterr().out
    assert "episode 1, recorded -> replayed: measures.path_length" in printed and "nothing was written" in printed
    assert (out / "results.json").read_bytes() == before
    assert leaderboard.build(replace(build, skip_errors=True)) == 1
    assert (out / "results.json").read_bytes() == before  # no result is left
    leaderboard.add(leaderboard.Add((folder,), card=card, out=tmp_path / "entries" / "other" / "smoke"))
    assert leaderboard.build(replace(build, skip_errors=True)) == 0
    rows = read_leaderboard(out / "results.json").rows
    assert {row.entry for row in rows if not row.published} == {"other"}
    assert "mine/smoke" in (out / "index.html").read_text() and "mine/smoke" in (out / "results.md").read_text()


@pytest.mark.usefixtures("checkpoint_recording")
def test_a_result_may_be_in_the_leaderboard_once(folder, card, tmp_path, monkeypatch):
    monkeypatch.setenv("ROBOCAS_CACHE", str(tmp_path / "cache"))
    record = json.loads((folder / RUN).read_text())
    (folder / RUN).write_text(json.dumps(record | {"policy": record["policy"] | {"weights": "ab" * 32}}))
    for name in ("mine", "again"):
        leaderboard.add(leaderboard.Add((folder,), card=card, out=tmp_path / "entries" / name / "smoke"))
    with pytest.raises(EvaluationError, match="two results of the same policy"):
        leaderboard.build(leaderboard.Build(tmp_path / "entries", tmp_path / "page", jobs=0))
    assert not (tmp_path / "page").exists()


@pytest.mark.usefixtures("checkpoint_recording")
def test_a_result_whose_replay_crashes_is_skipped(folder, card, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("ROBOCAS_CACHE", str(tmp_path / "cache"))
    for name in ("mine", "other"):
        leaderboard.add(leaderboard.Add((folder,), card=card, out=tmp_path / "entries" / name / "smoke"))
    replay_result = leaderboard.replay_result

    def crash(result, *args, **kwargs):
        if result.folder.parent.name == "mine":
            raise EvaluationError("an episode could not be replayed", where=result.folder)
        return replay_result(result, *args, **kwargs)

    monkeypatch.setattr(leaderboard, "replay_result", crash)
    build = leaderboard.Build(tmp_path / "entries", tmp_path / "page", skip_errors=True, jobs=0)
    assert leaderboard.build(build) == 0
    assert "mine/smoke" in (tmp_path / "page" / "results.md").read_text()
    assert "could not be replayed" in capsys.readouterr().out


@pytest.mark.usefixtures("checkpoint_recording")
def test_an_unreadable_result_does_not_hide_the_problems_of_others(folder, card, tmp_path, capsys):
    for name in ("first", "second"):
        leaderboard.add(leaderboard.Add((folder,), card=card, out=tmp_path / "entries" / name / "smoke"))
    first, second = (tmp_path / "entries" / name / "smoke" for name in ("first", "second"))
    (first / RUN).write_text("{")
    forge(second, 1, success_at_end=False)
    assert leaderboard.audit(leaderboard.AuditEntries((tmp_path / "entries",), jobs=0)) == 1
    printed = capsys.readouterr().out
    assert f"{first}: " in printed and f"{second}: episode 1" in printed and "2 with problems" in printed


@pytest.mark.usefixtures("checkpoint_recording")
def test_a_video_whose_outcome_differs_is_dropped(folder, card, tmp_path, monkeypatch):
    def record(result, protocol, policy, numbers, out):
        out.mkdir(parents=True)
        for number in numbers:
            path = out / videos.video_file_name(number)
            path.touch()
            yield path, number == 1

    monkeypatch.setenv("ROBOCAS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(videos, "choose_episodes", lambda result, count: [0, 1])
    monkeypatch.setattr(videos, "record_videos", record)
    leaderboard.add(leaderboard.Add((folder,), card=card, out=tmp_path / "entries" / "mine" / "smoke"))
    assert leaderboard.build(leaderboard.Build(tmp_path / "entries", tmp_path / "page", videos=2, jobs=0)) == 0
    page = (tmp_path / "page" / "index.html").read_text()
    assert "episode_00001.mp4" in page
    assert "episode_00000.mp4" not in page


def test_an_entry_without_results_is_an_error(tmp_path):
    with pytest.raises(EvaluationError):
        leaderboard.audit(leaderboard.AuditEntries((tmp_path,)))


def test_a_crash_of_a_worker_is_no_difference(folder, monkeypatch):
    envs = [CrashingEnv(1, SMOKE.episodes[1].seed, [2])] * 3
    monkeypatch.setattr(session, "make_vec", lambda *args, **kwargs: envs.pop())
    with pytest.raises(EvaluationError, match="could not be replayed"):
        replay(folder)


def test_bound_of_a_sample():
    # two of four: one differing episode is not seen in 3 of 6 samples, two in 1 of 6, three in none
    assert bound_differing_episodes(2, 4) == 2
    assert bound_differing_episodes(4, 4) == 0
    # 19 of 20 find one differing episode in 95 % of the samples, which does not exceed 95 %
    assert bound_differing_episodes(50, 200) == 10


def test_results_of_other_physics_or_versions_cannot_be_audited(folder, tmp_path):
    assert find_audit_obstacle(read_result(folder)) == ""
    record = json.loads((folder / RUN).read_text())
    versions = {name: version.partition("+")[0] for name, version in record["versions"].items()}
    for others in ({"torch": f"{versions['torch']}+cu999"}, {"robocas_ms3": "99"}):
        (folder / RUN).write_text(json.dumps(record | {"versions": versions | others}))
        assert find_audit_obstacle(read_result(folder)) == ""
    for changes, word in (({"backend": "gpu"}, "gpu"), ({"versions": {"sapien": "2.0"}}, "sapien 2.0")):
        (folder / RUN).write_text(json.dumps(record | changes))
        assert word in find_audit_obstacle(read_result(folder))
        assert audit(Audit(folder, out=tmp_path / "audit")) == 1
    assert not (tmp_path / "audit").exists()


def test_processors_of_other_models_are_listed(folder):
    result = read_result(folder)
    assert list_other_processors(result) == []
    for machine, models in (({"model": "Other"}, ["Other"]), (None, []), ({"processor": "x86_64"}, [])):
        run = result.run.model_copy(update={"machine": machine})
        assert list_other_processors(replace(result, run=run)) == models


@pytest.fixture(scope="module")
def picked(short, tmp_path_factory):
    """A result of two episodes of pick and two of search with physics, 20 steps (4 s) each."""
    out = tmp_path_factory.mktemp("audit") / "result"
    words = ["eval", "pick", "search", "--policy", "random", "--protocol", str(short), "--backend", "processes"]
    assert cli([*words, "--out", str(out)]) == 0
    return out


def test_an_evaluation_can_be_audited(picked, short, tmp_path, capsys):
    out = tmp_path / "result"
    shutil.copytree(picked, out)
    command = ["eval", "audit", str(out), "--protocol", str(short), "--out", str(tmp_path / "audit")]
    assert cli(command) == 0
    assert "4 of 4 episodes replayed" in capsys.readouterr().out
    one = read_result(out).outcomes[0]
    forge(out, 0, measures=one.measures | {"path_length": one.measures["path_length"] * 1.2})
    assert cli([*command, "--overwrite"]) == 1
    assert "path_length" in capsys.readouterr().out
    forge(out, 0, measures=one.measures)
    checkpoints = read_result(out).read_checkpoints(0)
    assert checkpoints.steps.tolist() == [5, 10, 15, 20] and checkpoints.states.shape[1] > 100
    checkpoints.states[0, 13] += 1e-6  # x of the second body
    write_checkpoints(out, 0, checkpoints)
    assert cli([*command, "--overwrite"]) == 1
    assert "episode 0, recorded -> replayed: checkpoints: " in capsys.readouterr().out


def test_episodes_of_another_processor_are_replayed_from_checkpoint_to_checkpoint(picked, short, tmp_path, capsys):
    out = tmp_path / "result"
    shutil.copytree(picked, out)
    record = json.loads((out / RUN).read_text())
    (out / RUN).write_text(json.dumps(record | {"machine": {"model": "Other"}}))
    protocol, true = load_protocol(str(short)), read_result(picked)

    def audit_again(number):
        audited = run_audit(read_result(out), protocol, tmp_path / "audit", AuditSettings(2, 3, jobs=0, overwrite=True))
        return next((one.mode, one.differences) for one in audited if one.episode == number)

    number = choose_episodes(true, 2, 3)[0]
    assert audit_again(number) == ("exact", [])
    for shift, expected in ((1e-6, False), (0.004, False), (0.02, False), (0.8, True)):
        checkpoints = true.read_checkpoints(number)
        checkpoints.states[2, 13] += shift  # x of the second body, m
        write_checkpoints(out, number, checkpoints)
        mode, differences = audit_again(number)
        assert (mode, bool(differences)) == ("checkpoints", expected), differences
    checkpoints = true.read_checkpoints(number)
    checkpoints.states[3, : 13 * 11 : 13] += 0.14  # x of eleven bodies, m
    write_checkpoints(out, number, checkpoints)
    mode, differences = audit_again(number)
    assert mode == "checkpoints" and "moved 1." in " ".join(differences)
    write_checkpoints(out, number, true.read_checkpoints(number))
    one = true.outcomes[number]
    for factor, expected in ((1.01, False), (1.2, True)):
        forge(out, number, measures=one.measures | {"path_length": one.measures["path_length"] * factor})
        mode, differences = audit_again(number)
        assert (mode, bool(differences)) == ("checkpoints", expected), differences
    command = ["eval", "audit", str(out), "--protocol", str(short), "--out", str(tmp_path / "again")]
    assert cli(command) == 1
    printed = capsys.readouterr().out
    assert "another model of processor" in printed and "path_length" in printed
    shutil.rmtree(out / "checkpoints")
    mode, differences = audit_again(number)
    assert mode == "exact" and differences


def test_a_stage_that_a_checkpoint_lacks_counts_from_when_it_is_reached_again(tmp_path):
    true = read_result(ENTRIES / "keyframe" / "clutter-scale-v1")
    protocol, out = load_protocol(true.run.protocol), tmp_path / "result"
    shutil.copytree(true.folder, out)
    (out / RUN).write_text(json.dumps(true.run.to_dict() | {"machine": {"model": "Other"}}))
    stored = entries.list_stored_episodes(true, protocol)
    lifts = {number: true.outcomes[number].flags["target_lifted"] or 10**6 for number in stored}
    number = next(n for n in stored if (true.read_checkpoints(n).steps > lifts[n]).sum() >= 4)  # held for 3 s at least
    steps, lifted = true.read_checkpoints(number).steps, lifts[number]
    first = int((steps < lifted).sum())
    for row, is_late in ((first, False), (first + 2, True)):  # the checkpoint after which the stage is reached
        checkpoints = true.read_checkpoints(number)
        stages = (checkpoints.states == (steps >= lifted)[:, None]).all(axis=0)
        checkpoints.states[: row + 1, stages] = 0
        checkpoints.states[row, 13] += 0.02  # x of the second body, m
        write_checkpoints(out, number, checkpoints)
        audit = tmp_path / f"audit_{row}"
        (one,) = run_audit(read_result(out), protocol, audit, AuditSettings(stored_episodes={number}, jobs=0))
        assert one.mode == "checkpoints"
        assert any("flags.target_lifted" in text for text in one.differences) == is_late, one.differences
