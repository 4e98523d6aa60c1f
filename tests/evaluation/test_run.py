"""Episodes of a real protocol: the same outcomes however they are played."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from counting import Dying

from robocas_ms3.cli.main import run as cli
from robocas_ms3.core.errors import DatasetError, EvaluationError, OutputExistsError, RobocasError, WorkerDied
from robocas_ms3.core.locks import locked_folder
from robocas_ms3.evaluation import results, session
from robocas_ms3.evaluation.policies import make_policy
from robocas_ms3.evaluation.policy import PolicySpec
from robocas_ms3.evaluation.protocol import load_protocol
from robocas_ms3.evaluation.session import EvaluationSession, evaluate
from robocas_ms3.evaluation.settings import EvaluationSettings, choose_episodes
from robocas_ms3.evaluation.verify import problems


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """The protocol smoke with a second an episode."""
    folder = tmp_path_factory.mktemp("protocols") / "short"
    shutil.copytree(load_protocol("smoke").folder, folder)
    rules = folder / "protocol.yaml"
    rules.write_text(rules.read_text().replace("max_steps: null", "max_steps: 20"))
    return folder


def play(folder, policy="random", *, protocol="smoke", **settings) -> dict[int, dict]:
    made = make_policy(policy)
    settings = EvaluationSettings(policy, backend="processes", **{"tasks": ("pick", "select"), **settings})
    list(evaluate(EvaluationSession(load_protocol(protocol), made, settings), folder))
    return {number: one.without_clock() for number, one in results.read(folder).outcomes.items()}


@pytest.fixture(scope="module")
def alone(short, tmp_path_factory):
    """What a random policy does, one env at a time."""
    return play(tmp_path_factory.mktemp("alone"), protocol=short, num_envs=1)


@pytest.mark.slow
def test_outcomes_do_not_depend_on_how_many_envs_there_are_or_on_shards(alone, short, tmp_path):
    assert sorted(alone) == [0, 1, 2, 3]
    assert not any(one["success"] for one in alone.values())
    assert len({one["measures"]["path_length"] for one in alone.values()}) == 4
    together = play(tmp_path / "two", protocol=short, num_envs=2, workers=1)
    parts = [play(tmp_path / str(n), protocol=short, tasks=("select",), shard=(n, 2)) for n in (0, 1)]
    assert together == alone
    assert {**parts[0], **parts[1]} == {number: alone[number] for number in (2, 3)}
    assert [sorted(part) for part in parts] == [[2], [3]]


@pytest.mark.slow
def test_a_run_that_was_cut_off_goes_on_and_ends_the_same(alone, short, tmp_path):
    settings = EvaluationSettings("random", 1, "processes", tasks=("pick", "select"))
    begun: list[int] = []
    opened = EvaluationSession(load_protocol(short), make_policy("random"), settings)
    playing = evaluate(opened, tmp_path, on_start=begun.append)
    next(playing)
    assert begun == [4]
    playing.close()
    path = tmp_path / "episodes.jsonl"
    path.write_text(path.read_text() + path.read_text()[:100])  # and killed while it wrote
    with pytest.raises(OutputExistsError, match="policy.name"):
        play(tmp_path, "still", protocol=short)
    assert play(tmp_path, protocol=short, num_envs=2) == alone


@pytest.mark.slow
@pytest.mark.parametrize("name", ["scripted", "scripted-motions"])
def test_the_demonstrator_succeeds_in_the_same_loop(name, tmp_path):
    outcomes = play(tmp_path, name, tasks=("pick",), episodes=1)
    assert outcomes[0]["success"] and outcomes[0]["success_at_end"] and outcomes[0]["success_v0"]
    flags = outcomes[0]["flags"]
    assert flags["reached_target"] <= flags["target_lifted"] <= flags["target_in_basket"] <= flags["success"]
    assert outcomes[0]["failure_stage"] == ""


@pytest.mark.slow
def test_the_policy_of_the_docs_sees_what_it_wants(short, tmp_path, monkeypatch, needs_renderer):
    page = (Path(__file__).resolve().parents[2] / "docs" / "evaluation.md").read_text(encoding="utf-8")
    program = page.split("```python\n")[1].split("```")[0]
    program = program.replace("rate_hz=5,", "rate_hz=5, depth=True, state=True, language='text',")
    program = program.replace(
        "        return np.tile",
        """\
        assert observations.depths["gripper_camera"].shape[1:] == (48, 64, 1)
        assert observations.state.shape[1] > 90 and observations.tcp_in_base.shape[1:] == (7,)
        assert all(said.startswith("grasp the ") for said in observations.instructions)
        return np.tile""",
    )
    (tmp_path / "docs_policy.py").write_text(program, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    outcomes = play(
        tmp_path / "out", "docs_policy:Descend", protocol=short, num_envs=2, workers=1, episodes=2, tasks=("select",)
    )
    assert len(outcomes) == 2
    assert all(one["measures"]["path_length"] == pytest.approx(0.2, abs=0.02) for one in outcomes.values())


def test_a_policy_that_does_not_fit_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(EvaluationError, match="paper-v1: the policy's convention.*found joint_positions"):
        play(tmp_path / "out", "scripted", protocol="paper-v1")
    assert not (tmp_path / "out").exists()
    rules = load_protocol("paper-v1").rules
    with pytest.raises(EvaluationError, match=r"another rate \(expected 5 Hz, found 10 Hz\)"):
        rules.check_policy(PolicySpec(reference="tcp", rate_hz=10))
    with pytest.raises(
        EvaluationError, match=r"no such task \(expected pick, select, search, open_pick, found nothing"
    ):
        play(tmp_path / "out", tasks=("nothing",))
    with pytest.raises(EvaluationError, match=r"no such split \(expected test, found seen"):
        play(tmp_path / "out", split="seen")
    with pytest.raises(EvaluationError, match="no episodes in this shard"):
        play(tmp_path / "out", tasks=("pick",), shard=(90, 100))


def test_who_wants_to_see_needs_a_renderer(tmp_path, monkeypatch):
    def none() -> None:
        raise DatasetError("no render device")

    monkeypatch.setattr(session, "require_renderer", none)
    policy = make_policy("random")
    policy.spec = PolicySpec(reference="tcp", cameras={"base_camera": (8, 8)})
    with pytest.raises(DatasetError, match="no render device"):
        EvaluationSession(load_protocol("smoke"), policy, EvaluationSettings(backend="processes"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("times", [1, 2])
def test_an_episode_that_ends_its_process_is_played_again_and_then_counts_as_failed(
    short, tmp_path, monkeypatch, caplog, times
):
    protocol, made, deaths = load_protocol(short), [], [times]

    def make_vec(env_id, count, **_):
        made.append(Dying(count, protocol.episodes[1].seed, deaths))
        return made[-1]

    monkeypatch.setattr(session, "make_vec", make_vec)
    found = play(tmp_path / "out", "still", protocol=short)
    assert sorted(found) == [0, 1, 2, 3]  # none is left out
    assert [number for number, one in found.items() if one["error"]] == ([1] if times == 2 else [])
    assert found[1]["error"] == ("its process died: SIGSEGV" if times == 2 else "")
    assert (found[1]["failure_stage"] == "error") == (times == 2)
    assert found[0]["steps"] == 20  # from its beginning, whatever befell the other
    assert [record.getMessage() for record in caplog.records] == [
        "episode 1: its process died: SIGSEGV; it is started again"
    ]
    assert all(env.closed for env in made)
    said = problems(results.read(tmp_path / "out"), protocol)
    assert not [one for one in said if one.startswith("episode 1:") and times == 2]
    play(tmp_path / "out", "still", protocol=short)  # it stays as it is
    assert results.read(tmp_path / "out").broken_off() == times - 1
    command = ["eval", "--policy", "still", "--protocol", short, "--backend", "processes", "--out", tmp_path / "out"]
    assert cli([str(word) for word in command]) == times - 1


def test_a_process_that_dies_at_no_episode_ends_the_run(short, tmp_path, monkeypatch):
    def make_vec(env_id, count, **_):
        raise WorkerDied("its process died", where="env 0", found="SIGSEGV")

    monkeypatch.setattr(session, "make_vec", make_vec)
    with pytest.raises(WorkerDied, match="env 0: its process died"):
        play(tmp_path / "out", "still", protocol=short)


def test_an_interrupted_run_says_how_it_goes_on(tmp_path, monkeypatch, capsys):
    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr(session, "evaluate", interrupted)
    assert cli(["eval", "--protocol", "smoke", "--policy", "still", "--out", str(tmp_path)]) == 130
    assert capsys.readouterr().err == "interrupted; the same command continues\n"


def test_what_a_policy_can_not_want():
    for wrong in ({"convention": "words"}, {"language": "loud"}, {"cameras": {"eye": (8, 8)}}, {"reference": "me"}):
        with pytest.raises(EvaluationError, match=f"{next(iter(wrong))}: a policy can't want that"):
            PolicySpec(**wrong)


def test_episodes_are_chosen_by_task_count_and_shard():
    smoke = load_protocol("smoke")
    assert [one.episode for one in choose_episodes(smoke, EvaluationSettings(tasks=("search", "pick")))] == [0, 1, 4, 5]
    assert [one.episode for one in choose_episodes(smoke, EvaluationSettings(episodes=1))] == [0, 2, 4, 6]
    assert [one.episode for one in choose_episodes(smoke, EvaluationSettings(shard=(1, 3)))] == [1, 4, 7]
    suite = load_protocol("objects-v1")
    new = choose_episodes(suite, EvaluationSettings(split="new", tasks=("pick",)))
    assert [one.episode for one in new] == [*range(50, 100)]


def test_policies_by_name():
    for name in ("nobody", "replay:", "no_such_module:Policy", "json:Nothing"):
        with pytest.raises(EvaluationError, match="no such policy"):
            make_policy(name)
    assert make_policy("robocas_ms3.evaluation.policies.plain:StillPolicy").spec.convention == "robocas"


def test_two_runs_into_one_folder_are_refused(tmp_path):
    with locked_folder(tmp_path / "out"), pytest.raises(RobocasError, match="out: another process is writing here"):
        play(tmp_path / "out", "still")
