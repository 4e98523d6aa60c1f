"""``python -m robocas_ms3.evaluation.bridge FD PID``: play episodes for a process at the other end of a socket.

Started by ``lerobot_env_robocas``, not by people.
"""

from __future__ import annotations

import signal
import socket
import sys
from contextlib import suppress

from robocas_ms3.errors import RobocasError
from robocas_ms3.evaluation.bridge.channel import Channel, leave_with_starter
from robocas_ms3.exits import no_exit
from robocas_ms3.processes import use_one_torch_thread
from robocas_ms3.words import escape_log_lines, escape_tracebacks, print_traceback


def main(fd: int, starter: int) -> int:
    """Run until the other end is closed; gives the exit code.

    Args:
        fd: descriptor of this end.
        starter: id of the process that has the other one.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the starter's, which closes its end
    end = socket.socket(fileno=fd)
    leave_with_starter(end, starter)
    escape_log_lines()
    escape_tracebacks()
    channel, bridge = Channel(end), None
    try:
        from robocas_ms3.evaluation.bridge.server import open_bridge  # the simulator, which takes seconds

        use_one_torch_thread()
        with no_exit("the simulating process"):
            bridge = open_bridge(channel)
            channel.send({"ready": bridge.ready()})
            bridge.run()
    except EOFError:
        return 0
    except Exception as error:  # whatever it is, the other end is to hear of it
        print_traceback(type(error), error, error.__traceback__)
        said = str(error) if isinstance(error, RobocasError) else f"{type(error).__name__}: {error}"
        with suppress(OSError):
            channel.send({"error": " ".join(said.split())})
        return 1
    finally:
        if bridge is not None:
            bridge.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
