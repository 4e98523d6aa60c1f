"""Frozen layouts of parts are joined as if they had been written at once."""

import numpy as np
import pytest

from robocas_ms3.core.errors import LayoutError
from robocas_ms3.scenes.frozen import FrozenLayouts, join_frozen, write_frozen
from robocas_ms3.scenes.layout import Layout

NAMES = ["five", "one", "three", "two"]


def layout(seed, relation="", slots=3):
    poses = np.tile(np.eye(4), (slots, 1, 1))
    poses[:, 0, 3] = seed + np.arange(slots)
    return Layout(
        object_ids=tuple(NAMES[:slots]),
        object_poses=poses,
        robot_pose=poses[0],
        basket_pose=None,
        target=0,
        relation=relation,
        present=np.ones(slots, bool),
        visible_shares=np.ones(slots),
    )


def test_parts_make_the_file_of_the_whole(tmp_path):
    layouts = {3: layout(3), 4: layout(4, "nearest"), 9: layout(9, "left")}  # texts of several lengths
    write_frozen(tmp_path / "whole.npy", NAMES, layouts)
    for seed, one in layouts.items():
        write_frozen(tmp_path / f"{seed}.npy", NAMES, {seed: one})
    join_frozen(tmp_path / "joined.npy", [tmp_path / f"{seed}.npy" for seed in layouts])
    assert (tmp_path / "joined.npy").read_bytes() == (tmp_path / "whole.npy").read_bytes()
    found = FrozenLayouts(tmp_path / "joined.npy", NAMES)
    assert found.seeds == (3, 4)
    assert found(9, 9).relation == "left"
    np.testing.assert_array_equal(found(4, 4).object_poses[:, 0, 3], [4, 5, 6])


def test_what_can_not_be_joined_is_refused_and_nothing_written(tmp_path):
    write_frozen(tmp_path / "a.npy", NAMES, {1: layout(1)})
    write_frozen(tmp_path / "b.npy", NAMES, {2: layout(2, slots=4)})
    (tmp_path / "c.npy").write_bytes((tmp_path / "a.npy").read_bytes()[:-5])
    np.save(tmp_path / "d.npy", np.zeros(3))
    for other in "bcd":
        with pytest.raises(LayoutError, match="no frozen layouts"):
            join_frozen(tmp_path / "joined.npy", [tmp_path / "a.npy", tmp_path / f"{other}.npy"])
    assert not (tmp_path / "joined.npy").exists()
