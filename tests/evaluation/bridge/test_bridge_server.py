"""The server's side, over a real socket, with an environment of nothing but numbers."""

import json
import re
import socket
import threading

import numpy as np
import pytest

pytest.importorskip("websockets")
pytest.importorskip("msgpack")

from bridge_ends import Counting, theirs

from robocas_ms3.errors import EvaluationError, WireError
from robocas_ms3.evaluation.bridge import server
from robocas_ms3.evaluation.bridge.channel import Channel
from robocas_ms3.evaluation.remote.wire import pack, unpack

ASKED = {
    "version": 1,
    "protocol": "smoke",
    "task": "search",
    "num_envs": 2,
    "convention": "robocas",
    "reference": "tcp",
    "rate_hz": 5,
    "cameras": {"base_camera": [6, 4]},
    "backend": "processes",
}


@pytest.fixture
def end(monkeypatch):
    """A channel to a server that has not been asked for anything yet; what it raises is in ``end.raised``."""
    monkeypatch.setattr(server, "require_renderer", lambda: "none")
    monkeypatch.setattr(server, "make_env", lambda protocol, wants, episode, count, **_: Counting(count))
    ours, other = socket.socketpair()
    channel, raised = Channel(ours), []

    def serve():
        try:
            bridge = server.open_bridge(Channel(other))
            Channel(other).send({"ready": bridge.ready()})
            bridge.run()
        except (EOFError, EvaluationError) as error:
            raised.append(error)
        other.close()

    thread = threading.Thread(target=serve)
    thread.start()
    channel.raised = raised
    yield channel
    ours.close()
    thread.join(10)
    assert not thread.is_alive()


def act(end: Channel, *first: float) -> dict:
    actions = np.zeros((2, 7), np.float32)
    actions[:, 0] = first
    end.send({"act": actions})
    return end.receive()


def ask(end: Channel, **changed) -> dict:
    end.send({**ASKED, **changed})
    return end.receive()["ready"]


@pytest.mark.parametrize(
    ("asked", "tasks"),
    [
        ({"tasks_of": "smoke"}, ["pick", "select", "search", "open_pick"]),
        ({"tasks_of": "objects-v1", "split": "new"}, ["pick", "search"]),
    ],
)
def test_it_says_which_tasks_there_are(end, asked, tasks):
    end.send({"version": 1, **asked})
    assert end.receive()["ready"] == {"tasks": tasks}
    end.send({"play": [0]})
    with pytest.raises(EOFError):
        end.receive()
    assert "nothing is played here" in str(end.raised[0])


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"tasks_of": "smoky"}, "no such protocol"),
        ({"tasks_of": "smoke", "split": "new"}, "no such split"),
        ({"tasks_of": "smoke", "task": "pick"}, "can't play that.*task"),
    ],
)
def test_it_says_why_there_are_none(end, asked, said):
    end.send({"version": 1, **asked})
    with pytest.raises(EOFError):
        end.receive()
    assert len(end.raised) == 1
    assert re.search(said, str(end.raised[0]))


def test_a_batch_is_played_to_its_end(end, tmp_path):
    ready = ask(end, results=str(tmp_path / "result"), name="mine")
    assert (ready["episodes"], ready["max_steps"], ready["rate_hz"], ready["action_size"]) == (2, 600, 5, 7)
    end.send({"play": [1, 0]})
    first = end.receive()
    assert (first["envs"], first["episodes"], first["ended"]) == ([0, 1], [5, 4], [])
    assert ["tomato soup" in first["instructions"][0], "toothpaste" in first["instructions"][1]] == [True, True]
    assert first["numbers"]["agent_pos"].shape == (2, 18)
    assert first["images"]["base_camera"].shape == (2, 4, 6, 3)
    second = act(end, 1, 2)  # seeds end in 1 and 0: successes at 3 and 2
    assert (second["envs"], [one["env"] for one in second["ended"]]) == ([0, 1], [1])
    assert second["ended"][0] == {"env": 1, "success": True, "steps": 1, "error": ""}
    assert second["images"]["base_camera"][1, 0, 0, 0] == 2  # what it shows after its last action
    third = act(end, 2, 9)
    assert (third["envs"], [one["env"] for one in third["ended"]]) == ([0], [0])
    assert third["numbers"]["agent_pos"][0, 7] == 3
    end.send({"play": [0, 1]})  # again: the result keeps what was first
    assert end.receive()["episodes"] == [4, 5]
    lines = [json.loads(line) for line in (tmp_path / "result" / "episodes.jsonl").read_text().splitlines()]
    assert [(one["episode"], one["success"], one["steps"]) for one in lines] == [(4, True, 1), (5, True, 2)]
    assert json.loads((tmp_path / "result" / "run.json").read_text())["policy"]["name"] == "mine"


