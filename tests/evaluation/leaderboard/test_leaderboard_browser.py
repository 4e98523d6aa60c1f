"""The page of the leaderboard in a browser, with the entries of this project: no overflow, no errors, and filters."""

from pathlib import Path

import pytest
from browser import check_layout, open_page

from robocas_ms3.evaluation.leaderboard.entries import find_results
from robocas_ms3.evaluation.leaderboard.output import PAGE, AuditedResult, write_leaderboard_page
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.results.result_files import read_result

pytestmark = pytest.mark.slow
ENTRIES = Path(__file__).resolve().parents[3] / "leaderboard"
SHOWN = """column => [...document.querySelectorAll('table.filtered tbody tr')]
    .filter(row => !row.hidden).map(row => row.cells[column].firstChild?.textContent ?? '')"""


@pytest.fixture(scope="module")
def page():
    with open_page() as page:
        yield page


@pytest.fixture(scope="module")
def url(tmp_path_factory):
    out = tmp_path_factory.mktemp("leaderboard")
    results = [read_result(folder) for folder in find_results(ENTRIES)]
    write_leaderboard_page([AuditedResult(one, load_protocol(one.run.protocol), {}) for one in results], out)
    return f"file://{out / PAGE}"


@pytest.mark.parametrize(("width", "dark"), [(420, True), (1440, False)])
def test_page_has_no_errors_and_no_overflow(page, url, width, dark):
    check_layout(page, url, width, dark)


@pytest.mark.parametrize("name", ["protocol", "track", "policy", "training data"])
def test_each_choice_of_a_filter_shows_its_rows(page, url, name):
    page.goto(url)
    selection = f"select[data-name='{name}']"
    column = page.get_attribute(selection, "data-column")
    choices = page.eval_on_selector_all(f"{selection} option", "found => found.map(option => option.value)")
    assert choices[0] == "" and len(choices) > 3
    page.select_option(selection, "")
    everything = page.evaluate(SHOWN, column)
    for value in choices[1:]:
        page.select_option(selection, value)
        assert page.evaluate(SHOWN, column) == [value] * everything.count(value) != []
    assert page.locator("#empty").is_hidden()


def test_filters_apply_to_the_entries_too(page, url):
    page.goto(url)
    page.select_option("select[data-name=policy]", "keyframe")
    page.select_option("select[data-name=protocol]", "paper-v1")
    assert page.locator("details.entry > summary:visible").all_inner_texts() == ["keyframe"]
    page.locator("details.entry > summary:visible").click()
    assert page.locator("details[data-policy] > summary:visible").all_inner_texts() == ["paper-v1"]
    page.select_option("select[data-name=policy]", "scripted")
    assert page.locator("#empty").is_visible() and page.locator("summary:visible").count() == 0
