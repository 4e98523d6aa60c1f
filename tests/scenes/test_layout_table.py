"""Layout tables and frozen layouts are read back as written."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import LayoutError
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.scenes.layout_table import (
    FrozenLayouts,
    LayoutStatus,
    LayoutTable,
    join_frozen_layouts,
    write_frozen_layouts,
    write_statuses,
    write_table,
)

NAMES = ["five", "one", "three", "two"]


def layout(seed: int, objects: tuple[str, ...] | None = None, slots: int = 3) -> Layout:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (slots + 2, 1, 1))
    poses[:, :3, :3] = Rotation.random(slots + 2, random_state=seed).as_matrix()
    poses[:, :3, 3] = rng.uniform(-1, 1, (slots + 2, 3))
    return Layout(
        object_ids=tuple(NAMES[i] for i in rng.permutation(slots)) if objects is None else objects,
        object_poses=poses[2:],
        robot_pose=poses[0],
        basket_pose=poses[1],
        target=int(rng.integers(slots)),
        relation=("", "nearest")[seed % 2],
        present=rng.random(slots) < 0.7,
        visible_fractions=np.array([np.nan, *rng.random(slots - 1)]),
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
    for name in ("object_poses", "robot_pose", "basket_pose", "visible_fractions"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=1e-6, err_msg=name)


def test_layouts_are_read_back(layouts, table):
    for pair, wanted in layouts.items():
        found = table.layout(pair)
        assert found is not None
        assert_same(found, wanted)
    assert table.object_ids(5) == layouts[5, 40].object_ids
    assert table.find_pairs() == sorted(layouts)


def test_missing_layouts_are_reported_as_missing(layouts, tmp_path):
    del layouts[5, 20]
    path = tmp_path / "table.npy"
    write_table(path, NAMES, layouts)
    table = LayoutTable(path, NAMES)
    for pair in ((5, 20), (5, 50), (5, 15), (8, 10), (3, 10), (0, 0)):
        assert table.layout(pair) is None
        assert table.status(pair) == LayoutStatus.MISSING
    assert [table.object_ids(seed) is None for seed in (1, 2, 3, 5, 9)] == [True, False, True, False, True]
    states = table.find_records(np.array([5, 5, 9]), np.array([10, 20, 10]))[0]
    assert states.tolist() == [LayoutStatus.UNCHECKED, LayoutStatus.MISSING, LayoutStatus.MISSING]


def test_statuses_of_layouts_are_stored(layouts, table, tmp_path):
    found = {
        (5, 40): LayoutStatus.UNSTABLE,
        (2, 10): LayoutStatus.STABLE,
        (0, 0): LayoutStatus.STABLE,
        (9, 9): LayoutStatus.UNSTABLE,
        (5, 15): LayoutStatus.STABLE,
    }
    write_statuses(tmp_path / "table.npy", NAMES, found)  # some of these are not in the table
    marked = LayoutTable(tmp_path / "table.npy", NAMES)
    assert marked.find_pairs(LayoutStatus.UNSTABLE) == [(5, 40)]
    assert marked.find_pairs(LayoutStatus.STABLE) == [(2, 10)]
    assert len(marked.find_pairs(LayoutStatus.UNCHECKED)) == len(layouts) - 2
    assert not table.find_pairs(LayoutStatus.UNSTABLE)  # opened before the change
    assert marked.find_pairs() == sorted(layouts)
    known = marked.layout((5, 40))
    assert known is not None
    assert_same(known, layouts[5, 40])
    assert marked.has_usable_layout(5)
    write_statuses(
        tmp_path / "table.npy", NAMES, dict.fromkeys([pair for pair in layouts if pair[0] == 5], LayoutStatus.UNSTABLE)
    )
    assert [LayoutTable(tmp_path / "table.npy", NAMES).has_usable_layout(seed) for seed in (2, 5, 9)] == [
        True,
        False,
        False,
    ]


def test_error_names_the_damaged_file(tmp_path):
    path = tmp_path / "table.npy"
    for content in (b"", b"no table", b"\x93NUMPY"):
        path.write_bytes(content)
        with pytest.raises(LayoutError, match=r"table\.npy: not a layout table.*robocas layouts build"):
            LayoutTable(path, NAMES)
    numbers = np.zeros((2, 3), [("objects_seed", "i8"), ("seed", "i8"), ("state", "u1"), ("present", "?", (3,))])
    for content in (np.zeros((2, 3)), numbers):
        np.save(path, content)
        with pytest.raises(LayoutError, match="not a layout table"):
            LayoutTable(path, NAMES)


def test_joined_parts_equal_the_whole_file(tmp_path):
    layouts = {seed: replace(layout(seed), relation=said) for seed, said in ((3, ""), (4, "nearest"), (9, "left"))}
    write_frozen_layouts(tmp_path / "whole.npy", NAMES, layouts)
    for seed, one in layouts.items():
        write_frozen_layouts(tmp_path / f"{seed}.npy", NAMES, {seed: one})
    join_frozen_layouts(tmp_path / "joined.npy", [tmp_path / f"{seed}.npy" for seed in layouts])
    assert (tmp_path / "joined.npy").read_bytes() == (tmp_path / "whole.npy").read_bytes()
    found = FrozenLayouts(tmp_path / "joined.npy", NAMES)
    assert found.seed_range == (3, 4)
    assert_same(found(9, 9), layouts[9])
    for pair in ((3, 4), (5, 5)):
        with pytest.raises(LayoutError):
            found(*pair)


def test_files_that_can_not_be_joined_are_errors_and_nothing_is_written(tmp_path):
    write_frozen_layouts(tmp_path / "a.npy", NAMES, {1: layout(1)})
    write_frozen_layouts(tmp_path / "b.npy", NAMES, {2: layout(2, slots=4)})
    (tmp_path / "c.npy").write_bytes((tmp_path / "a.npy").read_bytes()[:-5])
    np.save(tmp_path / "d.npy", np.zeros(3))
    for other in "bcd":
        with pytest.raises(LayoutError) as caught:
            join_frozen_layouts(tmp_path / "joined.npy", [tmp_path / "a.npy", tmp_path / f"{other}.npy"])
        assert caught.value.where == tmp_path / f"{other}.npy"
    assert not (tmp_path / "joined.npy").exists()
