"""Our client and our server, and openpi's client and a server as openpi writes one."""

import multiprocessing
import socket
from dataclasses import fields, replace

import numpy as np
import pytest

pytest.importorskip("websockets")
pytest.importorskip("msgpack")

from remote_ends import CAMERA, Told, a_start, serving, some_observations, talking

from robocas_ms3.core.errors import EvaluationError, PolicyFailed
from robocas_ms3.evaluation.policies import make_policy
from robocas_ms3.evaluation.policy import PolicySpec
from robocas_ms3.evaluation.remote.answers import ServedFiles, read_episode_spec
from robocas_ms3.evaluation.remote.client import RemotePolicy
from robocas_ms3.evaluation.remote.messages import observation_message
from robocas_ms3.evaluation.remote.wire import pack, unpack

ALL = PolicySpec(cameras={"base_camera": CAMERA}, depth=True, state=True, rate_hz=10, reference="tcp")


def test_a_served_policy_observes_and_answers_the_same():
    policy = Told(ALL)
    with serving(policy) as url:
        remote = make_policy(url)
        assert remote.spec == ALL
        assert remote.describe()["server"]["class"].endswith(":Told")
        remote.reset([a_start()])
        seen = some_observations(0, cameras=True)
        np.testing.assert_array_equal(remote.act(seen), Told().act(seen))
        remote.close()
    assert policy.starts == [a_start()]
    for field in fields(seen):
        sent, got = getattr(seen, field.name), getattr(policy.seen[0], field.name)
        for one, other in zip(*(x.values() if isinstance(x, dict) else [x] for x in (sent, got)), strict=True):
            np.testing.assert_array_equal(one, other)
            assert getattr(one, "dtype", None) == getattr(other, "dtype", None)


def test_who_is_asked_more_often_than_it_would_looks_more_often():
    with serving(Told(PolicySpec(look_every=3))) as url:
        for address, looks in ((url, 3), (f"{url}?play=2", 1)):
            remote = RemotePolicy(address)
            assert remote.spec.look_every == looks
            remote.close()


def test_two_clients_have_envs_of_their_own():
    policy = Told()
    with serving(policy) as url:
        for _ in range(2):
            remote = RemotePolicy(url)
            remote.reset([a_start(0)])
            remote.act(some_observations(0))
    assert [start.env for start in policy.starts] == [0, 1]


def test_a_forked_process_asks_over_a_connection_of_its_own():
    with serving(Told()) as url:
        remote = RemotePolicy(url)  # starts the event loop of this process
        child = multiprocessing.get_context("fork").Process(target=ask_once, args=(url,))
        child.start()
        child.join(30)
        child.kill()
        child.join()
        assert child.exitcode == 0
        remote.reset([a_start(0)])
        assert remote.act(some_observations(0)).shape == (1, 3, 7)
        remote.close()


def ask_once(url):
    remote = RemotePolicy(url)
    remote.reset([a_start(0)])
    assert remote.act(some_observations(0)).shape == (1, 3, 7)
    remote.close()


def test_a_web_page_may_not_ask():
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    with serving(Told()) as url, pytest.raises(InvalidStatus):
        connect(url, origin="http://example.org", proxy=None).recv()


@pytest.mark.parametrize("host", ["::1", "[::1]"])
def test_an_ipv6_address_is_in_brackets(host):
    try:
        with socket.create_server(("::1", 0), family=socket.AF_INET6):
            pass
    except OSError:
        pytest.skip("no IPv6 here")
    with serving(Told(), host=host) as url:
        assert url.startswith("ws://[::1]:")
        remote = RemotePolicy(url)
        remote.reset([a_start()])
        assert remote.act(some_observations(0)).shape == (1, 3, 7)
        remote.close()


def test_a_port_that_is_taken():
    from robocas_ms3.evaluation.remote.server import PolicyServer

    with serving(Told()) as url, pytest.raises(EvaluationError, match="can't listen"):
        PolicyServer(Told(), port=int(url.rpartition(":")[2])).run()


def test_a_start_names_the_robot_where_it_is_another():
    """A server may be older than robots are several."""
    for robot, keys in (("robocas_mobile_panda", set()), ("twin", {"robot"})):
        start = replace(a_start(), robot=robot)
        message = observation_message(some_observations(0), 0, start, reset=True)
        assert message["start"].keys() & {"robot"} == keys
        assert ServedFiles.of().resolved(read_episode_spec(message, 0)) == start


def test_openpis_client_asks_our_server():
    openpi = pytest.importorskip("openpi_client.websocket_client_policy")
    policy = Told()
    with serving(policy) as url:
        client = openpi.WebsocketClientPolicy(host=url)
        assert client.get_server_metadata()["robocas_wants"]["convention"] == "robocas"
        message = observation_message(some_observations(0), 0, None, reset=False)
        for key in ("env_id", "reset"):
            del message[key]
        for _ in range(2):
            assert client.infer(message)["actions"].shape == (3, 7)
        assert [start.instruction for start in policy.starts] == ["take the apple"]
        with pytest.raises(RuntimeError, match="not in the observation"):
            client.infer({"prompt": "take the apple"})


def openpi_server(replies, metadata, seen):
    """As openpi's own talks: packed by its packer, metadata first."""
    openpi = pytest.importorskip("openpi_client.msgpack_numpy")

    def talk(socket):
        socket.send(openpi.packb(metadata))
        for message in socket:
            seen.append(openpi.unpackb(message))
            socket.send(openpi.packb({"actions": replies, "server_timing": {"infer_ms": np.float64(1)}}))

    return talking(talk)


def test_our_client_asks_a_plain_openpi_server():
    seen = []
    with openpi_server(np.ones((10, 8), np.float32) / 10, {"reset_pose": np.zeros(3)}, seen) as url:
        options = "convention=joint_positions&cameras=base_camera:6x4&play=4&language=text"
        remote = RemotePolicy(f"{url}?{options}&rename=base_camera:observation/image,prompt:text")
        assert remote.spec == PolicySpec(convention="joint_positions", cameras={"base_camera": (6, 4)})
        remote.reset([a_start(1)])
        assert remote.act(some_observations(1, cameras=True)).shape == (1, 4, 8)
        remote.act(some_observations(1, cameras=True))
    assert [(one["env_id"], one["reset"]) for one in seen] == [(1, True), (1, False)]
    assert seen[0]["observation/image"].shape == (4, 6, 3)
    assert seen[0]["text"] == "take the apple"
    assert "start" not in seen[0]


def test_a_server_that_says_what_it_wants_is_not_told():
    with serving(Told()) as url, pytest.raises(EvaluationError, match="announces its policy specification"):
        RemotePolicy(f"{url}?convention=delta_euler")


def plain(socket):
    socket.send(pack({}))
    for message in socket:
        socket.send(pack({"actions": [[0.0] * 7] * (1 + unpack(message)["env_id"])}))


def test_lists_are_actions_too_and_chunks_are_of_one_length():
    with talking(plain) as url:
        remote = RemotePolicy(url)
        remote.reset([a_start(0), a_start(1)])
        with pytest.raises(PolicyFailed) as failed:
            remote.act(some_observations(0, 1))
        assert "differ in length" in failed.value.reasons[1]
        assert failed.value.actions.shape == (2, 1, 7)
