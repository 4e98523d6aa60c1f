"""What configurations with mistakes are told, in our words rather than pydantic's."""

import copy
import logging

import pytest
import yaml

from robocas_ms3.core.errors import ConfigError
from robocas_ms3.scenes.config import load_task_config, shipped_configs

SHIPPED = yaml.safe_load(shipped_configs()["pick_table_scattered"].read_text())


def message(**changes) -> str:
    with pytest.raises(ConfigError) as error:
        load_task_config(copy.deepcopy(SHIPPED) | changes)
    return str(error.value)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            {"layout": {"kind": "stackd"}},
            "config: wrong value for 'layout.kind' (expected one of ['orderly', 'scattered', 'stacked'], "
            "found 'stackd'). Did you mean stacked?",
        ),
        (
            {"layout": {"min_gap": 0.1}},
            "config: wrong value for 'layout.kind' (expected one of ['orderly', 'scattered', 'stacked'], "
            "found nothing)",
        ),
        (
            {"layout": {"kind": "scattered", "min_gapp": 1}},
            "config: unknown key 'layout.min_gapp' (expected one of ['kind', 'max_tries', 'min_gap'], found "
            "'min_gapp'). Did you mean min_gap?",
        ),
        (
            {"task": "serch"},
            "config: wrong value for 'task' (expected one of ['pick', 'select', 'search', 'open_pick'], found "
            "'serch'). Did you mean search?",
        ),
        (
            {"objects": {"ids": "apple"}},
            "config: wrong value for 'objects.ids' (expected a list or 'all', found 'apple')",
        ),
        (
            {"objects": {"ids": ["apple", 1.5], "count": 0}},
            "config: wrong value for 'objects.ids.1' (expected a string or a whole number, found 1.5). "
            "1 more after this one.",
        ),
        (
            {"randomisation": {"count": [3]}},
            "config: wrong value for 'randomisation.count.1' (expected at least 2 items in this list, found nothing)",
        ),
        (
            {"randomisation": {"count": [3, 4, 5]}},
            "config: wrong value for 'randomisation.count' (expected at most 2 items, not 3, found [3, 4, 5])",
        ),
        (
            {"randomisation": {"count": [3, 2]}},
            "config: randomisation.count [3, 2] must rise and end at objects.count 10",
        ),
    ],
)
def test_mistakes_are_told_in_our_words(changes, expected):
    assert message(**changes) == expected


def test_long_values_are_cut():
    assert message(support=["x" * 500]).endswith(", found ['" + "x" * 78 + "...)")


def test_a_mistyped_name_gets_the_nearest_ones():
    with pytest.raises(ConfigError) as error:
        load_task_config("pick_table_scatered")
    text = str(error.value)
    assert "Did you mean pick_table_scattered" in text
    assert "select_table_rows" not in text
    with pytest.raises(ConfigError, match="select_table_rows"):  # unlike any: all are listed
        load_task_config("xyz")


def test_an_unknown_support_is_a_warning(tmp_path, caplog):
    file = tmp_path / "mine.yaml"
    with caplog.at_level(logging.WARNING):
        load_task_config("pick_table_scattered")
        assert caplog.messages == []
        file.write_text(yaml.safe_dump(SHIPPED | {"support": "tabel"}))
        assert load_task_config(file).support == "tabel"
    (said,) = caplog.messages
    assert said.startswith(f"{file}: texts know no support 'tabel'")
    assert "dining table" in said
