from pathlib import Path

import pytest

from robocas_ms3.scenes.config import reference
from robocas_ms3.scenes.config.supports import SUPPORTS
from robocas_ms3.scenes.config.task import TaskConfig
from robocas_ms3.scenes.language.texts import synonym_texts

PAGE = Path(__file__).resolve().parents[3] / "docs" / "configuration.md"


def test_the_page_is_the_declared_forms():
    assert PAGE.read_text(encoding="utf-8").endswith(f"\n\n{reference.markdown()}\n"), (
        "write robocas_ms3.scenes.config.reference.markdown() to the end of docs/configuration.md"
    )


@pytest.mark.parametrize(
    "row",
    [
        "| `task` | `pick`, `select`, `search`, `open_pick` | required |",
        "| `count` | whole number, 1 to 64 | 10 | how many of them |",
        "| `drop_height` | number, above 0 and at most 1 | 0.3 | above the surface or heap, m |",
        "| `min_xy` | 2 numbers, each -100 to 100 | none | a corner of the part, m; none: the whole surface |",
        "| `ids` | list of strings or whole numbers or `all` | `all` |",
        "| `count` | 2 whole numbers, each 0 to 16 | [1, 3] |",
        "| `furniture` | mapping: NAME to block | required | A piece of furniture. |",
        "### `furniture.NAME.pose`, `basket.pose`, `robot`",
        "### `layout` (stacked)",
    ],
)
def test_rows_say_type_range_and_default(row):
    assert row in reference.markdown()


def test_every_key_says_what_it_means():
    assert reference.undescribed() == []


def test_every_block_has_a_section():
    text = reference.markdown()
    assert text.count("### ") == 1 + len(TaskConfig.model_json_schema()["$defs"])


def test_supports_are_those_of_the_texts():
    assert set(SUPPORTS) == synonym_texts().supports.keys()
    page = " ".join(PAGE.read_text(encoding="utf-8").split())
    assert f"by alphabet: {', '.join(sorted(SUPPORTS))}." in page
