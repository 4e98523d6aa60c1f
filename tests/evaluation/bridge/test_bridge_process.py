"""What becomes of a process that simulates, and of who waits for it, when one of them fails."""

import os
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip("websockets")
pytest.importorskip("msgpack")

from bridge_ends import SOURCE, theirs

process = theirs("process")
# of a map: a key, and an array of Python objects
OBJECTS = (
    b"\xa1x\x84\xc4\x0b__ndarray__\xc3\xc4\x04data\xc4\x08" + bytes(8) + b"\xc4\x05dtype\xa2|O\xc4\x05shape\x91\x01"
)


def interpreter(folder, script: str) -> str:
    """A program in an interpreter's place."""
    path = folder / "python"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return str(path)


def gone(pid: int, seconds: float = 20) -> bool:
    """Whether a process is no more, or is so within some time."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        try:
            with open(f"/proc/{pid}/stat") as file:
                if file.read().rpartition(")")[2].split()[0] == "Z":
                    return True
        except FileNotFoundError:
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("echo one; echo 'the disk is full' >&2; exit 3", r"ended \(exit code 3\): the disk is full\. It ran /"),
        ("kill -SEGV $$", r"ended \(signal 11\): it printed nothing"),
        (f"exec {sys.executable} -S -c 'import numpy'", r"No module named 'numpy'.*--env.python=.*ROBOCAS_SIM_PYTHON"),
        (f"exec {sys.executable} -c 'import os; os.close(int(os.environ[\"FD\"]))'", "ended"),
    ],
)
def test_one_that_dies_is_one_clear_line(tmp_path, monkeypatch, script, said):
    monkeypatch.setenv("FD", "1")
    with pytest.raises(process.RoboCASProcessError, match=said) as caught:
        process.Process(interpreter(tmp_path, script), {}, 30)
    assert "\n" not in str(caught.value)


def test_no_interpreter(tmp_path):
    with pytest.raises(process.RoboCASProcessError, match=r"no interpreter at .*nowhere.*--env.python="):
        process.Process(str(tmp_path / "nowhere"), {}, 30)


@pytest.mark.parametrize(
    "data",
    [
        (2**63).to_bytes(8, "big"),
        bytes(7) + b"\x01\xc1",
        bytes(7) + b"\x01\x05",
        (len(OBJECTS) + 1).to_bytes(8, "big") + b"\x81" + OBJECTS,
    ],
    ids=["too large", "garbage", "no map", "objects"],
)
def test_one_that_sends_no_message_is_ended(tmp_path, data):
    write = f"import os, sys; os.write(int(sys.argv[1]), {data!r}); sys.stdin.read()"
    (tmp_path / "program.py").write_text(write)
    with pytest.raises(process.RoboCASProcessError):
        process.Process(interpreter(tmp_path, f"exec {sys.executable} {tmp_path}/program.py $5"), {}, 30)


def test_one_that_hangs_is_ended(tmp_path):
    script = f"echo $$ >{tmp_path}/pid; trap '' TERM; exec sleep 100"
    with pytest.raises(process.RoboCASProcessError, match=r"did not answer within 0\.5 s.*timeout_s"):
        process.Process(interpreter(tmp_path, script), {}, 0.5)
    assert gone(int((tmp_path / "pid").read_text()))


def test_what_the_server_refuses_is_said_as_it_says_it():
    asked = {"version": 1, "protocol": "nothing", "task": "pick", "num_envs": 1, "convention": "robocas"}
    asked |= {"reference": "tcp", "rate_hz": 5, "cameras": {"base_camera": [6, 4]}}
    with pytest.raises(process.RoboCASProcessError, match="nothing: no such protocol .*smoke"):
        process.Process(sys.executable, asked, 120)


WAITS = """
import importlib, sys, time, types
package = types.ModuleType("lerobot_env_robocas")
package.__path__ = [sys.argv[1]]
sys.modules["lerobot_env_robocas"] = package
process = importlib.import_module("lerobot_env_robocas.process")
process.Process.ask = lambda self, message: print(self.pid, flush=True) or {"ready": {}}
child = process.Process(sys.executable, {}, 60)
time.sleep(100)
"""


@pytest.mark.parametrize("forked", [False, True])
def test_it_leaves_with_who_started_it_though_killed(forked):
    """Also where a fork of that one keeps its end of the socket open."""
    program = WAITS.replace("time.sleep(100)", "import os; os.fork(); time.sleep(15)") if forked else WAITS
    starter = subprocess.Popen([sys.executable, "-c", program, str(SOURCE)], stdout=subprocess.PIPE, text=True)
    assert starter.stdout is not None
    child = int(starter.stdout.readline())
    time.sleep(3)  # into its imports, or waiting for what it is to do
    starter.send_signal(signal.SIGKILL)
    starter.wait()
    assert gone(child, 10)


def test_the_tasks_of_a_protocol():
    """What ``--env.task=all`` plays."""
    assert theirs("vector_env").tasks_of("paper-v1", python=sys.executable, timeout_s=120) == ["pick", "search"]


def test_the_interpreter_that_is_taken(tmp_path, monkeypatch):
    monkeypatch.delenv("ROBOCAS_SIM_PYTHON", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert process.find_python(None) == sys.executable
    for name in ("robocas", "python"):
        (tmp_path / name).write_text("#!/bin/sh\n")
        (tmp_path / name).chmod(0o755)
    assert process.find_python(None) == str(tmp_path / "python")
    monkeypatch.setenv("ROBOCAS_SIM_PYTHON", "/of/the/variable")
    assert process.find_python(None) == "/of/the/variable"
    assert process.find_python("~/python") == os.path.expanduser("~/python")
