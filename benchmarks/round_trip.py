"""Convert trajectories to every format and back, and count the differences; print JSON.

python benchmarks/round_trip.py demos/pick/trajectory.h5 demos/select/trajectory.h5 --out round_trip

The trajectories are converted to RoboCAS and LeRobot, written in the form of RoboCAS-v0, and imported again. All
datasets are merged, and the result is split by task. JSON keys:
  TASK      results of one trajectory, per step of the conversion; merge, split: results of these steps
    seconds                 wall-clock time in seconds
    violations              number of violations that `robocas validate` finds
    episodes_changed        number of episodes whose arrays or images differ from those of the first conversion
    depth_images_changed    number of depth images that differ
    rgb_mean_error_levels   mean error of RGB images in levels of 0 to 255, due to video compression
    rgb_worst_image_levels  mean error of the worst image
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from robocas_ms3.datasets import ConversionSettings, Dataset, LeRobotDataset, convert, convert_lerobot, schema, validate
from robocas_ms3.datasets.lerobot.check import check_lerobot
from robocas_ms3.datasets.lerobot.variants import NEWEST, VARIANTS
from robocas_ms3.datasets.manage.copy_episodes import CopyOptions, open_finished_dataset
from robocas_ms3.datasets.manage.import_robocas import import_robocas
from robocas_ms3.datasets.manage.merge import merge
from robocas_ms3.datasets.manage.split import split_by_value, write_split
from robocas_ms3.datasets.manage.survey import survey_dataset

_NOT_UPSTREAMS = {"agv_pose", "rel_agv_pose", "language_embedding", "step_goal_embs"}


@dataclass
class Benchmark:
    trajectories: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Trajectory files F.h5, in folders named after their tasks."""
    out: Path
    """Folder for the datasets; must not exist."""
    size: tuple[int, int] | None = None
    """Width and height of the images in pixels. Default: 640 480."""


def main(cfg: Benchmark) -> None:
    """Run the benchmark."""
    cfg.out.mkdir(parents=True)
    report: dict[str, Any] = {}
    roots: list[Path] = []
    for path in cfg.trajectories:
        name = path.parent.name
        roots.append(cfg.out / f"{name}_robocas")
        report[name] = _one(path, roots[-1], cfg.size)
        print(name, json.dumps(report[name]), file=sys.stderr)
    merged = cfg.out / "merged"
    with _timed(report, "merge"):
        merge(roots, merged)
    report["merge"]["violations"] = len(validate(merged).violations)
    with _timed(report, "split"):
        source = open_finished_dataset(merged)
        pieces = split_by_value(source.dataset, "task", None)
        write_split(source, {cfg.out / "split" / name: sides for name, sides in pieces.items()}, None)
    report["split"]["episodes_changed"] = sum(
        _different(Dataset(root), Dataset(cfg.out / "split" / root.name.removesuffix("_robocas"))) for root in roots
    )
    print(json.dumps(report, indent=2))


def _one(trajectory: Path, ours: Path, size: tuple[int, int] | None) -> dict[str, Any]:
    """Convert one trajectory to each format and back; return the differences."""
    report: dict[str, Any] = {}
    base = str(ours).removesuffix("_robocas")
    with _timed(report, "robocas"):
        convert(ConversionSettings(trajectory, ours, size=size, embeddings=False, video=False))
    report["robocas"] |= {"episodes": len(Dataset(ours).numbers), "violations": len(validate(ours).violations)}
    sources = [("from_hdf5", trajectory, NEWEST), *((f"{version}_from_robocas", ours, version) for version in VARIANTS)]
    for kind, source, version in sources:
        root, name = Path(f"{base}_lerobot_{kind}"), f"lerobot_{kind}"
        with _timed(report, name):
            kept = size if source is trajectory else None
            convert_lerobot(ConversionSettings(source, root, size=kept, lerobot_version=version))
        report[name] |= _compare(Dataset(ours), LeRobotDataset(root))
        report[name]["violations"] = len(check_lerobot(root, decode=True).violations)
    theirs, back = Path(f"{base}_v0"), Path(f"{base}_imported")
    _write_v0(ours, theirs)
    with _timed(report, "import"):
        import_robocas(survey_dataset(theirs), back, options=CopyOptions())
    changed = _different(Dataset(ours), Dataset(back))
    report["import"] |= {"episodes_changed": changed, "violations": len(validate(back).violations)}
    return report


@contextmanager
def _timed(report: dict[str, Any], name: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    report[name] = {"seconds": round(time.perf_counter() - start, 1)}


def _compare(ours: Dataset, theirs: LeRobotDataset) -> dict[str, Any]:
    """Return the differences of LeRobot from RoboCAS episodes: arrays, depth, and RGB (lossy codec)."""
    errors, depth, wrong = [], 0, 0
    for number in ours.numbers:
        a, b = ours.episode(number), theirs.episode(number)
        wrong += not _same_arrays(a.arrays, b.arrays) or a.scene != b.scene
        for camera in a.cameras:
            for step, (rgb, mm) in enumerate(zip(b.frames(camera), b.frames(camera, "depth"), strict=True)):
                depth += not np.array_equal(mm, a.depth(camera, step))
                errors.append(np.abs(rgb.astype(np.int16) - a.rgb(camera, step)).mean())
    return {
        "episodes_changed": wrong,
        "depth_images_changed": depth,
        "rgb_mean_error_levels": round(float(np.mean(errors)), 2),
        "rgb_worst_image_levels": round(float(np.max(errors)), 2),
    }


def _different(a: Dataset, b: Dataset) -> int:
    """Return how many episodes differ, in the order of their numbers: arrays by 1e-6, image files by any byte."""
    if len(a.numbers) != len(b.numbers):
        return max(len(a.numbers), len(b.numbers))
    wrong = 0
    for one, other in zip(map(a.episode, a.numbers), map(b.episode, b.numbers), strict=True):
        images = {path.relative_to(one.folder) for path in one.folder.rglob("*.png")}
        same = images == {path.relative_to(other.folder) for path in other.folder.rglob("*.png")}
        same = same and all((one.folder / p).read_bytes() == (other.folder / p).read_bytes() for p in images)
        wrong += not same or not _same_arrays(one.arrays, other.arrays)
    return wrong


def _same_arrays(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    if a.keys() != b.keys():
        return False
    a, b = _with_continuous_yaw(a), _with_continuous_yaw(b)
    numeric = [key for key in a if a[key].dtype.kind in "fiu"]
    close = all(a[key].shape == b[key].shape and np.allclose(a[key], b[key], rtol=0, atol=1e-6) for key in numeric)
    return close and all(np.array_equal(a[key], b[key]) for key in a.keys() - numeric)


def _with_continuous_yaw(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return arrays with the yaw of the base as sine and cosine, because -pi and pi are the same angle."""
    agv = arrays["agv_pose"]
    return {**arrays, "agv_pose": np.column_stack([agv[:, :2], np.sin(agv[:, 2]), np.cos(agv[:, 2])])}


def _write_v0(root: Path, out: Path) -> None:
    """Write a dataset in the form of RoboCAS-v0, with the names of the paper."""
    ours = (schema.SCENE_FILE, schema.CONVERSION_FILE, "cam_pose_wrt_*")
    shutil.copytree(root, out, copy_function=os.link, ignore=shutil.ignore_patterns(*ours))
    for path in out.glob(f"*/{schema.EPISODE_FILE}"):
        with np.load(path) as loaded:
            kept = {key: loaded[key] for key in loaded.files if key not in _NOT_UPSTREAMS}
        path.unlink()  # the file is a link
        np.savez(path, **kept)


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
