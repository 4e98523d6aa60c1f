"""The page of a result in a browser: no overflow, no errors, and filters of the list."""

import pytest
from browser import check_layout, open_page
from synthetic_results import outcome, write

from robocas_ms3.evaluation.report import PAGE, write_report

pytestmark = pytest.mark.slow
SHOWN = (
    "[...document.querySelectorAll('table.filtered tbody tr')].filter(row => !row.hidden)"
    ".map(row => row.cells[0].textContent).join()"
)


@pytest.fixture(scope="module")
def page():
    with open_page() as page:
        yield page


@pytest.fixture(scope="module")
def url(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results") / "result"
    configs = ["table", "a_configuration_with_a_long_name_as_some_have"]
    outcomes = [
        outcome(number, came_to=number % 8, config=configs[number % 2], split=f"split {number % 3}", p_vis=number / 40)
        for number in range(40)
    ]
    write_report(write(folder, outcomes), folder)
    return f"file://{folder / PAGE}"


@pytest.mark.parametrize(("width", "dark"), [(420, True), (1440, False)])
def test_page_has_no_errors_and_no_overflow(page, url, width, dark):
    check_layout(page, url, width, dark)


def test_filters_of_failed_episodes(page, url):
    page.goto(url)
    assert len(page.evaluate(SHOWN).split(",")) == 35
    page.select_option("select[data-column='1']", "table")
    page.select_option("select[data-column='4']", "target grasped")  # reached three stages
    assert page.evaluate(SHOWN) == ""
    page.select_option("select[data-column='4']", "target touched")
    assert page.evaluate(SHOWN) == "2,10,18,26,34"
    assert page.text_content("#count") == "5"
