import pytest

pytest.importorskip("websockets")
pytest.importorskip("msgpack")

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.policies import make_policy
from robocas_ms3.evaluation.policy import PolicySpec
from robocas_ms3.evaluation.remote.address import Address, read_address


def test_an_address_alone():
    assert read_address("ws://127.0.0.1:8000") == Address("ws://127.0.0.1:8000")
    assert read_address("wss://[::1]/policy").url == "wss://[::1]/policy"


def test_options():
    text = "ws://host:1?cameras=base_camera:320x240,gripper_camera:64x64&depth=1&rate_hz=5&rename=qpos:state&play=5"
    text += "&max_in_flight=2&timeout_s=9"
    assert read_address(text) == Address(
        "ws://host:1",
        spec=PolicySpec(cameras={"base_camera": (320, 240), "gripper_camera": (64, 64)}, depth=True, rate_hz=5.0),
        rename={"qpos": "state"},
        play=5,
        max_in_flight=2,
        timeout_s=9.0,
    )


@pytest.mark.parametrize(
    "text",
    [
        "ws://",
        "ws://host:99999",
        "ws://host:0",
        "ws://[::1",
        "ws://[1]:2",
        "ws://host:1?play=" + "9" * 5000,
        "ws://host:1?cameras=base_camera:2x" + "9" * 5000,
        "ws://host:1?camera=base_camera:2x2",
        "ws://host:1?cameras=base_camera:2",
        "ws://host:1?cameras=base_camera",
        "ws://host:1?depth=maybe",
        "ws://host:1?play=0",
        "ws://host:1?max_in_flight=0",
        "ws://host:1?timeout_s=-1",
        "ws://host:1?rate_hz=nan",
        "ws://host:1?rename=",
    ],
)
def test_errors_come_before_any_connection(text):
    with pytest.raises(EvaluationError):
        make_policy(text)
