"""Instructions for other targets: unique names, relations of select, parts of open_pick."""

import numpy as np

from robocas_ms3.datasets.training.target_instructions import draw_target_instruction, find_relations
from robocas_ms3.scenes.config.load import load_task_config

NAMES = np.array(["apple", "apple", "mug", "peach", "peach", ""])
XY = np.array([[0.5, 0.1], [0.7, 0.1], [0.6, 0.0], [0.6, -0.1], [0.6, -0.12], [np.nan, np.nan]])


def test_unique_names_need_no_relation():
    for name in ("pick_table_scattered", "select_table_orderly", "search_table_stacked"):
        assert find_relations(load_task_config(name), NAMES, XY, 2) == [None]
    assert find_relations(load_task_config("pick_table_scattered"), NAMES, XY, 0) == []


def test_relations_distinguish_identical_objects():
    config = load_task_config("select_table_orderly")
    assert {"nearest", "farthest"} <= set(config.target.relations)
    assert find_relations(config, NAMES, XY, 0) == ["nearest"]
    assert find_relations(config, NAMES, XY, 1) == ["farthest"]
    assert find_relations(config, NAMES, XY, 3) == []  # only 2 cm apart


def test_instructions_name_the_object():
    rng = np.random.default_rng(0)
    select = draw_target_instruction(load_task_config("select_table_orderly"), NAMES, 1, "farthest", rng)
    assert "apple" in select
    assert "farthest" in select
    search = draw_target_instruction(load_task_config("search_table_stacked"), NAMES, 2, None, rng)
    assert "mug" in search
    opening = draw_target_instruction(load_task_config("open_pick_container"), NAMES, 2, None, rng)
    assert "door" in opening
