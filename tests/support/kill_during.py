"""Run `robocas` with synthetic images and kill it at a point: `python kill_during.py POINT ROBOCAS_ARGUMENTS...`."""

import os
import signal
import sys
from pathlib import Path

from synthetic import RayCaster, render_by

from robocas_ms3.cli.main import run
from robocas_ms3.core import files
from robocas_ms3.datasets.candidate_images import render
from robocas_ms3.datasets.conversion import convert, episode_folder
from robocas_ms3.datasets.manage import copy_episodes, import_robocas

POINTS = {  # point -> (module, function, number of the call at which to kill)
    "image": (episode_folder, "write_image", 50),  # in the second episode
    "arrays": (episode_folder, "write_episode_files", 2),
    "file": (copy_episodes.FileCopier, "copy_file", 70),  # in the second episode
    "rename": (files, "_replace_folder", 2),
    "convert overview": (convert, "write_data_info", 1),
    "merge overview": (copy_episodes, "write_data_info", 1),
    "import overview": (import_robocas, "write_data_info", 1),
    "decisions": (render, "render_loaded", 2),  # of the second seed
    "images": (render, "_merge_parts", 1),
    "image parts": (render.shutil, "rmtree", 1),
    "rmtree": (os, "rmdir", 3),  # --overwrite, after two folders of the old dataset are removed
}


def lerobot_points():
    from robocas_ms3.datasets.lerobot import convert as lerobot
    from robocas_ms3.datasets.lerobot import video, writer

    lerobot.convert_lerobot = render_by(RayCaster, lerobot.convert_lerobot)
    return {
        "frame": (video.VideoEncoder, "add", 50),  # in the second episode
        "join": (video.VideoJoiner, "add", 7),
        "table": (writer.RollingTableWriter, "add", 4),
        "folders": (lerobot.os, "replace", 3),  # the third of plan, data, videos
        "joined": (Path, "rmdir", 1),
        "parts": (lerobot.shutil, "rmtree", 1),
    }


def kill_at(module, name, number):
    function, calls = getattr(module, name), []

    def count_calls(*args, **kwargs):
        calls.append(name)
        if len(calls) == number:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*args, **kwargs)

    setattr(module, name, count_calls)


if __name__ == "__main__":
    if "lerobot" in sys.argv:
        POINTS |= lerobot_points()
    kill_at(*POINTS[sys.argv[1]])
    convert.convert = render_by(RayCaster, convert.convert)
    render.render_candidates = render_by(RayCaster, render.render_candidates)
    sys.exit(run(sys.argv[2:]))
