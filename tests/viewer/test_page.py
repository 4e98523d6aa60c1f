"""The page in a real browser: filters, episodes, keys, depth, deep links, from the server and from files."""

import json
import shutil
import threading

import cv2
import numpy as np
import pytest
from browser import open_page, wait

from robocas_ms3.viewer.export import export
from robocas_ms3.viewer.server import Viewer
from robocas_ms3.viewer.source import open_content

pytestmark = pytest.mark.slow
LOADED = "document.querySelector('#episode')?.hidden === false && document.querySelector('#instruction').textContent"
ROWS = "[...document.querySelectorAll('#rows .row')].map(row => row.dataset.episode ?? 'none').join()"


@pytest.fixture(scope="module")
def browser():
    with open_page() as page:
        yield page


@pytest.fixture
def opened(browser):
    """The browser; at the end its console must have no errors."""
    browser.goto("about:blank")
    browser.errors.clear()
    yield browser
    assert browser.errors == []


@pytest.fixture(scope="module")
def serve():
    """Serves content, until the end of the module."""
    servers = []

    def start(content, port=0):
        server = Viewer(content, port)
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        servers.append(server)
        return server

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


@pytest.fixture(scope="module")
def urls(folder, serve, tmp_path_factory):
    out = tmp_path_factory.mktemp("static") / "page"
    assert export(open_content(folder), out, width=32) == (3, {})
    return {"server": serve(open_content(folder)).url, "files": (out / "index.html").as_uri()}


def load(browser, url):
    browser.goto(url)
    wait(browser, LOADED)
    return browser


@pytest.fixture
def page(opened, urls):
    """The first episode, from the server."""
    return load(opened, urls["server"])


@pytest.fixture(params=["server", "files"])
def any_page(request, opened, urls):
    """The first episode, from the server and from files."""
    return load(opened, urls[request.param])


def step(page):
    return int(page.text_content("#clock").split()[1])


def wait_for_instruction(page, text):
    wait(page, f"document.querySelector('#instruction').textContent.includes('{text}')")


def wait_for_rows(page, rows):
    wait(page, f"{ROWS} === '{rows}'")


def wait_for_images(page, number, kind, at):
    """Wait until all three cameras show a step."""
    want = f"images/{number}/static_camera/{kind}/{at}.jpg"
    wait(
        page,
        "[...document.querySelectorAll('#cameras img')].every(img => img.complete && img.naturalWidth > 0 &&"
        f" new URL(img.src).pathname.endsWith('{want}'.replace('static_camera', img.alt.replace(' ', '_')))) &&"
        " document.querySelectorAll('#cameras img').length === 3",
    )


def test_page_opens_with_the_table_and_the_first_episode(any_page):
    page = any_page
    assert page.evaluate(ROWS) == "0,1,2,none"
    assert page.text_content("#count") == "3 episodes, 1 seed skipped"
    assert page.text_content(".row.skipped .what").startswith("seed 9, skippedfailed at reach")
    assert page.text_content("#instruction") == "grasp the cube 3 on the table and move it to the basket"
    assert page.text_content("#summary").startswith("Episode 0 \u00b7 pick \u00b7 seed 3 \u00b7 7 steps, 1.2 s")
    wait_for_images(page, 0, "rgb", 0)
    wait(page, "document.querySelector('.row img').naturalWidth === 96")
    assert page.locator(".plot canvas").count() == 6
    assert page.text_content("#goals button >> nth=0") == "move and grasp"


def test_filters_and_sorting(page):
    for field, value, rows, count in (
        ("#f-success", "failure", "1,none", "1 of 3 episodes, 1 seed skipped"),
        ("#f-stage", "grasp", "1", "1 of 3 episodes, 0 of 1 seed skipped"),
        ("#f-stage", "reach", "none", "0 of 3 episodes, 1 seed skipped"),
        ("#f-object", "cube 5 (cube)", "2", "1 of 3 episodes, 0 of 1 seed skipped"),
    ):
        page.select_option(field, value)
        wait_for_rows(page, rows)
        assert page.text_content("#count") == count
        page.click("#f-reset")
        wait_for_rows(page, "0,1,2,none")
    page.click("#heads button:nth-of-type(1)")
    wait_for_rows(page, "2,1,0,none")
    page.click("#heads button:nth-of-type(4)")
    wait_for_rows(page, "1,none,0,2")
    page.fill("#f-text", "CUBE 4")
    wait_for_rows(page, "1")
    page.focus("#f-text")
    page.keyboard.press("ArrowRight")  # stays in the field
    assert step(page) == 0
    page.fill("#f-min", "8")
    wait_for_rows(page, "")


