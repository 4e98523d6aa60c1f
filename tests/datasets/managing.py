"""Helpers of the tests of managed datasets."""

import json
import shutil

import numpy as np
from synthetic import RayCaster, write_trajectory

from robocas_ms3.datasets.conversion.convert import convert
from robocas_ms3.datasets.conversion.settings import ConversionSettings
from robocas_ms3.datasets.manage.import_robocas import import_robocas
from robocas_ms3.datasets.manage.survey import survey_dataset
from robocas_ms3.datasets.sources.reader import Dataset


class Bomb:
    """Unpickling it raises an error."""

    def __reduce__(self):
        return exec, ("raise SystemExit('unpickled')",)


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


def spoil_array(episode, key, value):
    """Put a value into the second row of an array."""
    array = arrays_of(episode)[key]
    array[1] = value
    change(episode, **{key: array})


def cut_off(path):
    path.write_bytes(path.read_bytes()[:-9])


DAMAGES = {  # what is done to an episode's folder -> the file that is damaged
    "NaN in rel_pos": (lambda e: spoil_array(e, "rel_pos", np.nan), "episode_info.npz, rel_pos"),
    "infinite ee_pos": (lambda e: spoil_array(e, "ee_pos", np.inf), "episode_info.npz, ee_pos"),
    "pickles": (lambda e: change(e, language_goal=np.array([{}], object)), "episode_info.npz, language_goal"),
    "no archive": (lambda e: (e / "episode_info.npz").write_bytes(b"PK"), "episode_info.npz"),
    "one array": (lambda e: np.save((e / "episode_info.npz").open("wb"), [1]), "episode_info.npz"),
    "no arrays": (lambda e: (e / "episode_info.npz").unlink(), "episode_info.npz"),
    "no ee_pos": (lambda e: change(e, ee_pos=None), "episode_info.npz, ee_pos"),
    "short": (lambda e: change(e, agv_pose=np.zeros((6, 3), "f4")), "episode_info.npz, agv_pose"),
    "length": (lambda e: change(e, episode_length=np.int64(6)), "episode_info.npz, episode_length"),
    "cut off": (lambda e: cut_off(e / "base_camera/rgb/0003.png"), "base_camera/rgb/0003.png"),
    "empty": (lambda e: (e / "base_camera/rgb/0003.png").write_bytes(b""), "base_camera/rgb/0003.png"),
    "no depth": (lambda e: (e / "base_camera/depth/0006.png").unlink(), "base_camera/depth/0006.png"),
    "no camera": (lambda e: shutil.rmtree(e / "base_camera"), "base_camera/intrinsic.npy"),
}


def arrays_of(episode):
    with np.load(episode / "episode_info.npz") as content:
        return dict(content)


def convert_made_up(trajectory, out, on_episode=None, **settings):
    """Convert with made-up images, without embeddings and videos unless they are asked for."""
    settings = {"embeddings": False, "video": False, "open_renderer": RayCaster} | settings
    return convert(ConversionSettings(trajectory, out, **settings), on_episode=on_episode)


def make(folder, name, seeds, **settings):
    """A dataset of these seeds, without embeddings."""
    convert_made_up(write_trajectory(folder / f"{name}.h5", seeds=tuple(seeds)), folder / name, **settings)
    return folder / name


def as_v0(root, pose_name="cam_pos_wrt"):
    """Reduce a dataset to the format of RoboCAS-v0, with one name of the camera pose files."""
    for path in [root / "conversion.json", *root.glob("*/scene.json")]:
        path.unlink()
    for path in root.glob("episode_*"):
        change(path, **dict.fromkeys(("agv_pose", "rel_agv_pose", "language_embedding", "step_goal_embs")))
    for path in root.glob("*/*/true_cam_pose*"):
        path.unlink()
    for path in root.glob("*/*/cam_pos*"):
        if not path.name.startswith(pose_name):
            path.unlink()
    return root


def problems(root, *outcomes):
    """Return episode, place, found value and repair of the findings with an outcome."""
    return [
        (f.episode, f.violation.where.removeprefix(f"episode_{f.episode or 0:07d}/"), f.violation.found, f.repair)
        for f in survey_dataset(root).findings
        if f.outcome in outcomes
    ]


def imported(root, out, **kwargs):
    import_robocas(survey_dataset(root, **kwargs), out)
    return Dataset(out)