def test_a_batch_may_be_left_in_its_middle(end):
    ask(end)
    end.send({"play": [0, 1]})
    end.receive()
    act(end, 1, 1)
    end.send({"play": [1, 1]})
    again = end.receive()
    assert again["episodes"] == [5, 5]
    assert again["ended"] == []
    assert again["numbers"]["agent_pos"][:, 7].tolist() == [0, 0]


def test_an_action_that_is_no_number_ends_its_episode_alone(end):
    ask(end)
    end.send({"play": [0, 1]})
    end.receive()
    reply = act(end, np.nan, 1)
    assert [(one["env"], one["success"]) for one in reply["ended"]] == [(0, False)]
    assert "not finite" in reply["ended"][0]["error"]
    assert act(end, 0, 2)["ended"] == [{"env": 1, "success": True, "steps": 2, "error": ""}]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"version": 2}, "another version"),
        ({"task": "juggle"}, "no such task .*search"),
        ({"protocol": "smok"}, "no such protocol"),
        ({"protocol": "paper-v1", "rate_hz": 10}, "another rate"),
        ({"rate_hz": 3}, "no such rate"),
        ({"convention": "up"}, "convention"),
        ({"cameras": {}}, "cameras"),
        ({"cameras": {"nose": [6, 4]}}, "nose"),
        ({"cameras": {"base_camera": [0, 4]}}, "base_camera"),
        ({"num_envs": 0}, "num_envs"),
        ({"more": 1}, "more"),
    ],
)
def test_what_can_not_be_played_is_refused(end, changed, said):
    end.send({**ASKED, **changed})
    with pytest.raises(EOFError):
        end.receive()
    (error,) = end.raised
    assert "\n" not in str(error)
    with pytest.raises(EvaluationError, match=said):
        raise error


@pytest.mark.parametrize("numbers", [[0], [0, 2], [0, -1], [0, "1"], None, 3])
def test_a_batch_that_is_none(end, numbers):
    ask(end)
    end.send({"play": numbers})
    with pytest.raises(EOFError):
        end.receive()
    assert isinstance(end.raised[0], WireError)


@pytest.mark.parametrize("actions", [np.zeros((2, 6), np.float32), np.zeros((2, 7), np.int64), [[0.0] * 7] * 2, None])
def test_actions_that_are_none(end, actions):
    ask(end)
    end.send({"play": [0, 1]})
    end.receive()
    end.send({"act": actions})
    with pytest.raises(EOFError):
        end.receive()
    assert isinstance(end.raised[0], WireError)


def test_a_result_that_is_there_is_not_mixed_with_another(end, tmp_path):
    (tmp_path / "episodes.jsonl").write_text("")
    end.send({**ASKED, "results": str(tmp_path)})
    with pytest.raises(EOFError):
        end.receive()
    assert "Choose another folder" in str(end.raised[0])


def test_both_ends_write_arrays_alike():
    process = theirs("process")
    import msgpack

    message = {"act": np.arange(6, dtype=np.float32).reshape(2, 3), "play": [1, 2]}
    assert msgpack.packb(message, default=process._written) == pack(message)
    read = msgpack.unpackb(pack(message), object_hook=process._read, strict_map_key=False)
    np.testing.assert_array_equal(read["act"], unpack(pack(message))["act"])
    with pytest.raises(TypeError):
        process._written(object())
