"""Tests of the code of the builtin pack; skipped if this code has not changed since the bundled pack was built.

``-m builtin_formulas`` runs them in any case.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from asset_tools.builtin.build import FORMULAS_HASH, NAME, compute_formulas_hash
from robocas_ms3.core.paths import builtin_packs_dir

FOLDER = Path(__file__).parent


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    ours = [item for item in items if FOLDER in item.path.parents]
    for item in ours:
        item.add_marker(pytest.mark.builtin_formulas)
    stored = builtin_packs_dir() / NAME / FORMULAS_HASH
    unchanged = stored.is_file() and stored.read_text().strip() == compute_formulas_hash()
    if unchanged and "builtin_formulas" not in (config.option.markexpr or ""):
        config.hook.pytest_deselected(items=ours)
        items[:] = [item for item in items if item not in ours]
