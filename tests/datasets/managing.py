"""What tests of managed datasets share."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
from synthetic import RayCaster, write_trajectory

from robocas_ms3.datasets.convert import convert


def files_of(root):
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def read(path):
    return json.loads(path.read_text())


def edit(path, change):
    content = read(path)
    change(content)
    path.write_text(json.dumps(content))


def change(episode, **new):
    """Replace arrays of an episode's folder; None removes one."""
    path = episode / "episode_info.npz"
    with np.load(path) as content:
        arrays = {**content, **new}
    np.savez(path, **{key: array for key, array in arrays.items() if array is not None})


def arrays_of(episode):
    with np.load(episode / "episode_info.npz") as content:
        return dict(content)


def make(folder, name, seeds, **kwargs):
    """A dataset of these seeds, without embeddings."""
    trajectory = write_trajectory(folder / f"{name}.h5", seeds=tuple(seeds))
    convert(trajectory, folder / name, embeddings=False, open_source=RayCaster, **kwargs)
    return folder / name


def die(moment, *words):
    """Run `robocas` in a process of its own, which is killed at a moment."""
    command = [sys.executable, str(Path(__file__).parent / "dying_manage.py"), moment, *map(str, words)]
    environment = {**os.environ, "ROBOCAS_DEFER_REGISTRATION": "1"}
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=environment)
    assert done.returncode == -signal.SIGKILL, done.stderr
