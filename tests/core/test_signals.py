"""Extensions cannot end a command without an error, and a second Ctrl-C ends a long native call."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest

from robocas_ms3.core.errors import ExtensionError
from robocas_ms3.core.extensions import Registry, import_object
from robocas_ms3.core.signals import forbid_exit
from robocas_ms3.core.workers import FunctionWorker, WorkerPool

ROOT = Path(__file__).resolve().parents[2]
PYTHONS_OWN = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
NATIVE = """
import hashlib
from contextlib import nullcontext
from robocas_ms3.core.signals import defer_interrupts, handle_interrupts
handle_interrupts()
with defer_interrupts(second_ends=False):
    pass
with {around}:
    print("ready", flush=True)
    while True:
        {call}
"""
LONG_CALLS = {
    "with Python's lock": ("nullcontext()", "sum(range(2**62))"),
    "without it": ("nullcontext()", HASHING := "hashlib.pbkdf2_hmac('sha256', b'', b'', 2**31 - 1)"),
    "deferred": ("defer_interrupts()", HASHING),
}
STEP = """
import hashlib, os, signal, threading
from robocas_ms3.core.signals import defer_interrupts, handle_interrupts
def interrupt():
    for _ in range(5):
        os.kill(os.getpid(), signal.SIGINT)
handle_interrupts()
try:
    with defer_interrupts() as came:
        threading.Thread(target=interrupt).start()
        while not came:
            hashlib.pbkdf2_hmac("sha256", b"", b"", 100_000)
        print("step done", flush=True)
except KeyboardInterrupt:
    print("handled", flush=True)
"""
WRITING = """
import time
from robocas_ms3.core.signals import defer_interrupts, handle_interrupts
handle_interrupts()
try:
    with defer_interrupts(second_ends=False):
        print("ready", flush=True)
        time.sleep(3)
        print("written", flush=True)
except KeyboardInterrupt:
    print("handled", flush=True)
"""
OTHER_THREAD = """
import os, signal, threading, time
from robocas_ms3.core.signals import defer_interrupts
def wait():
    started.set()
    time.sleep(60)
signal.signal(signal.SIGTERM, signal.default_int_handler)
started = threading.Event()
threading.Thread(target=wait, daemon=True).start()
started.wait()
try:
    with defer_interrupts():
        os.kill(os.getpid(), signal.SIGTERM)  # the other thread gets it
        time.sleep(0.3)
        print("written", flush=True)
except KeyboardInterrupt:
    print("handled", flush=True)
"""
ENDING = """
import sys, time
from robocas_ms3.core.signals import INTERRUPTED, handle_interrupts, exit_command
handle_interrupts()
try:
    print("ready", flush=True)
    time.sleep(100)
except KeyboardInterrupt:
    time.sleep({seconds})  # ends processes
    print("interrupted", file=sys.stderr)
    exit_command(INTERRUPTED)
"""
UNSIGNALLED = """
from robocas_ms3.core.errors import ExtensionError
from robocas_ms3.core.signals import handle_interrupts, forbid_exit
handle_interrupts()
try:
    with forbid_exit("policy mine:Policy"):
        raise KeyboardInterrupt
except ExtensionError as error:
    print(error.where)
"""


def python(program: str) -> subprocess.Popen:
    """A process that runs a program, with Python's own handling of Ctrl-C."""
    return subprocess.Popen(
        [sys.executable, "-c", PYTHONS_OWN + program],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize(
    ("number", "code", "seconds", "said"),
    [(signal.SIGINT, 130, 0.5, "interrupted\n"), (signal.SIGINT, 130, 100, ""), (signal.SIGTERM, 143, 100, "")],
)
def test_a_command_ends_within_seconds_after_several_interrupts(number, code, seconds, said):
    with python(ENDING.format(seconds=seconds)) as process:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        for _ in range(3):
            process.send_signal(number)
            time.sleep(0.1)
        assert (process.communicate(timeout=20)[1], process.returncode) == (said, code)


@pytest.mark.parametrize(("around", "call"), LONG_CALLS.values(), ids=LONG_CALLS)
def test_the_second_ctrl_c_ends_a_long_native_call(around, call):
    with python(NATIVE.format(around=around, call=call)) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "ready\n"
            while process.poll() is None:  # how long the system takes to deliver the first one is not known
                process.send_signal(signal.SIGINT)
                with suppress(subprocess.TimeoutExpired):
                    process.wait(0.2)
            assert process.returncode == -signal.SIGINT
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("program", "printed"),
    [
        pytest.param(STEP, "step done\nhandled\n", id="a step is finished although Ctrl-C comes twice at once"),
        pytest.param(OTHER_THREAD, "written\nhandled\n", id="a signal is deferred although another thread gets it"),
        pytest.param(UNSIGNALLED, "policy mine:Policy\n", id="an interrupt without a signal is an error of its source"),
    ],
)
def test_deferred_signals_are_handled_once_after_the_block(program, printed):
    with python(program) as process:
        assert (process.communicate()[0], process.returncode) == (printed, 0)


def test_a_protected_file_is_written_despite_two_interrupts():
    with python(WRITING) as process:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        for _ in range(2):
            process.send_signal(signal.SIGINT)
            time.sleep(0.8)
        assert (process.stdout.read(), process.wait()) == ("written\nhandled\n", 0)


def test_an_exit_in_an_extension_is_an_extension_error():
    with pytest.raises(ExtensionError) as caught, forbid_exit("policy mine:Policy"):
        sys.exit(0)
    assert caught.value.where == "policy mine:Policy"
    assert __file__ in str(caught.value.found)
    with pytest.raises(KeyboardInterrupt), forbid_exit("a library has no handler"):
        raise KeyboardInterrupt


@pytest.fixture
def leaving(tmp_path, monkeypatch):
    """A package whose import calls `sys.exit`."""
    info = tmp_path / "leaving-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: leaving\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[a.group]\nbad = leaving_module:BAD\n")
    (tmp_path / "leaving_module.py").write_text("import sys\nsys.exit(0)\n")
    monkeypatch.delitem(sys.modules, "leaving_module", raising=False)
    monkeypatch.syspath_prepend(tmp_path)


def test_the_import_of_an_extension_can_not_end_the_process(leaving):
    numbers = Registry("number", "a.group", int, {"one": 1})
    assert dict(numbers) == {"one": 1}
    with pytest.raises(ExtensionError):
        numbers.find("bad")
    with pytest.raises(ExtensionError):
        import_object("leaving_module:BAD")


def raise_exit(how: BaseException) -> None:
    raise how


@pytest.mark.parametrize("how", [SystemExit(0), KeyboardInterrupt()])
def test_code_in_a_worker_can_not_end_the_program(how):
    with WorkerPool(partial(FunctionWorker, raise_exit), 2) as pool, pytest.raises(ExtensionError):
        list(pool.map([how]))
