"""What the code imports is what pyproject.toml declares; a clean installation lacks nothing."""

from __future__ import annotations

import ast
import os
import sys
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
DISTRIBUTIONS = metadata.packages_distributions()
# Import name -> who brings it, where that is not a declaration of ours.
BROUGHT = {
    "transformers": "sentence-transformers is made of it",
    "lerobot": "its own environment imports what imports it",
    "vla_eval": "only it uses the benchmark that imports it",
}


def declared(*extras: str) -> set[str]:
    """Normalised names of what an installation with these extras asks for."""
    items = [Requirement(line) for line in metadata.requires("robocas-ms3") or []]
    return {
        item.name.lower().replace("_", "-")
        for item in items
        if item.marker is None or any(item.marker.evaluate({"extra": extra}) for extra in extras)
    }


def third_party(path: Path) -> set[str]:
    """Top-level modules a file imports that are neither Python's nor this project's."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.partition(".")[0])
    return found - set(sys.stdlib_module_names) - {"robocas_ms3", "asset_tools"}


EXTRAS = {  # files that may import what an extra brings
    "robocas_ms3/baselines/": "train",
    "robocas_ms3/baselines/lerobot/": "lerobot",
    "robocas_ms3/scenes/language/": "language",
    "robocas_ms3/datasets/lerobot/": "lerobot",
    "robocas_ms3/datasets/statistics/plots.py": "plots",
    "robocas_ms3/evaluation/remote/": "remote",
    "robocas_ms3/evaluation/report/__init__.py": "lerobot",
    "robocas_ms3/plans/executors/ray": "ray",
    "robocas_ms3/plans/executors/slurm": "slurm",
    "asset_tools/": "assets",
}


@pytest.mark.parametrize("folder", ["robocas_ms3", "asset_tools", "examples"])
def test_imports_are_declared(folder):
    undeclared = {}
    for path in (ROOT / folder).rglob("*.py"):
        name = path.relative_to(ROOT).as_posix()
        known = declared(*(extra for start, extra in EXTRAS.items() if name.startswith(start)))
        for module in third_party(path) - BROUGHT.keys():
            # a distribution of one compiled module does not list it, and is called like it
            names = {name.lower().replace("_", "-") for name in DISTRIBUTIONS.get(module, [module])}
            if not names & known:
                undeclared[module] = (str(path.relative_to(ROOT)), sorted(names))
    assert undeclared == {}


def test_locked_versions_are_the_ones_installed():
    locked = {}
    for line in (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            item = Requirement(line)
            if item.marker is None or item.marker.evaluate():
                locked[item.name] = str(item.specifier).removeprefix("==")
    if os.environ.get("ROBOCAS_NUMPY"):
        locked["numpy"] = os.environ["ROBOCAS_NUMPY"]
    for name in declared():
        installed = metadata.version(name).partition("+")[0]
        assert locked[name] == installed, f"{name}: run scripts/setup.sh"
