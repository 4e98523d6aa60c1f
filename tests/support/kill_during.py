"""Run `robocas` and die by SIGKILL on the way: `python dying.py MOMENT ROBOCAS_ARGUMENTS...`; images are made up."""

import os
import signal
import sys
from pathlib import Path

from synthetic import RayCaster, render_by

from robocas_ms3.cli.main import run
from robocas_ms3.core import files
from robocas_ms3.datasets.conversion import convert, episode_folder
from robocas_ms3.datasets.manage import copy_episodes, import_robocas

PLACES = {  # moment -> (module, function, which call is the last)
    "image": (episode_folder, "write_image", 50),  # in the second episode
    "arrays": (episode_folder, "write_episode_files", 2),
    "file": (copy_episodes.FilePlacer, "place", 70),  # in the second episode
    "rename": (files, "_move_in", 2),
    "convert overview": (convert, "write_info", 1),
    "merge overview": (copy_episodes, "write_info", 1),
    "import overview": (import_robocas, "write_info", 1),
    "rmtree": (os, "rmdir", 3),  # --overwrite, with two folders of the old one gone
}


def lerobot_places():
    from robocas_ms3.datasets.lerobot import convert as lerobot
    from robocas_ms3.datasets.lerobot import video, writer

    lerobot.convert_lerobot = render_by(RayCaster, lerobot.convert_lerobot)
    return {
        "frame": (video.VideoEncoder, "add", 50),  # in the second episode
        "join": (video.VideoJoiner, "add", 7),
        "table": (writer.RollingTable, "add", 4),
        "folders": (lerobot.os, "replace", 3),  # plan, data, videos: the third
        "joined": (Path, "rmdir", 1),
        "parts": (lerobot.shutil, "rmtree", 1),
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
    if "lerobot" in sys.argv:
        PLACES |= lerobot_places()
    die_at(*PLACES[sys.argv[1]])
    convert.convert = render_by(RayCaster, convert.convert)
    sys.exit(run(sys.argv[2:]))
