import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("websockets")
pytest.importorskip("msgpack")

ROOT = Path(__file__).resolve().parents[2]
POLICY = """
from robocas_ms3.evaluation.policy import Wants

class Up:
    wants = Wants(convention="delta_quaternion", rate_hz=10)
    def reset(self, starts): ...
    def act(self, observations): return np.ones((len(observations.envs), 8))
    def close(self): print("closed")
"""


def test_a_policy_of_ones_own_is_served_until_ctrl_c(tmp_path):
    from robocas_ms3.evaluation.remote.client import RemotePolicy
    from robocas_ms3.evaluation.remote.messages import wants_message

    (tmp_path / "mine.py").write_text(POLICY)
    words = [sys.executable, ROOT / "robocas_cli.py", "serve-policy", "mine:Up", "--port", "0"]
    where = {"PYTHONPATH": f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', ROOT)}"}
    served = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | where)
    try:
        assert served.stdout is not None
        said = served.stdout.readline()
        assert said.startswith("mine:Up at ws://127.0.0.1:")
        remote = RemotePolicy(said.split()[-1])
        assert wants_message(remote.wants)["convention"] == "delta_quaternion"
        remote.close()
        served.send_signal(signal.SIGINT)
        out, err = served.communicate(timeout=20)
        assert (out, err.strip(), served.returncode) == ("closed\n", "interrupted", 130)
    finally:
        served.kill()
        served.communicate()


def test_an_address_that_is_none():
    words = [sys.executable, ROOT / "robocas_cli.py", "serve-policy", "still", "--port", "99999"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("error: --port: no such port")
