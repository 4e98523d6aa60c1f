import subprocess
import sys

import numpy as np
import pytest
import trimesh

from asset_tools.graspnet.labels import (
    load_label_grasps,
    make_view_directions,
    read_label_checksums,
    read_labels,
    to_tcp_poses,
)
from robocas_ms3.core.errors import AssetError

TOP_VIEW = 299  # the last of the lattice, 4.7 deg off +z
SIZE = (0.04, 0.10, 0.06)  # of the box, m
RNG = np.random.default_rng(0)


def arrays(points=1, dtype=np.float32):
    """GraspLabels without a usable grasp."""
    shape = (points, 300, 12, 4)
    return {
        "points": np.zeros((points, 3), dtype),
        "offsets": np.zeros((*shape, 3), dtype),
        "scores": np.full(shape, -1, dtype),
        "collision": np.zeros(shape, bool),
    }


def write(path, changes=(), at=(0, 0, 0), **options):
    """A label file with some labels of a point set: index -> (angle, depth, width, score, collision)."""
    data = arrays(**options)
    data["points"][0] = at
    for where, (angle, depth, width, score, collision) in changes:
        data["offsets"][where] = angle, depth, width
        data["scores"][where] = score
        data["collision"][where] = collision
    np.savez_compressed(path, **data)
    return path


def test_views_are_the_fibonacci_lattice():
    views = make_view_directions()
    assert np.linalg.norm(views, axis=1) == pytest.approx(np.ones(300))
    assert views[:, 2] == pytest.approx((2 * np.arange(300) + 1) / 300 - 1)
    # the second: z = 3 / 300 - 1 = -0.99, so radius sqrt(1 - 0.9801) = 0.141067; 0.618034 turns = 222.4922 deg
    assert views[1] == pytest.approx([-0.104018, -0.095290, -0.99], abs=1e-6)


@pytest.mark.parametrize("quarters", [0, 1])
def test_a_grasp_with_known_pose(tmp_path, quarters):
    # View 150 has z = 301 / 300 - 1 = 1 / 300 and goes 150 * 0.618033989 = 92.7050983 turns around: 253.8354 deg.
    # So the view is (-0.278396, -0.960460, 0.003333) and the approach (0.278396, 0.960460, -0.003333).
    # At angle 0 the closing axis is level: (-ay, ax, 0) / 0.999994 = (-0.960465, 0.278398, 0).
    # A quarter turn about the approach makes it approach x level = (0.000928, 0.003202, 0.999994).
    approach = [0.278396, 0.960460, -0.003333]
    closing = [[-0.960465, 0.278398, 0.0], [0.000928, 0.003202, 0.999994]][quarters]
    label = (quarters * np.pi / 2, 0.02, 0.05, 0.2, False)
    # on the side of the box at -y
    path = write(tmp_path / "000_labels.npz", [((0, 150, 3 * quarters, 1), label)], at=(0.01, -0.05, 0.02))

    pose = to_tcp_poses(read_labels(path, RNG))[0]
    assert pose[:3, 2] == pytest.approx(approach, abs=2e-6)
    assert pose[:3, 1] == pytest.approx(closing, abs=2e-6)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    # 0.02 m from the point along the approach
    assert pose[:3, 3] == pytest.approx([0.015568, -0.030791, 0.019933], abs=1e-6)


def test_the_closing_axis_crosses_the_box_from_side_to_side(tmp_path):
    # From above at the middle of the top. At angle 0 the closing axis is (-ay, ax, 0) = (vy, -vx, 0); seen from above a
    # positive angle about a downward approach is clockwise, so its azimuth itself rotates it to +x.
    view = make_view_directions()[TOP_VIEW]
    azimuth = np.arctan2(-view[0], view[1])
    labels = [((0, TOP_VIEW, i, 2), (azimuth + i * np.pi / 2, 0.03, 0.06, 0.1, False)) for i in (0, 1)]
    path = write(tmp_path / "000_labels.npz", labels, at=(0, 0, 0.03))
    box = trimesh.creation.box(SIZE)

    along, across = to_tcp_poses(read_labels(path, RNG))
    assert abs(along[0, 1]) > 0.99  # closes along x
    assert abs(across[1, 1]) > 0.99  # closes along y
    hits = box.ray.intersects_location([along[:3, 3]] * 2, [along[:3, 1], -along[:3, 1]])[0]
    assert sorted(hits[:, 0]) == pytest.approx([-0.02, 0.02], abs=1e-9)
    assert np.linalg.norm(hits[1] - hits[0]) == pytest.approx(0.04, rel=0.01)

    grasps, labelled = load_label_grasps(path, box)  # along y the box is 10 cm wide: the open gripper would hit it
    assert (len(grasps), labelled) == (1, 2)
    assert grasps.tcp_in_object[0] == pytest.approx(along)
    assert grasps.widths == pytest.approx([0.06])
    assert grasps.qualities == pytest.approx([0.1])


def test_only_good_labels_are_read(tmp_path):
    labels = {
        (0, 0, 0, 0): (0, 0.01, 0.05, 0.3, False),
        (0, 0, 0, 1): (0, 0.01, 0.05, 0.4, False),  # needs too much friction
        (0, 0, 0, 2): (0, 0.01, 0.05, 0.1, True),  # collides
        (0, 0, 0, 3): (0, 0.01, 0.09, 0.1, False),  # too wide
        (0, 1, 0, 0): (0, 0.01, 0.05, 0.0, False),  # no grasp
        (1, 299, 11, 3): (2.5, 0.04, 0.08, 0.1, False),
    }
    found = read_labels(write(tmp_path / "000_labels.npz", labels.items(), points=2, dtype=np.float32), RNG)
    assert found.frictions == pytest.approx([0.3, 0.1])
    assert found.views.tolist() == [0, 299]
    assert found.widths == pytest.approx([0.05, 0.08])
    assert found.depths == pytest.approx([0.01, 0.04])
    assert found.angles == pytest.approx([0, 2.5])


