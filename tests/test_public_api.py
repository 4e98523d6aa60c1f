"""The public API: what users import from `robocas_ms3` and from four of its packages."""

import ast
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PUBLIC = {
    "robocas_ms3": [
        "AssetError",
        "ConfigError",
        "DatasetError",
        "EmptySplitError",
        "EvaluationError",
        "ExtensionError",
        "IncompleteDatasetError",
        "LayoutError",
        "MissingExtraError",
        "OutputExistsError",
        "PlanError",
        "PlanningError",
        "PolicyError",
        "RobocasError",
        "SimulationError",
        "TrainingError",
        "VectorEnvError",
        "make_vec",
        "rl_kwargs",
    ],
    "robocas_ms3.baselines": [
        "Baseline",
        "BaselineConfig",
        "ProgressCallbacks",
        "RunOptions",
        "RunPolicy",
        "RunRecord",
        "Samples",
        "TrainSettings",
        "find_baseline",
        "read_run",
        "train_run",
    ],
    "robocas_ms3.datasets": [
        "ActionScale",
        "CandidateDataset",
        "CandidateImages",
        "CandidateOptions",
        "ConversionResult",
        "ConversionSettings",
        "Dataset",
        "EpisodeSource",
        "Format",
        "ImageOptions",
        "LeRobotDataset",
        "RoboCASDataset",
        "SampleOptions",
        "SourceEpisode",
        "ValidationReport",
        "Violation",
        "WrittenEpisode",
        "convert",
        "convert_lerobot",
        "open_source",
        "to_joint_positions",
        "validate",
    ],
    "robocas_ms3.demos": [
        "CandidateFile",
        "EpisodeSettings",
        "GenerateSettings",
        "ReplayResult",
        "ReplaySettings",
        "Summary",
        "TrajectoryFile",
        "generate",
        "merge_candidates",
        "replay",
    ],
    "robocas_ms3.evaluation": [
        "EpisodeSpec",
        "EvaluationSession",
        "EvaluationSettings",
        "LoadedProtocol",
        "Observations",
        "Outcome",
        "Policy",
        "PolicyServer",
        "PolicySpec",
        "RemotePolicy",
        "Result",
        "load_protocol",
        "make_policy",
        "open_policy",
        "read_result",
        "write_report",
    ],
}
PACKAGES = {name: package for package, names in PUBLIC.items() for name in names}
NEEDED_EXTRAS = {  # by module that has to be installed
    "av": ("LeRobotDataset", "convert_lerobot"),
    "safetensors": ("RunPolicy",),
    "websockets": ("PolicyServer", "RemotePolicy"),
}


@pytest.mark.parametrize("package", PUBLIC)
def test_package_exports_the_listed_names(package):
    assert import_module(package).__all__ == PUBLIC[package]


@pytest.mark.parametrize("package", PUBLIC)
def test_public_names_exist_and_have_a_docstring(package):
    module = import_module(package)
    for name in PUBLIC[package]:
        for extra, names in NEEDED_EXTRAS.items():
            if name in names:
                pytest.importorskip(extra)
        value = getattr(module, name)
        assert value.__doc__, f"{package}.{name}"
        assert not value.__doc__.startswith(f"{name}("), f"{package}.{name}: only the docstring of a dataclass"
        assert name in dir(module)


@pytest.mark.parametrize("package", PUBLIC)
def test_type_checkers_see_the_same_names(package):
    tree = ast.parse((ROOT / package.replace(".", "/") / "__init__.py").read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    imported = {(node.module, alias.asname) for node in block.body for alias in node.names}
    (table,) = [node for node in ast.walk(tree) if isinstance(node, ast.Dict)]
    exports = ast.literal_eval(table)
    assert imported == {(module, name) for module, names in exports.items() for name in names}


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="datasets.*no_such_name"):
        import_module("robocas_ms3.datasets").no_such_name  # noqa: B018


def test_packages_import_no_simulator():
    packages = ", ".join(PUBLIC)
    code = f"import sys, {packages}; print({{'sapien', 'mani_skill', 'torch', 'tyro'}} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def python_code() -> list[tuple[str, str]]:
    """Return (name, text) of the examples and of the Python code in the docs."""
    files = [*(ROOT / "examples").rglob("*.py"), *(ROOT / "lerobot_env_robocas").rglob("*.py")]
    found = [(str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")) for path in files]
    for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        blocks = re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
        found += [(page.name, block) for block in blocks]
    return found


def test_examples_and_docs_import_public_names_from_their_package():
    wrong = [
        (name, f"from {module} import {imported}", PACKAGES[imported])
        for name, text in python_code()
        for module, line in re.findall(r"^\s*from (robocas_ms3[\w.]*) import (.+)$", text, re.MULTILINE)
        for imported in re.findall(r"\w+", line)
        if imported in PACKAGES and module.startswith(f"{PACKAGES[imported]}.")
    ]
    assert wrong == []


def test_docs_name_public_classes_by_their_package():
    paths = [
        (page.name, *match)
        for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
        for match in re.findall(r"\b(robocas_ms3(?:\.\w+)*)\.([A-Z]\w+)", page.read_text(encoding="utf-8"))
    ]
    wrong = [path for path in paths if path[2] in PACKAGES and path[1].startswith(f"{PACKAGES[path[2]]}.")]
    assert wrong == []