def test_an_episode_is_opened_by_a_click(page):
    page.click(".row[data-episode='1']")
    wait_for_instruction(page, "cube 4")
    assert page.get_attribute(".row.chosen", "data-episode") == "1"
    assert page.evaluate("location.hash").startswith("#episode=1")
    assert "grasp: slipped" in page.text_content("#failures")
    wait_for_images(page, 1, "rgb", 0)
    page.go_back()
    wait_for_instruction(page, "cube 3")


def test_keys(page):
    for key, at in (
        *(("ArrowRight", 1), ("ArrowRight", 2), ("ArrowLeft", 1), ("End", 6), ("ArrowRight", 6), ("Home", 0)),
        ("Shift+ArrowRight", 6),
    ):
        page.keyboard.press(key)
        assert step(page) == at
        assert page.input_value("#scrub") == str(at)
    wait_for_images(page, 0, "rgb", 6)
    page.keyboard.press("ArrowDown")
    wait_for_instruction(page, "cube 4")
    assert step(page) == 0
    page.keyboard.press("ArrowUp")
    wait_for_instruction(page, "cube 3")
    page.keyboard.press("ArrowUp")  # no episode before the first
    assert page.text_content("#instruction").startswith("grasp the cube 3")
    page.select_option("#speed", "4")
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press(" ")
    assert page.text_content("#b-play") == "Pause"
    wait(page, "document.querySelector('#clock').textContent.startsWith('step 6')")
    wait(page, "document.querySelector('#b-play').textContent === 'Play'")


def test_depth(any_page):
    page = any_page
    page.click("#v-depth")
    wait_for_images(page, 0, "depth", 0)
    page.keyboard.press("ArrowRight")
    wait_for_images(page, 0, "depth", 1)
    for key, kind in (("d", "rgb"), ("Shift+D", "depth"), ("D", "rgb")):  # D without Shift: caps lock
        page.keyboard.press(key)
        wait_for_images(page, 0, kind, 1)
    for modifier in ("Alt", "Control", "Meta"):  # the browser's own keys
        page.keyboard.press(f"{modifier}+d")
    assert page.get_attribute("#v-rgb", "aria-pressed") == "true"
    wait_for_images(page, 0, "rgb", 1)


def test_timeline_plots_and_3d_view(page):
    page.click("#goals button:nth-of-type(2)")
    assert step(page) == 3  # control step 12 of 20 Hz at 5 Hz
    assert page.text_content("#goal") == "Drop the cube 3 into the basket"
    assert page.text_content("#goals button.now") == "transfer object"
    before = page.text_content(".plot .legend b >> nth=0")
    canvas = page.locator(".plot canvas").first
    box = canvas.bounding_box()
    canvas.click(position={"x": box["width"] * 0.999, "y": box["height"] / 2})
    assert step(page) == 6
    assert page.text_content(".plot .legend b >> nth=0") != before
    shot = "document.querySelector('#space').toDataURL()"
    before = page.evaluate(shot)
    page.locator("#space").scroll_into_view_if_needed()
    box = page.locator("#space").bounding_box()
    page.mouse.move(box["x"] + 80, box["y"] + 80)
    page.mouse.down()
    page.mouse.move(box["x"] + 160, box["y"] + 80)
    page.mouse.up()
    assert page.evaluate(shot) != before


def test_deep_links(any_page):
    page = any_page
    page.evaluate("location.hash = '#episode=2&step=4'")
    wait_for_instruction(page, "cube 5")
    assert step(page) == 4
    wait_for_images(page, 2, "rgb", 4)
    page.keyboard.press("ArrowRight")
    wait(page, "location.hash === '#episode=2&step=5'")
    page.reload()
    wait(page, LOADED)
    wait_for_instruction(page, "cube 5")
    assert step(page) == 5
    for words, at in (("999", 6), ("1.5", 2), ("-3", 0), ("6.4", 6), ("x", 0), ("Infinity", 6), ("NaN", 0)):
        page.evaluate(f"location.hash = '#episode=2&step={words}'")
        wait(page, f"document.querySelector('#clock').textContent.startsWith('step {at} / 6')")
        wait_for_images(page, 2, "rgb", at)
    for words in ("77", "x"):
        page.evaluate(f"location.hash = '#episode={words}'")
        wait(page, "document.querySelector('#episode').hidden")
        assert page.text_content("#message") == f"There is no episode {words}."
    page.keyboard.press("ArrowDown")
    wait(page, LOADED)
    page.errors[:] = [error for error in page.errors if "episode_77.js" not in error]  # it was asked for