@pytest.mark.parametrize(
    ("dtype", "save"), [(np.float16, np.savez_compressed), (np.float32, np.savez), (np.float64, np.savez_compressed)]
)
def test_slices_contain_all_labels(tmp_path, monkeypatch, dtype, save):
    monkeypatch.setattr("asset_tools.graspnet.labels.SLICE_BYTES", 1)  # one point at a time
    rng = np.random.default_rng(1)
    data = arrays(points=3, dtype=dtype)
    data["points"][:] = rng.normal(size=(3, 3))
    data["offsets"][:] = rng.uniform(0, 0.1, size=data["offsets"].shape)
    data["scores"][:] = rng.choice([-1, 0.1, 0.2, 0.3, 0.5], size=data["scores"].shape)
    data["collision"][:] = rng.random(data["collision"].shape) < 0.5
    save(tmp_path / "000_labels.npz", **data)
    good = (data["scores"] > 0) & (data["scores"] < 0.35) & ~data["collision"] & (data["offsets"][..., 2] <= 0.08)

    everything = read_labels(tmp_path / "000_labels.npz", RNG)
    assert len(everything) == good.sum()
    assert everything.widths == pytest.approx(data["offsets"][good][:, 2])
    assert everything.points == pytest.approx(data["points"][np.nonzero(good)[0]])
    monkeypatch.setattr("asset_tools.graspnet.labels.CANDIDATES", 1000)
    few = read_labels(tmp_path / "000_labels.npz", np.random.default_rng(7))
    assert len(few) == 1000
    assert np.bincount(np.searchsorted([0.15, 0.25], few.frictions)) == pytest.approx([333, 333, 333], abs=60)
    again = read_labels(tmp_path / "000_labels.npz", np.random.default_rng(7))
    assert np.array_equal(few.angles, again.angles)


def _cut(path):
    path.write_bytes(path.read_bytes()[:-2000])


def _flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (_cut, "npz archive"),
        (_flip, "npz archive"),
        (lambda path: path.write_bytes(b"no archive"), "npz archive"),
        (lambda path: path.unlink(), "missing file of .* grasp labels"),
        (lambda path: np.savez(path, points=np.zeros((2, 3))), "found points"),
        (lambda path: np.savez(path, **arrays() | {"points": np.zeros((2, 3))}), "same number of points"),
        (lambda path: np.savez(path, **arrays() | {"points": np.full((1, 3), np.nan)}), "finite points"),
        (lambda path: np.savez(path, **arrays() | {"scores": np.zeros((1, 300, 12, 5))}), "scores"),
        (lambda path: np.savez(path, **arrays() | {"scores": np.zeros((1, 300, 12, 4), int)}), "int64"),
        (lambda path: np.savez(path, **arrays() | {"collision": np.zeros((1, 300, 12, 4))}), "bool"),
        (lambda path: np.savez(path, **arrays() | {"points": np.array([[{}, {}, {}]])}), "object"),
    ],
)
def test_a_damaged_file_is_one_error_that_names_it(tmp_path, damage, words):
    # noise, which can't be compressed, so that a flipped bit is one of the data
    path = tmp_path / "000_labels.npz"
    noise = np.random.default_rng(0).random((1, 300, 12, 4, 3)).astype(np.float32)
    np.savez_compressed(path, **arrays() | {"offsets": noise})
    damage(path)
    with pytest.raises(AssetError, match=words) as error:
        read_labels(path, RNG)
    assert "000_labels.npz" in str(error.value)


def test_checksums_differ_for_different_label_files(tmp_path):
    one = read_label_checksums(write(tmp_path / "one.npz"))
    assert read_label_checksums(write(tmp_path / "same.npz")) == one
    other = read_label_checksums(write(tmp_path / "other.npz", [((0, 0, 0, 0), (0, 0.01, 0.05, 0.3, False))]))
    assert [name for name, *_ in other] == [name for name, *_ in one]
    assert [a[0] for a, b in zip(one, other, strict=True) if a != b] == ["offsets.npy", "scores.npy"]
    (tmp_path / "cut.npz").write_bytes((tmp_path / "one.npz").read_bytes()[:-10])
    assert read_label_checksums(tmp_path / "cut.npz")[0][0] == "cut.npz"


MEASURE = """
import resource, sys
from pathlib import Path
import numpy as np
from asset_tools.graspnet.labels import read_labels
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
count = len(read_labels(Path(sys.argv[1]), np.random.default_rng(0)))
print(count, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)
"""


@pytest.mark.slow
def test_a_large_file_is_read_in_little_memory(tmp_path):
    data = arrays(points=700)
    rng = np.random.default_rng(0)
    data["offsets"][:] = rng.random(data["offsets"].shape, np.float32) * 0.08
    data["scores"][:] = rng.random(data["scores"].shape, np.float32)
    path = tmp_path / "000_labels.npz"
    np.savez(path, **data)  # as large in memory as a compressed one, and quicker to write
    del data
    assert path.stat().st_size > 165e6
    done = subprocess.run([sys.executable, "-c", MEASURE, path], capture_output=True, text=True, check=True)
    count, growth = done.stdout.split()
    assert int(count) == 20_000
    assert float(growth) < 150  # MB
