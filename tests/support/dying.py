"""Run `robocas` and die by SIGKILL on the way: `python dying.py MOMENT ROBOCAS_ARGUMENTS...`; images are made up."""

import os
import signal
import sys

from synthetic import RayCaster, render_by

from robocas_ms3.cli.main import run
from robocas_ms3.core import files
from robocas_ms3.datasets.manage import copying, importing
from robocas_ms3.datasets.writing import convert, episode_folder

PLACES = {  # moment -> (module, function, which call is the last)
    "picture": (episode_folder, "write_picture", 50),  # in the second episode
    "arrays": (episode_folder, "write_episode_files", 2),
    "file": (copying.FilePlacer, "place", 70),  # in the second episode
    "rename": (files, "_move_in", 2),
    "convert overview": (convert, "write_info", 1),
    "merge overview": (copying, "write_info", 1),
    "import overview": (importing, "write_info", 1),
    "rmtree": (os, "rmdir", 3),  # --overwrite, with two folders of the old one gone
}


def die_at(module, name, last):
    whole, calls = getattr(module, name), []

    def dying(*args, **kwargs):
        calls.append(name)
        if len(calls) == last:
            os.kill(os.getpid(), signal.SIGKILL)
        return whole(*args, **kwargs)

    setattr(module, name, dying)


if __name__ == "__main__":
    die_at(*PLACES[sys.argv[1]])
    convert.convert = render_by(RayCaster, convert.convert)
    sys.exit(run(sys.argv[2:]))
