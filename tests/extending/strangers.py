"""Packages of strangers, installed from the code blocks of docs/extending.md."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

from forkserver import ForkServer

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")


def install(section: str, site: Path) -> Path:
    """Do with a section's package as pip does: its files and its metadata in a folder of packages."""
    text = PAGE.split(f"## {section}\n")[1].split("\n## ")[0]
    files = dict(re.findall(r"^```\w+\n# (\S+)\n(.*?)^```", text, re.DOTALL | re.MULTILINE))
    project = tomllib.loads(files.pop("pyproject.toml"))["project"]
    about = site / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    groups = project["entry-points"].items()
    lines = [f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in points.items()) for group, points in groups]
    (about / "entry_points.txt").write_text("\n".join(lines))
    for name, content in files.items():
        (site / name).parent.mkdir(exist_ok=True)
        (site / name).write_text(content)
    return site


@cache
def server(site: Path) -> ForkServer:
    """Python with a folder of packages."""
    return ForkServer(site, ROOT)


def python(site: Path, *words: object, cwd: Path | None = None) -> str:
    """Run Python with a folder of packages, and in a folder; what it says."""
    done = server(site).run(*words, cwd=cwd)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def fresh_python(site: Path, *words: object) -> str:
    """The same of one that has imported nothing."""
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(site), str(ROOT)])}
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, check=True, env=env).stdout


def robocas(site: Path, *words: object, cwd: Path | None = None) -> str:
    """Run the command line with a folder of packages, and in a folder; what it says."""
    return python(site, ROOT / "robocas_cli.py", *words, cwd=cwd)
