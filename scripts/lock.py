"""Write requirements.lock: what pip resolves today for every Python the project supports, merged with markers.

    python scripts/lock.py python3.10 python3.11 python3.12

Needs Python 3.11 itself. Packages that come with one build of torch only (CUDA libraries) stay out, so that the lock
suits every build.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import tomllib

ROOT = Path(__file__).resolve().parent.parent
TORCH = "torch==2.13.0"
NOT_INSTALLED = {"slurm", "ray"}  # extras that setup.sh leaves out
OF_ONE_TORCH_BUILD = ("nvidia-c", "nvidia-n", "cuda-", "triton")
HEADER = """\
# Exact versions for `pip install -c`; written by scripts/lock.py, not by hand.
# numpy stays below 2: mplib 0.1.1 dies with a segmentation fault under numpy 2.
"""


def requirements() -> list[str]:
    """Everything pyproject.toml asks for, all extras that setup.sh installs included, torch at its pinned version."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    found = [*project["build-system"]["requires"], *project["project"]["dependencies"], TORCH]
    for name, extra in project["project"]["optional-dependencies"].items():
        if name in NOT_INSTALLED:
            continue
        found += [item for item in extra if not item.startswith("robocas-ms3")]
    return found


def resolve(interpreter: str) -> tuple[str, dict[str, str]]:
    """Ask pip what it would install: the Python version ("3.11") and {package: version}."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        subprocess.run(
            [sys.executable, "-m", "pip", "--python", interpreter, "install", "--quiet", "--dry-run"]
            + ["--ignore-installed", "--only-binary=:all:", "--report", str(report), *requirements()],
            check=True,
        )
        data = json.loads(report.read_text(encoding="utf-8"))
    packages = {
        item["metadata"]["name"].lower().replace("_", "-"): item["metadata"]["version"].split("+")[0]
        for item in data["install"]
    }
    kept = {name: version for name, version in packages.items() if not name.startswith(OF_ONE_TORCH_BUILD)}
    return data["environment"]["python_version"], kept


def merge(by_python: dict[str, dict[str, str]]) -> str:
    """One line a package where all Pythons agree, else one a version, with a marker naming its Pythons."""
    lines = []
    for name in sorted({name for packages in by_python.values() for name in packages}):
        pythons: dict[str, list[str]] = {}
        for python, packages in by_python.items():
            if name in packages:
                pythons.setdefault(packages[name], []).append(python)
        for version, where in pythons.items():
            marker = "" if len(where) == len(by_python) else " or ".join(f'python_version == "{p}"' for p in where)
            lines.append(f"{name}=={version}" + (f" ; {marker}" if marker else ""))
    return HEADER + "\n".join(lines) + "\n"


if __name__ == "__main__":
    lock = merge(dict(resolve(interpreter) for interpreter in sys.argv[1:] or [sys.executable]))
    (ROOT / "requirements.lock").write_text(lock, encoding="utf-8")
