"""Run a command of the docs that takes longer than 10 s, and store what it prints for `test_page_commands.py`.

python tests/examples/record_outputs.py NAME ...    # names: see OUTPUTS; default: all
"""

import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

from robocas_ms3 import __version__

OUTPUTS = {
    "generate": "robocas generate pick -n 12 --jobs 2",
    "plan_run_tiny": "robocas plan run tiny --out runs/tiny --jobs 2",
}


def main() -> None:
    """Record outputs by name."""
    program = [sys.executable, str(Path(__file__).resolve().parents[2] / "robocas_cli.py")]
    for name in sys.argv[1:] or OUTPUTS:
        with tempfile.TemporaryDirectory() as folder:
            command = [*program, *shlex.split(OUTPUTS[name])[1:]]
            done = subprocess.run(
                command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=True
            )
        output = done.stdout.replace(f"{folder}/", "")
        path = Path(__file__).with_name("outputs") / f"{name}.txt"
        path.write_text(f"robocas {__version__}\n$ {OUTPUTS[name]}\n{output}", encoding="utf-8")


if __name__ == "__main__":
    main()
