"""Convert a made-up trajectory and die by SIGKILL on the way: `python dying.py MOMENT TRAJECTORY OUT [previews]`."""

import os
import signal
import sys
from pathlib import Path

from synthetic import RayCaster

from robocas_ms3.core import files
from robocas_ms3.datasets.writing import convert, episode_folder
from robocas_ms3.datasets.writing.settings import ConversionSettings

PLACES = {  # moment -> (module, function, which call is the last)
    "picture": (episode_folder, "write_picture", 50),  # in the second episode
    "arrays": (episode_folder, "write_cameras", 2),
    "rename": (files, "_move_in", 2),
    "overview": (convert, "write_info", 1),
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
    moment, trajectory, out, *previews = sys.argv[1:]
    die_at(*PLACES[moment])
    overwrite = moment == "rmtree"
    convert.convert(
        ConversionSettings(
            Path(trajectory),
            Path(out),
            embeddings=False,
            overwrite=overwrite,
            video=bool(previews),
            open_renderer=RayCaster,
        )
    )
