"""`robocas difficulty`: arguments that are refused before anything is written, and damaged results."""

from __future__ import annotations

import json

import pytest

from robocas_ms3.cli.main import run
from robocas_ms3.demos.difficulty.difficulty_file import SCENES, read_difficulties

LINE = {
    "seed": 3,
    "target": "mug",
    "objects": 2,
    "visible_fraction": 1.0,
    "obstacles": 0,
    "free_grasps": 5,
    "fewest_blockers": 0,
    "gap": 0.1,
    "removals": 0,
    "first_removals": [],
    "scripted_removal": None,
    "simulated_removals": 0,
    "complete": True,
}


@pytest.mark.parametrize(
    "words",
    [
        ["pick_table_scatered"],
        ["pick_table_scattered", "--set", "objects.cout=3"],
        ["pick_table_scattered", "--seeds", "5:5"],
        ["pick_table_scattered", "--max-simulated", "0"],
        [],
        ["pick_table_scattered", "--grasp-attempts", "0"],
        ["pick_table_scattered", "--protocol", "smoke"],
        ["--protocol", "smok"],
        ["--protocol", "smoke", "--seeds", "0:3"],
        ["--protocol", "furniture-v1"],
        ["pick_shelf_scattered"],  # grasps from the front
        ["open_pick_drawer"],
    ],
)
def test_invalid_arguments_leave_no_folder(tmp_path, capsys, words):
    assert run(["difficulty", *words, "--out", str(tmp_path / "out")]) in (1, 2)
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_folder_of_another_command_is_not_overwritten(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    words = ["difficulty", "pick_table_scattered", "--out", str(tmp_path), "--overwrite"]
    assert run(words) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_truncated_last_line_is_not_a_scene(tmp_path):
    whole = json.dumps(LINE)
    (tmp_path / SCENES).write_text(f"{whole}\n{whole[:40]}")
    assert [scene.seed for scene in read_difficulties(tmp_path)] == [3]
