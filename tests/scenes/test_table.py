"""Layouts as one mapped file give what the layouts themselves give."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robocas_ms3.errors import LayoutError
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.scenes.table import LayoutBatch, LayoutTable, raw_poses, write_table


def layout(seed: int) -> Layout:
    """Anything, of three slots."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = Rotation.random(5, random_state=seed).as_matrix()
    poses[:, :3, 3] = rng.uniform(-1, 1, (5, 3))
    return Layout(
        object_ids=("one", "two", "three"),
        object_poses=poses[:3],
        robot_pose=poses[3],
        basket_pose=poses[4],
        target=int(rng.integers(3)),
        present=rng.random(3) < 0.7,
    )


@pytest.fixture
def layouts() -> dict[tuple[int, int], Layout]:
    return {(objects, seed): layout(100 * objects + seed) for objects in (7, 2, 5) for seed in (30, 10, 20, 40)}


def assert_same(found: LayoutBatch, wanted: LayoutBatch) -> None:
    for name in ("object_poses", "robot_poses", "basket_poses", "targets", "present"):
        one, two = getattr(found, name), getattr(wanted, name)
        assert one.dtype == two.dtype, name
        np.testing.assert_array_equal(one, two, err_msg=name)


def test_any_pairs_are_gathered_in_the_order_they_are_asked_for(layouts, tmp_path):
    write_table(tmp_path / "table.npy", layouts)
    table = LayoutTable(tmp_path / "table.npy")
    pairs = [(5, 40), (7, 10), (5, 40), (2, 20)]
    found = table.find(*np.array(pairs).T)
    assert found is not None
    assert_same(found, LayoutBatch.of([layouts[pair] for pair in pairs]))


def test_what_is_gathered_can_be_made_tensors(layouts, tmp_path):
    import torch

    write_table(tmp_path / "table.npy", layouts)
    found = LayoutTable(tmp_path / "table.npy").find(np.array([5, 7]), np.array([40, 10]))
    assert found is not None
    for field in fields(found):
        value = getattr(found, field.name)
        assert torch.as_tensor(value).tolist() == value.tolist()


def test_what_it_lacks_it_does_not_make_up(layouts, tmp_path):
    del layouts[5, 20]
    write_table(tmp_path / "table.npy", layouts)
    table = LayoutTable(tmp_path / "table.npy")
    for objects, seed in ((5, 20), (5, 50), (5, 15), (8, 10), (3, 10), (0, 0)):
        assert table.find(np.array([2, objects]), np.array([10, seed])) is None
    assert table.find(np.array([5, 2]), np.array([10, 20])) is not None


def test_a_damaged_one_is_named(tmp_path):
    path = tmp_path / "table.npy"
    for content in (b"", b"no table", b"\x93NUMPY"):
        path.write_bytes(content)
        with pytest.raises(LayoutError, match=r"table\.npy: no table of layouts.*robocas layouts build"):
            LayoutTable(path)
    np.save(path, np.zeros((2, 3)))
    with pytest.raises(LayoutError, match="no table of layouts"):
        LayoutTable(path)


@given(st.integers(0, 10_000))
def test_poses_are_matrices_as_position_and_quaternion(seed):
    matrices = layout(seed).object_poses
    poses = raw_poses(matrices[None])
    assert poses.shape == (1, 3, 7)
    assert poses.dtype == np.float32
    turned = Rotation.from_quat(poses[0][:, [4, 5, 6, 3]]).as_matrix()
    np.testing.assert_allclose(turned, matrices[:, :3, :3], atol=1e-6)
    np.testing.assert_allclose(poses[0, :, :3], matrices[:, :3, 3], atol=1e-6)


def test_one_layout_is_a_batch_of_one():
    batch = LayoutBatch.of([replace(layout(1), target=2)])
    assert batch.targets.tolist() == [2]
    assert batch.object_poses.shape == (1, 3, 7)
