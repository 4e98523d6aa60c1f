"""Layouts as one mapped file give what the layouts themselves give."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.poses import to_wxyz
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.scenes.table import LayoutTable, State, mark_table, write_table

NAMES = ["five", "one", "three", "two"]


def layout(seed: int, objects: tuple[str, ...] | None = None) -> Layout:
    """Anything, of three slots."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = Rotation.random(5, random_state=seed).as_matrix()
    poses[:, :3, 3] = rng.uniform(-1, 1, (5, 3))
    return Layout(
        object_ids=tuple(NAMES[i] for i in rng.permutation(3)) if objects is None else objects,
        object_poses=poses[:3],
        robot_pose=poses[3],
        basket_pose=poses[4],
        target=int(rng.integers(3)),
        relation=("", "nearest")[seed % 2],
        present=rng.random(3) < 0.7,
        visible_shares=np.array([np.nan, *rng.random(2)]),
    )


@pytest.fixture
def layouts() -> dict[tuple[int, int], Layout]:
    of = {objects: layout(objects).object_ids for objects in (7, 2, 5)}
    return {(i, seed): layout(101 * i + seed, ids) for i, ids in of.items() for seed in (30, 10, 20, 40)}


@pytest.fixture
def table(layouts, tmp_path) -> LayoutTable:
    write_table(tmp_path / "table.npy", NAMES, layouts)
    return LayoutTable(tmp_path / "table.npy", NAMES)


def assert_same(found: Layout, wanted: Layout) -> None:
    assert found.object_ids == wanted.object_ids
    assert (found.target, found.relation) == (wanted.target, wanted.relation)
    np.testing.assert_array_equal(found.present, wanted.present)
    for name in ("object_poses", "robot_pose", "basket_pose", "visible_shares"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=1e-6, err_msg=name)


def test_layouts_come_back(layouts, table):
    for pair, wanted in layouts.items():
        found = table.layout(pair)
        assert found is not None
        assert_same(found, wanted)
    assert table.object_ids(5) == layouts[5, 40].object_ids
    assert table.pairs() == sorted(layouts)


def test_what_it_lacks_it_does_not_make_up(layouts, tmp_path):
    del layouts[5, 20]
    path = tmp_path / "table.npy"
    write_table(path, NAMES, layouts)
    table = LayoutTable(path, NAMES)
    for pair in ((5, 20), (5, 50), (5, 15), (8, 10), (3, 10), (0, 0)):
        assert table.layout(pair) is None
        assert table.state(pair) == State.LACKING
    assert [table.object_ids(seed) is None for seed in (1, 2, 3, 5, 9)] == [True, False, True, False, True]
    states = table.places(np.array([5, 5, 9]), np.array([10, 20, 10]))[0]
    assert states.tolist() == [State.UNTRIED, State.LACKING, State.LACKING]


def test_what_is_found_of_layouts_is_kept(layouts, table, tmp_path):
    found = {(5, 40): State.MOVES, (2, 10): State.STAYS, (0, 0): State.STAYS, (9, 9): State.MOVES, (5, 15): State.STAYS}
    mark_table(tmp_path / "table.npy", NAMES, found)  # some of which it lacks
    marked = LayoutTable(tmp_path / "table.npy", NAMES)
    assert marked.pairs(State.MOVES) == [(5, 40)]
    assert marked.pairs(State.STAYS) == [(2, 10)]
    assert len(marked.pairs(State.UNTRIED)) == len(layouts) - 2
    assert not table.pairs(State.MOVES)  # that was opened before
    assert marked.pairs() == sorted(layouts)
    known = marked.layout((5, 40))
    assert known is not None
    assert_same(known, layouts[5, 40])
    assert marked.stays(5)
    mark_table(tmp_path / "table.npy", NAMES, dict.fromkeys([pair for pair in layouts if pair[0] == 5], State.MOVES))
    assert [LayoutTable(tmp_path / "table.npy", NAMES).stays(seed) for seed in (2, 5, 9)] == [True, False, False]


def test_a_damaged_one_is_named(tmp_path):
    path = tmp_path / "table.npy"
    for content in (b"", b"no table", b"\x93NUMPY"):
        path.write_bytes(content)
        with pytest.raises(LayoutError, match=r"table\.npy: no table of layouts.*robocas layouts build"):
            LayoutTable(path, NAMES)
    numbers = np.zeros((2, 3), [("objects_seed", "i8"), ("seed", "i8"), ("state", "u1"), ("present", "?", (3,))])
    for content in (np.zeros((2, 3)), numbers):
        np.save(path, content)
        with pytest.raises(LayoutError, match="no table of layouts"):
            LayoutTable(path, NAMES)


@given(st.integers(0, 10_000))
def test_poses_are_matrices_as_position_and_quaternion(seed):
    matrices = layout(seed).object_poses
    poses = to_wxyz(matrices[None])
    assert poses.shape == (1, 3, 7)
    turned = Rotation.from_quat(poses[0][:, [4, 5, 6, 3]]).as_matrix()
    np.testing.assert_allclose(turned, matrices[:, :3, :3], atol=1e-6)
    np.testing.assert_allclose(poses[0, :, :3], matrices[:, :3, 3], atol=1e-6)
