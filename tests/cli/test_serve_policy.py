import os
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from robocas_ms3.cli.main import run

pytest.importorskip("websockets")
pytest.importorskip("msgpack")

ROOT = Path(__file__).resolve().parents[2]
POLICY = """
from robocas_ms3.evaluation.policy import PolicySpec

class Up:
    spec = PolicySpec(convention="delta_quaternion", rate_hz=10)
    def reset(self, episodes): ...
    def act(self, observations): return np.ones((len(observations.envs), 8))
    def close(self): print("closed")
"""


@contextmanager
def serving(policy, folder, *options):
    """Start the command; yield its process and the address that it prints."""
    words = [sys.executable, ROOT / "robocas_cli.py", "serve-policy", policy, "--port", "0", *options]
    where = {"PYTHONPATH": f"{folder}{os.pathsep}{os.environ.get('PYTHONPATH', ROOT)}"}
    served = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | where)
    try:
        assert served.stdout is not None
        line = served.stdout.readline()
        assert line.startswith(f"serving {policy} at ws://127.0.0.1:")
        yield served, line.split()[-1]
    finally:
        served.kill()
        served.communicate()


def test_own_policy_is_served_until_ctrl_c(tmp_path):
    from robocas_ms3.evaluation.policy import policy_spec_to_dict
    from robocas_ms3.evaluation.remote.client import RemotePolicy

    (tmp_path / "mine.py").write_text(POLICY)
    with serving("mine:Up", tmp_path) as (served, url):
        remote = RemotePolicy(url)
        assert policy_spec_to_dict(remote.spec)["convention"] == "delta_quaternion"
        remote.close()
        served.send_signal(signal.SIGINT)
        out, err = served.communicate(timeout=20)
        assert (out, err.strip(), served.returncode) == ("closed\n", "interrupted", 130)


SLOW = """
import time
from robocas_ms3.evaluation.policy import PolicySpec

class Slow:
    spec = PolicySpec()
    def reset(self, episodes): ...
    def act(self, observations):
        print("acts", flush=True)
        time.sleep(300)
    def close(self): print("closed")
"""


def test_ctrl_c_ends_a_busy_policy(tmp_path):
    from websockets.sync.client import connect

    from robocas_ms3.evaluation.remote.wire import encode_message

    (tmp_path / "mine.py").write_text(SLOW)
    with serving("mine:Slow", tmp_path) as (served, url), connect(url, proxy=None) as client:
        client.send(encode_message(observation()))
        assert served.stdout.readline() == "acts\n"
        served.send_signal(signal.SIGINT)
        out, err = served.communicate(timeout=60)
        assert (out, err.strip(), served.returncode) == ("closed\n", "interrupted", 130)


def observation():
    sizes = {"qpos": 12, "tcp_in_base": 7, "gripper_width": 1}
    return {f"observation/{name}": np.zeros(size, np.float32) for name, size in sizes.items()}


def test_batch_size_is_sent_to_clients(tmp_path):
    from websockets.sync.client import connect

    from robocas_ms3.evaluation.remote.wire import decode_message

    with serving("noop", tmp_path, "--max-batch", "3") as (_, url), connect(url, proxy=None) as client:
        assert decode_message(client.recv())["robocas_max_batch"] == 3


@pytest.mark.parametrize(("option", "value"), [("--port", "99999"), ("--max-batch", "0"), ("--max-batch", "257")])
def test_option_out_of_range(capsys, option, value):
    assert run(["serve-policy", "noop", option, value]) == 2
    assert capsys.readouterr().err.startswith(f"error: {option}: ")
