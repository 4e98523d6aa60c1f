"""Convert a made-up trajectory to LeRobot and die by SIGKILL: `python dying_lerobot.py MOMENT TRAJECTORY OUT`."""

import sys
from pathlib import Path

from dying import die_at
from synthetic import RayCaster

from robocas_ms3.core import files, outputs
from robocas_ms3.datasets.lerobot import convert, video, writer
from robocas_ms3.datasets.writing.settings import ConversionSettings

PLACES = {  # moment -> (module, name of the function or method's owner and it, which call is the last)
    "frame": (video.Encoder, "add", 50),  # in the second episode
    "part": (files, "_move_in", 2),
    "plan": (outputs, "write_json", 1),
    "join": (video.Joiner, "add", 7),
    "table": (writer.RollingTable, "add", 4),
    "overview": (writer, "write_json", 2),
    "rename": (convert.os, "replace", 3),  # plan, data, videos: the third
    "joined": (Path, "rmdir", 1),
    "sweep": (convert.shutil, "rmtree", 1),
}

if __name__ == "__main__":
    moment, trajectory, out = sys.argv[1:]
    die_at(*PLACES[moment])
    convert.convert_lerobot(ConversionSettings(Path(trajectory), Path(out), open_renderer=RayCaster))
