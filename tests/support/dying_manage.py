"""Manage datasets and die by SIGKILL on the way: `python dying_manage.py MOMENT ROBOCAS_ARGUMENTS...`."""

import sys

from dying import die_at

from robocas_ms3.cli.main import run
from robocas_ms3.core import files
from robocas_ms3.datasets.manage import copying, importing

PLACES = {  # moment -> (module, function, which call is the last)
    "file": (copying.FilePlacer, "place", 70),  # in the second episode
    "rename": (files, "_move_in", 2),
    "merge overview": (copying, "write_info", 1),
    "import overview": (importing, "write_info", 1),
}

if __name__ == "__main__":
    die_at(*PLACES[sys.argv[1]])
    sys.exit(run(sys.argv[2:]))
