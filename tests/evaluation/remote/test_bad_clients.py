"""Invalid requests to a policy server: clients select no paths, and get errors of one line."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("websockets")
pytest.importorskip("msgpack")

from remote_ends import RecordingPolicy, make_episode, make_observations, serving
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.policy import PolicySpec
from robocas_ms3.evaluation.remote.messages import make_observation_message, message_file_name
from robocas_ms3.evaluation.remote.server import PolicyServer, ServedFiles
from robocas_ms3.evaluation.remote.wire import encode_message
from robocas_ms3.robots.registry import find_robot
from robocas_ms3.scenes.task_specs import TASKS

GARBAGE, TOO_LARGE = 1008, 1009


class Failing(RecordingPolicy):
    """Policy that raises an error with several lines and a control character."""

    def __init__(self, error: BaseException) -> None:
        super().__init__()
        self.error = error

    def act(self, observations):
        raise self.error


class Reading(RecordingPolicy):
    """Policy that reads the files, the task and the robot of an episode."""

    def reset(self, episodes):
        super().reset(episodes)
        for episode in episodes:
            for name in ("config_file", "layouts_file", "pack"):
                if not getattr(episode, name):
                    raise EvaluationError("no such file or pack", where=f"start.{name}")
            TASKS.find(episode.task, where="start.task")
            find_robot(episode.robot, where="start.robot")


def message(env=0, start=None, **more):
    made = make_observation_message(make_observations(env), 0, make_episode(env), reset=True)
    return made | {"start": made["start"] | (start or {})} | more


def ask(url, request):
    """Return the answer to a first message and the close code; None: closed without an answer."""
    with connect(url, proxy=None, compression=None) as client:
        client.recv()
        try:
            client.send(encode_message(request))
            answer = client.recv(20)
        except ConnectionClosed:
            return None, client.close_code
        if isinstance(answer, bytes):
            return answer, 0
        with pytest.raises(ConnectionClosed):
            client.recv(20)
        return answer, client.close_code


@pytest.mark.parametrize("name", ["config_file", "layouts_file", "pack"])
def test_texts_of_clients_are_not_used_as_paths(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "secret.yaml").write_text("hunter2: [")
    (tmp_path / "new").mkdir()  # a folder in the working directory is no installed pack
    policy = Reading()
    with serving(policy) as url:
        for path in (f"{tmp_path}/secret.yaml", f"smoke/configs/../../{tmp_path}/secret.yaml", "new", "a\0b"):
            answer, _ = ask(url, message(start={name: path}))
            assert getattr(policy.episodes[-1], name) == ""
            assert isinstance(answer, str) and len(answer.splitlines()) == 1
            assert "hunter2" not in answer
    assert {entry.name for entry in tmp_path.iterdir()} == {"secret.yaml", "new"}


def test_files_of_bundled_and_passed_protocols_are_served(tmp_path):
    theirs = replace(
        make_episode(), config_file="mine/configs/a.yaml", layouts_file="mine/layouts/a.npy", pack="packs/own"
    )
    for name in (theirs.config_file, theirs.layouts_file):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).touch()
    ours = ServedFiles.collect([tmp_path / "mine"], ["packs/own"]).resolve_episode(theirs)
    assert Path(ours.config_file) == tmp_path / theirs.config_file
    assert Path(ours.layouts_file) == tmp_path / theirs.layouts_file
    assert ours.pack == "packs/own"
    assert ServedFiles.collect().resolve_episode(theirs) == replace(theirs, config_file="", layouts_file="", pack="")
    assert message_file_name(make_episode().config_file) == "smoke/configs/pick_table_scattered.yaml"
    (tmp_path / "smoke").mkdir()
    with pytest.raises(EvaluationError):
        ServedFiles.collect([tmp_path / "smoke"])
    like_a_shipped_one = str(tmp_path / "smoke/configs/pick_table_scattered.yaml")
    assert message_file_name(like_a_shipped_one) == like_a_shipped_one


@pytest.mark.parametrize("name", ["task", "robot"])
def test_unknown_task_or_robot_is_one_line_in_the_log(caplog, name):
    with serving(Reading()) as url, caplog.at_level(logging.WARNING):
        answer, code = ask(url, message(start={name: "nothing"}))
    assert isinstance(answer, str) and answer.startswith(f"start.{name}:") and code
    assert [record.exc_info for record in caplog.records if record.name.startswith("robocas_ms3")] == [None]


@pytest.mark.parametrize("error", [ValueError("a\nb\x1b[31m" + "c" * 9999), SystemExit(0), RecursionError()])
def test_policy_error_is_one_line_for_the_client_and_other_clients_are_served(error):
    with serving(Failing(error)) as url:
        answer, code = ask(url, message())
        assert isinstance(answer, str) and len(answer) < 1000
        assert answer.isprintable() and code
        assert isinstance(ask(url, message())[0], str)


def test_policies_that_observe_the_simulation_state_are_not_served():
    policy = RecordingPolicy(PolicySpec(simulation_state=True))
    with pytest.raises(EvaluationError, match="cannot run behind a policy server"):
        PolicyServer(policy)


def test_message_limit_depends_on_the_images_of_the_policy():
    with serving(RecordingPolicy()) as url:
        assert ask(url, message(**{"observation/more": np.zeros(16 * 2**20, np.uint8)})) == (None, TOO_LARGE)


@pytest.mark.parametrize(
    "request_",
    [
        7,
        *({"batch": batch} for batch in (7, [], {}, [7])),
        {"batch": [message(), message()]},
        {"batch": [message(env) for env in range(5)]},
        {"batch": [message(), message(1, env_id="1")]},
        {"batch": [message(), message(1, **{"observation/qpos": np.zeros(3, np.float32)})]},
        {"batch": [message(), message(1, reset=False)]},
        {"batch": [message(), message(1, reset=1)]},
        {"batch": [{"batch": [message()]}]},
        *(message(start=start) for start in ({"seed": -1}, {"seed": 2**62}, {"episode": -1}, {"seed": True})),
        *(message(start=start) for start in ({"env": 0}, {"task": 5}, {"instruction": "x" * 100_000})),
        message(prompt="x" * 100_000),
    ],
    ids=range(20),
)
def test_invalid_request_is_one_line_for_the_client(request_):
    policy = RecordingPolicy()
    with serving(policy, max_batch=4) as url:
        answer, code = ask(url, request_)
    assert isinstance(answer, str) and answer.isprintable()
    assert (code, policy.seen, policy.episodes) == (GARBAGE, [], [])


def test_embeddings_of_a_batch_must_have_equal_length():
    policy = RecordingPolicy(PolicySpec(language="embedding"))
    batch = [message(env, **{"observation/embedding": np.zeros(384 - env, np.float32)}) for env in range(2)]
    with serving(policy) as url:
        assert ask(url, {"batch": batch})[1] == GARBAGE
    assert policy.seen == []
