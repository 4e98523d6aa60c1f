"""Write requirements.lock: the versions that pip resolves today for every supported Python, merged with markers.

    python scripts/lock.py python3.10 python3.11 python3.12 python3.13

Needs Python 3.11 or newer. The lock omits CUDA packages that belong to one build of torch, so that it fits all builds.
It also omits requirements in ``IGNORED``, which are not used and have no build for a supported Python. Therefore the
lock is installed with ``pip install --no-deps``.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import tomllib
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
TORCH = "torch==2.13.0"
NUMPY = "numpy==2.2.6"  # the newest for Python 3.10 and LeRobot 0.6: all environments compute the same bits
OPENPI = "openpi-client==0.1.2"  # for tests of messages; not in the extra `dev` because it requires numpy < 2
NOT_INSTALLED = {"slurm", "ray", "lerobot-env"}  # extras that setup.sh does not install into .venv
OF_ONE_TORCH_BUILD = ("nvidia-c", "nvidia-n", "cuda-", "triton")
IGNORED = {
    "mani-skill": {"mplib"},  # ==0.1.1 has no wheel for Python 3.13 and is not used
    "openpi-client": {"numpy"},  # < 2: its code works with numpy 2
}
HEADER = """\
# Exact versions, written by scripts/lock.py, not by hand. Install with `pip install --no-deps -r requirements.lock`
# after torch: mani_skill pins mplib 0.1.1, which this project does not use and which has no wheel for Python 3.13.
"""


def project_requirements() -> list[str]:
    """Return the requirements of pyproject.toml with the extras that setup.sh installs, torch at its pinned version."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    found = [*project["build-system"]["requires"], *project["project"]["dependencies"], TORCH, NUMPY, OPENPI]
    for name, extra in project["project"]["optional-dependencies"].items():
        if name not in NOT_INSTALLED:
            found += [item for item in extra if not item.startswith("robocas-ms3")]
    return found


def pip_report(interpreter: str, *arguments: str) -> dict:
    """Return pip's JSON report of the packages that it would install for an interpreter."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [sys.executable, "-m", "pip", "--python", interpreter, "install", "--quiet", "--dry-run"]
        subprocess.run(
            [*command, "--ignore-installed", "--only-binary=:all:", "--report", str(report), *arguments], check=True
        )
        return json.loads(report.read_text(encoding="utf-8"))


def resolve(interpreter: str) -> tuple[str, dict[str, str]]:
    """Return the Python version ("3.11") and {package: version} of everything to install."""
    wanted, packages = [], {}
    for requirement in project_requirements():
        name = canonicalize_name(Requirement(requirement).name)
        if name not in IGNORED:
            wanted.append(requirement)
            continue
        (item,) = pip_report(interpreter, "--no-deps", requirement)["install"]
        packages[name] = item["metadata"]["version"]
        needs = [Requirement(line) for line in item["metadata"].get("requires_dist", [])]
        wanted += [
            str(need)
            for need in needs
            if canonicalize_name(need.name) not in IGNORED[name] and "extra" not in str(need.marker or "")
        ]
    report = pip_report(interpreter, *wanted)
    for item in report["install"]:
        name = canonicalize_name(item["metadata"]["name"])
        if not name.startswith(OF_ONE_TORCH_BUILD):
            packages[name] = item["metadata"]["version"].split("+")[0]
    return report["environment"]["python_version"], packages


def merge(by_python: dict[str, dict[str, str]]) -> str:
    """Return the lines of the lock file: one per package, or one per version with a Python marker."""
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
