"""The page in a real browser: filters, episodes, keys, depth, deep links, from the server and from files."""

import json
import shutil
import threading
import time

import cv2
import numpy as np
import pytest
from browser import Browser, require_chromium

from robocas_ms3.viewer.export import export
from robocas_ms3.viewer.server import Viewer
from robocas_ms3.viewer.source import open_source

pytestmark = pytest.mark.slow
LOADED = "document.querySelector('#episode')?.hidden === false && document.querySelector('#instruction').textContent"
ROWS = "[...document.querySelectorAll('#rows .row')].map(row => row.dataset.episode ?? 'none').join()"


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(require_chromium(), tmp_path_factory.mktemp("profile")) as running:
        yield running


def serve(path):
    server = Viewer(open_source(path))
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    return server


@pytest.fixture(scope="module")
def url(folder):
    server = serve(folder)
    yield server.url
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="module")
def static(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("static") / "page"
    assert export(open_source(folder), out, width=32) == (3, {})
    return (out / "index.html").as_uri()


@pytest.fixture(params=["server", "files"])
def page(request, browser, url, static):
    """The first episode, open; afterwards nothing may have gone wrong in the browser."""
    browser.goto("about:blank")
    browser.errors.clear()
    browser.goto(url if request.param == "server" else static)
    browser.wait(LOADED)
    yield browser
    assert browser.errors == []


def step(browser):
    return int(browser.text("#clock").split()[1])


def pictures(browser, number, kind, at):
    """Waits until all three cameras show a step."""
    want = f"pictures/{number}/static_camera/{kind}/{at}.jpg"
    browser.wait(
        "[...document.querySelectorAll('#cameras img')].every(img => img.complete && img.naturalWidth > 0 &&"
        f" new URL(img.src).pathname.endsWith('{want}'.replace('static_camera', img.alt.replace(' ', '_')))) &&"
        " document.querySelectorAll('#cameras img').length === 3"
    )


def test_it_opens_with_the_table_and_the_first_episode(page):
    assert page.run(ROWS) == "0,1,2,none"
    assert page.text("#count") == "3 episodes, 1 seed given up"
    assert page.text(".row.gone .what").startswith("seed 9, given upfailed at reach")
    assert page.text("#instruction") == "grasp the cube 3 on the table and move it to the basket"
    assert page.text("#summary").startswith("Episode 0 \u00b7 pick \u00b7 seed 3 \u00b7 7 steps, 1.2 s")
    pictures(page, 0, "rgb", 0)
    page.wait("document.querySelector('.row img').naturalWidth === 96")
    assert page.run("document.querySelectorAll('.plot canvas').length") == 6
    assert page.run("document.querySelector('#goals button').textContent") == "move and grasp"


def test_filters(page):
    page.choose("#f-success", "failure")
    page.wait(f"{ROWS} === '1,none'")
    assert page.text("#count") == "1 of 3 episodes, 1 seed given up"
    page.click("#f-reset")
    page.wait(f"{ROWS} === '0,1,2,none'")
    page.choose("#f-stage", "grasp")
    page.wait(f"{ROWS} === '1'")
    assert page.text("#count") == "1 of 3 episodes, 0 of 1 seed given up"
    page.click("#f-reset")
    page.wait(f"{ROWS} === '0,1,2,none'")
    page.choose("#f-stage", "reach")
    page.wait(f"{ROWS} === 'none'")
    page.click("#f-reset")
    page.wait(f"{ROWS} === '0,1,2,none'")
    page.choose("#f-object", "cube 5 (cube)")
    page.wait(f"{ROWS} === '2'")
    page.click("#f-reset")
    page.wait(f"{ROWS} === '0,1,2,none'")
    page.type("#f-text", "CUBE 4")
    page.wait(f"{ROWS} === '1'")
    page.type("#f-min", "8")
    page.wait(f"{ROWS} === ''")


def test_sorting(page):
    page.click("#heads button:nth-of-type(1)")
    page.wait(f"{ROWS} === '2,1,0,none'")
    page.click("#heads button:nth-of-type(4)")
    page.wait(f"{ROWS} === '1,none,0,2'")


def test_an_episode_is_opened_by_a_click(page):
    page.click(".row[data-episode='1']")
    page.wait("document.querySelector('#instruction').textContent.includes('cube 4')")
    assert page.run("document.querySelector('.row.chosen').dataset.episode") == "1"
    assert page.run("location.hash").startswith("#episode=1")
    assert "grasp: slipped" in page.text("#failures")
    pictures(page, 1, "rgb", 0)
    page.run("history.back()")
    page.wait("document.querySelector('#instruction').textContent.includes('cube 3')")


def test_keys(page):
    for key, at in (("ArrowRight", 1), ("ArrowRight", 2), ("ArrowLeft", 1), ("End", 6), ("ArrowRight", 6), ("Home", 0)):
        page.press(key)
        assert step(page) == at
        assert page.run("document.querySelector('#scrub').value") == str(at)
    page.press("ArrowRight", shift=True)
    assert step(page) == 6
    pictures(page, 0, "rgb", 6)
    page.press("ArrowDown")
    page.wait("document.querySelector('#instruction').textContent.includes('cube 4')")
    assert step(page) == 0
    page.press("ArrowUp")
    page.wait("document.querySelector('#instruction').textContent.includes('cube 3')")
    page.press("ArrowUp")  # there is none before the first
    assert page.text("#instruction").startswith("grasp the cube 3")


def test_keys_typed_into_a_field_stay_there(page):
    page.run("document.querySelector('#f-text').focus()")
    page.press("ArrowRight")
    page.press("End")
    assert step(page) == 0


def test_playing_runs_to_the_end(page):
    page.choose("#speed", "4")
    page.press(" ")
    assert page.text("#b-play") == "Pause"
    page.wait("document.querySelector('#clock').textContent.startsWith('step 6')")
    page.wait("document.querySelector('#b-play').textContent === 'Play'")
    pictures(page, 0, "rgb", 6)


def test_depth(page):
    page.click("#v-depth")
    pictures(page, 0, "depth", 0)
    page.press("ArrowRight")
    pictures(page, 0, "depth", 1)
    page.press("d")
    pictures(page, 0, "rgb", 1)
    page.press("D", shift=True)
    pictures(page, 0, "depth", 1)
    page.press("D")  # with caps lock
    pictures(page, 0, "rgb", 1)
    for modifiers in (1, 2, 4):  # Alt, Ctrl, Meta: the browser's own keys
        page.press("d", modifiers=modifiers)
    assert page.run("document.querySelector('#v-rgb').getAttribute('aria-pressed')") == "true"
    pictures(page, 0, "rgb", 1)
    assert page.run("document.querySelector('#v-rgb').getAttribute('aria-pressed')") == "true"


def test_timeline_and_plots_seek(page):
    page.click("#goals button:nth-of-type(2)")
    assert step(page) == 3  # control step 12 of 20 Hz at 5 Hz
    assert page.text("#goal") == "Drop the cube 3 into the basket"
    assert page.run("document.querySelector('#goals button.now').textContent") == "transfer object"
    before = page.text(".plot .legend b")
    page.click(".plot canvas", share=(0.999, 0.5))
    assert step(page) == 6
    assert page.text(".plot .legend b") != before


def test_deep_links(page):
    page.run("location.hash = '#episode=2&step=4'")
    page.wait("document.querySelector('#instruction').textContent.includes('cube 5')")
    assert step(page) == 4
    pictures(page, 2, "rgb", 4)
    page.press("ArrowRight")
    page.wait("location.hash === '#episode=2&step=5'")
    page.run("window.old = true")
    page.send("Page.reload")
    page.wait(f"!window.old && {LOADED} && document.querySelector('#instruction').textContent.includes('cube 5')")
    assert step(page) == 5
    for words, at in (("999", 6), ("1.5", 2), ("-3", 0), ("6.4", 6), ("x", 0), ("Infinity", 6), ("NaN", 0)):
        page.run(f"location.hash = '#episode=2&step={words}'")
        page.wait(f"document.querySelector('#clock').textContent.startsWith('step {at} / 6')")
        pictures(page, 2, "rgb", at)


def test_a_link_to_nothing_says_so(page):
    for words in ("#episode=77", "#episode=x"):
        page.run(f"location.hash = '{words}'")
        page.wait("document.querySelector('#episode').hidden")
        assert page.text("#message") == f"There is no episode {words[9:]}."
    page.press("ArrowDown")
    page.wait(LOADED)
    page.errors[:] = [error for error in page.errors if "episode_77.js" not in error]  # it was asked for


def test_the_3d_view_turns(page):
    shot = "document.querySelector('#space').toDataURL()"
    page.wait("document.querySelector('#space').width > 100")
    before = page.run(shot)
    page.run("document.querySelector('#space').scrollIntoView()")
    box = page.run(
        "(() => { const b = document.querySelector('#space').getBoundingClientRect(); return [b.x, b.y]; })()"
    )
    for kind, x in (("mousePressed", 80), ("mouseMoved", 160), ("mouseReleased", 160)):
        page.send("Input.dispatchMouseEvent", type=kind, x=box[0] + x, y=box[1] + 80, button="left", clickCount=1)
    assert page.run(shot) != before


def test_a_trajectory_shows_traces_and_says_how_to_get_pictures(browser, run_folder):
    browser.errors.clear()
    with serve(run_folder) as server:
        browser.goto(server.url)
        browser.wait(LOADED)
        assert "robocas convert trajectory.h5" in browser.text("#note")
        assert browser.run("document.querySelector('#cameras').hidden && document.querySelector('#views').hidden")
        assert browser.run(ROWS) == "0,1,2,none"
        assert "seed 9, given up" in browser.text(".row.gone")
        browser.choose("#f-stage", "reach")
        browser.wait(f"{ROWS} === 'none'")
        browser.press("End")
        assert browser.text("#clock").startswith("step 22 / 22")
        server.shutdown()
    assert browser.errors == []


@pytest.mark.parametrize("static", [False, True])
def test_a_damaged_episode_is_shown_as_such(browser, folder, tmp_path, static):
    spoilt = shutil.copytree(folder, tmp_path / "spoilt")
    for number, new in ((0, {"recorded": "x", "layout": {"poses": 3}}), (1, {"seed": {}, "objects": 7, "target": []})):
        path = spoilt / f"episode_000000{number}/scene.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **new}))
    (spoilt / "episode_0000002/scene.json").write_text("[]")
    (spoilt / "episode_0000002/episode_info.npz").write_bytes(b"PK")
    browser.errors.clear()
    with serve(spoilt) as server:
        url = server.url
        if static:
            export(open_source(spoilt), tmp_path / "page", width=32)
            url = (tmp_path / "page/index.html").as_uri()
        browser.goto(url)
        browser.wait(LOADED)
        assert browser.text("#damage") == (
            "Damaged and left out: scene.json, layout.poses: expected a list, found 3;"
            ' scene.json, recorded: expected an object, found "x"'
        )
        assert browser.run("getComputedStyle(document.querySelector('#damage')).display") == "block"
        browser.choose("#f-success", "damaged")
        browser.wait(f"{ROWS} === '0,1,2'")
        assert "damaged" in browser.text(".row[data-episode='1'] .outcome")
        assert "objects: expected a list, found 7" in browser.text(".row[data-episode='1'] .what")
        browser.press("ArrowDown")
        browser.wait("document.querySelector('#instruction').textContent.includes('cube 4')")
        pictures(browser, 1, "rgb", 0)
        assert browser.errors == []
        browser.press("ArrowDown")
        browser.wait("document.querySelector('#episode').hidden")
        assert browser.text("#message").startswith("Episode 2 can't be shown: scene.json: this JSON is damaged")
        server.shutdown()


def test_a_lerobot_dataset(browser, lerobot):
    browser.errors.clear()
    with serve(lerobot) as server:
        browser.goto(server.url + "#episode=1&step=4")
        browser.wait(LOADED)
        pictures(browser, 1, "rgb", 4)
        browser.press("d")
        pictures(browser, 1, "depth", 4)
        server.shutdown()
    assert browser.errors == []


def test_a_thousand_episodes_are_quick_and_only_seen_rows_are_made(browser, folder, monkeypatch):
    source = open_source(folder)
    index = source.index()
    lines = [{**index["episodes"][n % 3], "n": n, "seed": n} for n in range(1000)]
    monkeypatch.setattr(source, "index", lambda: {**index, "episodes": lines})
    rgb = source.rgb
    monkeypatch.setattr(source, "rgb", lambda n, camera, step: rgb(n % 3, camera, step))
    browser.errors.clear()
    with Viewer(source) as server:
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        begun = time.monotonic()
        browser.goto(server.url)
        browser.wait(LOADED)
        assert time.monotonic() - begun < 20  # a second where nothing else runs
        assert browser.run("document.querySelectorAll('#rows .row').length") < 40
        assert browser.text("#count") == "1000 episodes"
        browser.run("document.querySelector('#rows').scrollTop = 1e9")
        browser.wait("document.querySelector('.row[data-episode=\"999\"]')")
        assert browser.run("document.querySelectorAll('#rows .row').length") < 40
        browser.wait("[...document.querySelectorAll('.row img')].at(-1).naturalWidth === 96")
        browser.goto("about:blank")
        server.shutdown()
    assert browser.errors == []


def test_another_dataset_at_the_same_port_shows_its_own_pictures(browser, folder, tmp_path):
    other = shutil.copytree(folder, tmp_path / "other")
    for path in other.glob("episode_0000000/*/rgb/0000.png"):
        cv2.imwrite(str(path), np.full((12, 16, 3), 200, np.uint8))
    port, widths = 0, {}
    for path in (folder, other):
        with Viewer(open_source(path), port) as server:
            threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
            port = server.server_port
            browser.goto(server.url)
            browser.wait(LOADED)
            pictures(browser, 0, "rgb", 0)
            browser.wait("document.querySelector('.row img').naturalWidth === 96")
            widths[path] = browser.run("document.querySelector('#cameras img').naturalWidth")
            browser.goto("about:blank")
            server.shutdown()
    assert list(widths.values()) == [64, 16]


def test_dark_and_narrow(page):
    page.dark()
    page.wait("getComputedStyle(document.body).backgroundColor === 'rgb(20, 23, 27)'")
    page.dark(False)
    page.resize(420, 800)
    page.wait("document.querySelector('.plot canvas').clientWidth > 200")
    assert page.run("document.documentElement.scrollWidth") <= 420
    page.resize(1440, 900)