def test_trajectory_shows_paths_and_how_to_render_images(opened, serve, run_folder):
    page = load(opened, serve(open_content(run_folder)).url)
    assert "robocas convert trajectory.h5" in page.text_content("#note")
    assert page.evaluate("document.querySelector('#cameras').hidden && document.querySelector('#views').hidden")
    assert page.evaluate(ROWS) == "0,1,2,none"
    assert "seed 9, skipped" in page.text_content(".row.skipped")
    page.keyboard.press("End")
    assert page.text_content("#clock").startswith("step 22 / 22")


def test_damaged_episode_is_marked(opened, serve, folder, tmp_path):
    spoilt = shutil.copytree(folder, tmp_path / "spoilt")
    for number, new in ((0, {"recorded": "x", "layout": {"poses": 3}}), (1, {"seed": {}, "objects": 7, "target": []})):
        path = spoilt / f"episode_000000{number}/scene.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **new}))
    (spoilt / "episode_0000002/scene.json").write_text("[]")
    (spoilt / "episode_0000002/episode_info.npz").write_bytes(b"PK")
    page = load(opened, serve(open_content(spoilt)).url)
    assert page.text_content("#damage") == (
        "Not shown (damaged): scene.json, layout.poses: expected a list, found 3;"
        ' scene.json, recorded: expected an object, found "x"'
    )
    assert page.is_visible("#damage")
    page.select_option("#f-success", "damaged")
    wait_for_rows(page, "0,1,2")
    page.evaluate("document.activeElement.blur()")
    assert "damaged" in page.text_content(".row[data-episode='1'] .outcome")
    assert "objects: expected a list, found 7" in page.text_content(".row[data-episode='1'] .what")
    page.keyboard.press("ArrowDown")
    wait_for_instruction(page, "cube 4")
    wait_for_images(page, 1, "rgb", 0)
    assert page.errors == []
    page.keyboard.press("ArrowDown")
    wait(page, "document.querySelector('#episode').hidden")
    assert page.text_content("#message").startswith("Episode 2 can't be shown: scene.json: damaged JSON file")
    page.errors.clear()  # the episode could not be loaded


def test_only_visible_rows_are_created(opened, serve, folder, monkeypatch):
    source = open_content(folder)
    index = source.index()
    lines = [{**index["episodes"][n % 3], "n": n, "seed": n} for n in range(1000)]
    monkeypatch.setattr(source, "index", lambda: {**index, "episodes": lines})
    rgb = source.rgb
    monkeypatch.setattr(source, "rgb", lambda n, camera, step: rgb(n % 3, camera, step))
    page = load(opened, serve(source).url)
    assert page.locator("#rows .row").count() < 40
    assert page.text_content("#count") == "1000 episodes"
    page.evaluate("document.querySelector('#rows').scrollTop = 1e9")
    page.wait_for_selector(".row[data-episode='999']")
    assert page.locator("#rows .row").count() < 40
    wait(page, "[...document.querySelectorAll('.row img')].at(-1).naturalWidth === 96")


def test_another_dataset_at_the_same_port_shows_its_own_images(opened, folder, tmp_path):
    other = shutil.copytree(folder, tmp_path / "other")
    for path in other.glob("episode_0000000/*/rgb/0000.png"):
        cv2.imwrite(str(path), np.full((12, 16, 3), 200, np.uint8))
    port, widths = 0, []
    for path in (folder, other):
        with Viewer(open_content(path), port) as server:
            threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
            port = server.server_port
            page = load(opened, server.url)
            wait_for_images(page, 0, "rgb", 0)
            wait(page, "document.querySelector('.row img').naturalWidth === 96")
            widths.append(page.evaluate("document.querySelector('#cameras img').naturalWidth"))
            page.goto("about:blank")
            server.shutdown()
    assert widths == [64, 16]


def test_dark_and_narrow(page):
    page.emulate_media(color_scheme="dark")
    wait(page, "getComputedStyle(document.body).backgroundColor === 'rgb(20, 23, 27)'")
    page.emulate_media(color_scheme="light")
    page.set_viewport_size({"width": 420, "height": 800})
    wait(page, "document.querySelector('.plot canvas').clientWidth > 200")
    assert page.evaluate("document.documentElement.scrollWidth") <= 420
    page.set_viewport_size({"width": 1440, "height": 900})
