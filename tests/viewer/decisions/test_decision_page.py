"""Decisions in a real browser: list, views, table, outcomes, keys, deep links, from the server and from files."""

from __future__ import annotations

import threading

import pytest
from browser import open_page, wait

from robocas_ms3.viewer.export import export
from robocas_ms3.viewer.server import Viewer
from robocas_ms3.viewer.source import open_content

pytestmark = pytest.mark.slow
LOADED = "document.querySelector('#decision')?.hidden === false && document.querySelectorAll('#d-rows tr').length"
VIEWS = """[...document.querySelectorAll("#d-views button")].map(
    button => button.textContent + (button.getAttribute("aria-pressed") === "true" ? "*" : ""))"""
SHOWN = "document.querySelectorAll('#d-image .candidate').length"
FOCUS = "[...document.querySelectorAll('#d-image .focus, #d-rows .focus')].map(node => node.dataset.n)"


@pytest.fixture(scope="module")
def urls(file_with_images, plain_file, tmp_path_factory):
    out = tmp_path_factory.mktemp("static") / "page"
    assert export(open_content(file_with_images), out) == (8, {})
    servers = [Viewer(open_content(path)) for path in (file_with_images, plain_file)]
    for server in servers:
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    yield {"server": servers[0].url, "files": (out / "index.html").as_uri(), "plain": servers[1].url}
    for server in servers:
        server.shutdown()
        server.server_close()


@pytest.fixture(scope="module")
def browser():
    with open_page() as page:
        yield page


@pytest.fixture
def open_url(browser, urls):
    """A function that opens a page; at the end the console must have no errors."""
    browser.goto("about:blank")
    browser.errors.clear()

    def load(name, place=""):
        browser.goto(urls[name] + place)
        wait(browser, LOADED)
        return browser

    yield load
    assert browser.errors == []


@pytest.mark.parametrize("name", ["server", "files"])
def test_first_decision(open_url, name):
    page = open_url(name)
    assert page.evaluate("document.querySelectorAll('#rows .row').length") == 8
    assert page.text_content("#count") == "8 decisions"
    views = [view.removesuffix("*") for view in page.evaluate(VIEWS)]
    assert views == ["base camera", "gripper camera", "static camera", "top view"]
    assert page.evaluate(SHOWN) == 10
    wait(page, "document.querySelector('#d-image image') !== null")


def test_candidates_are_linked_to_the_table(open_url):
    page = open_url("server")
    page.hover("#d-rows tr[data-n='4']")
    assert page.evaluate(FOCUS) == ["4", "4"]
    assert "push" in page.text_content("#d-candidate")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    assert page.evaluate(FOCUS) == ["1", "1"]
    page.keyboard.press("Escape")
    assert page.evaluate(FOCUS) == []


def test_outcomes_can_be_hidden(open_url):
    page = open_url("server")
    page.click("#d-outcomes button:has-text('infeasible')")
    assert page.evaluate(SHOWN) == page.evaluate("document.querySelectorAll('#d-rows tr').length") == 8


def test_views_zoom_and_depth(open_url):
    page = open_url("server", "#decision=2")
    page.click("#d-views button:has-text('static camera')")
    assert "static camera*" in page.evaluate(VIEWS)
    page.keyboard.press("z")
    assert page.get_attribute("#d-image", "viewBox") == "0 0 64 48"
    page.keyboard.press("d")
    assert "/depth/" in page.get_attribute("#d-image image", "href")
    page.keyboard.press("v")
    assert "top view*" in page.evaluate(VIEWS)


def test_keys_and_links_choose_decisions(open_url):
    page = open_url("server", "#decision=2")
    page.keyboard.press("ArrowDown")
    wait(page, "location.hash === '#decision=3' && document.querySelector('#d-summary').textContent.includes('pull')")
    page.evaluate("location.hash = '#decision=99'")
    wait(page, "document.querySelector('#message').textContent.includes('no decision 99')")
    page.errors.clear()  # of the request for decision 99


def test_without_images(open_url):
    page = open_url("plain")
    assert page.evaluate(SHOWN) == 10
    assert page.evaluate("document.querySelectorAll('#d-image image').length") == 0
    assert "robocas render-candidates" in page.text_content("#note")
