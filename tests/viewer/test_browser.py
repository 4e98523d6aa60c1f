"""Tests of the page never pass over in silence on CI."""

import pytest
from browser import require_chromium

OUTCOMES = (pytest.fail.Exception, pytest.skip.Exception)


@pytest.mark.parametrize(
    ("ci", "outcome"),
    [("true", "Failed"), ("1", "Failed"), ("yes", "Failed"), ("", "Skipped"), ("false", "Skipped"), (None, "Skipped")],
)
def test_without_a_browser(monkeypatch, tmp_path, ci, outcome):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("ROBOCAS_CHROMIUM", raising=False)
    if ci is None:
        monkeypatch.delenv("CI", raising=False)
    else:
        monkeypatch.setenv("CI", ci)
    with pytest.raises(OUTCOMES, match="scripts/setup.sh") as caught:
        require_chromium()
    assert type(caught.value).__name__ == outcome


def test_one_that_is_named(monkeypatch):
    monkeypatch.setenv("ROBOCAS_CHROMIUM", "/opt/chromium")
    assert require_chromium() == "/opt/chromium"
