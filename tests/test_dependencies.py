"""Imported packages are declared in pyproject.toml, so that a clean installation is complete."""

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
# Imported modules that are not declared, with the reason.
UNDECLARED = {
    "transformers": "a dependency of sentence-transformers",
    "lerobot": "only imported in the environment of LeRobot",
    "vla_eval": "only imported by vla-eval itself",
}


def declared(*extras: str) -> set[str]:
    """Return the normalised names of the requirements with these extras."""
    items = [Requirement(line) for line in metadata.requires("robocas-ms3") or []]
    return {
        item.name.lower().replace("_", "-")
        for item in items
        if item.marker is None or any(item.marker.evaluate({"extra": extra}) for extra in extras)
    }


def third_party(path: Path) -> set[str]:
    """Return the top-level modules that a file imports, without those of Python and of this project."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.partition(".")[0])
    return found - set(sys.stdlib_module_names) - {"robocas_ms3", "asset_tools"}


EXTRAS = {  # files that may import packages of an extra
    "robocas_ms3/baselines/": "train",
    "robocas_ms3/baselines/lerobot/": "lerobot",
    "robocas_ms3/scenes/language/": "language",
    "robocas_ms3/datasets/lerobot/": "lerobot",
    "robocas_ms3/datasets/statistics/figures.py": "plots",
    "robocas_ms3/evaluation/clutter_scale/": "clutter-scale",
    "robocas_ms3/evaluation/remote/": "remote",
    "robocas_ms3/evaluation/removal_questions/lerobot_dataset.py": "lerobot",
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
        for module in third_party(path) - UNDECLARED.keys():
            # a distribution of one compiled module does not list the module, which has its name
            names = {name.lower().replace("_", "-") for name in DISTRIBUTIONS.get(module, [module])}
            if not names & known:
                undeclared[module] = (str(path.relative_to(ROOT)), sorted(names))
    assert undeclared == {}


def test_installed_versions_are_the_locked_ones():
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
