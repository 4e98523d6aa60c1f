"""A page of a headless Chromium, driven by Playwright."""

import os
import shutil
import time
from contextlib import contextmanager

import pytest
from playwright.sync_api import sync_playwright

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def require_chromium():
    """Return the program: $ROBOCAS_CHROMIUM, or an installed one. Without one, skip the test, or fail it on CI."""
    program = os.environ.get("ROBOCAS_CHROMIUM") or next((path for path in map(shutil.which, NAMES) if path), None)
    if program is not None:
        return program
    missing = "no Chromium: scripts/setup.sh installs Debian's, or set ROBOCAS_CHROMIUM"
    if os.environ.get("CI", "").lower() in ("", "0", "false"):
        pytest.skip(missing)
    pytest.fail(missing, pytrace=False)


@contextmanager
def open_page():
    """Open a page with the attribute ``errors``: errors of scripts and requests."""
    with sync_playwright() as playwright:
        # root in a container needs --no-sandbox; only our own pages are opened
        browser = playwright.chromium.launch(executable_path=require_chromium(), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        page.set_default_timeout(60_000)
        page.errors = []
        page.on("pageerror", lambda error: page.errors.append(str(error)))
        page.on(
            "console",
            lambda line: page.errors.append(f"{line.text} {line.location['url']}") if line.type == "error" else None,
        )
        yield page
        browser.close()


def check_layout(page, url, width, dark):
    """Check that a page has no errors, no horizontal overflow, and the colours of the light or dark scheme."""
    page.set_viewport_size({"width": width, "height": 900})
    page.emulate_media(color_scheme="dark" if dark else "light")
    page.goto(url)
    assert page.errors == []
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    paper, ink = page.evaluate("(s => [s.backgroundColor, s.color])(getComputedStyle(document.body))")
    assert (paper == "rgb(20, 23, 27)") == dark
    assert paper != ink


def wait(page, expression):
    """Wait until an expression is true. Playwright's function evaluates text in the page, which the CSP forbids."""
    end = time.monotonic() + 60
    while not page.evaluate(expression):
        assert time.monotonic() < end, f"never true: {expression}; errors: {page.errors}"
        page.wait_for_timeout(20)
