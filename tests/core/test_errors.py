"""Optional dependencies that are missing, or installed but broken."""

from __future__ import annotations

import pytest

from robocas_ms3.core.errors import MissingExtraError, require_extra


def test_a_missing_module_names_the_extra():
    with pytest.raises(MissingExtraError) as caught:
        require_extra("plots", "statistics", "json", "no_such_module")
    assert ".[plots]" in caught.value.fix


@pytest.mark.parametrize("line", ["import no_such_library", "raise OSError('libfoo.so:\\nwrong version')", "1 / 0"])
def test_a_module_that_cannot_be_imported_is_one_error_with_a_fix(tmp_path, monkeypatch, line):
    (tmp_path / "broken_module.py").write_text(line)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingExtraError) as caught:
        require_extra("plots", "statistics", "json", "broken_module")
    assert "broken_module" in caught.value.fix
    assert "\n" not in str(caught.value)
    require_extra("plots", "statistics", "broken_module", load=False)
