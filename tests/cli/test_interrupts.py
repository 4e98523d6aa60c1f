"""Ctrl-C and SIGTERM end a command once and soon, however often they come."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

PROGRAM = """\
import sys, time
from robocas_ms3.cli.interrupts import INTERRUPTED, heed_ctrl_c, leave
heed_ctrl_c()
try:
    print("ready", flush=True)
    time.sleep(100)
except KeyboardInterrupt:
    time.sleep(float(sys.argv[1]))  # ends processes
    print("interrupted", file=sys.stderr)
    leave(INTERRUPTED)
"""


@pytest.mark.parametrize(
    ("number", "code", "seconds", "said"),
    [(signal.SIGINT, 130, 0.5, "interrupted\n"), (signal.SIGINT, 130, 100, ""), (signal.SIGTERM, 143, 100, "")],
)
def test_it_ends_once_and_soon(seconds, said, number, code):
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    words = [sys.executable, "-c", PROGRAM, str(seconds)]
    with subprocess.Popen(words, env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout.readline() == "ready\n"
        for _ in range(3):
            process.send_signal(number)
            time.sleep(0.1)
        assert process.communicate(timeout=20)[1] == said
    assert process.returncode == code
