"""`robocas doctor` on this machine, and on a machine with damaged packages."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from robocas_ms3.cli.doctor import Doctor, main
from robocas_ms3.doctor.checks import Finding

ROOT = Path(__file__).resolve().parents[2]


def doctor(*words: str, **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, ROOT / "robocas_cli.py", "doctor", *words],
        capture_output=True,
        text=True,
        env=os.environ | environment,
        check=False,
    )


@pytest.mark.slow
def test_all_required_checks_pass_on_this_machine():
    done = doctor("--json")
    report = json.loads(done.stdout)
    assert [finding for finding in report["findings"] if finding["status"] == "fail"] == []
    assert report["ok"] is True
    assert done.returncode == 0
    names = [finding["name"] for finding in report["findings"]]
    assert {"python", "numpy", "render device", "planner", "asset packs", "cache folder", "disk"} <= set(names)


@pytest.fixture
def damaged_packages(tmp_path):
    """Return a folder for PYTHONPATH: numpy is too old, FCL crashes, mani_skill and sapien fail to import."""
    for name, version, source in (
        ("numpy", "1.20.0", "__version__ = '1.20.0'\n"),
        ("fcl", "0.7.0.11", "import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n"),
        ("mani_skill", "3.0.1", "raise ImportError('broken on purpose')\n"),
        ("sapien", "3.0.3", "raise ImportError('broken on purpose')\n"),
    ):
        package, info = tmp_path / name, tmp_path / f"{name}-{version}.dist-info"
        package.mkdir()
        info.mkdir()
        (package / "__init__.py").write_text(source)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    return tmp_path


@pytest.mark.slow
def test_damaged_packages_are_findings(damaged_packages):
    unwritable = str(damaged_packages / "numpy" / "__init__.py" / "x")
    done = doctor("--json", PYTHONPATH=str(damaged_packages), ROBOCAS_DATA=unwritable, ROBOCAS_CACHE=unwritable)
    findings = {finding["name"]: finding for finding in json.loads(done.stdout)["findings"]}
    assert done.returncode == 1
    assert findings["numpy"]["status"] == "fail"
    assert "pip install 'numpy" in findings["numpy"]["fix"]
    for name in ("physics on CPU", "planner", "asset packs", "cache folder"):
        assert findings[name]["status"] == "fail", name
    for name in ("render device", "data folder"):
        assert findings[name]["status"] == "limited", name
    assert findings["physics on CPU"]["found"] == "ImportError: broken on purpose"
    assert all(finding["fix"] for finding in findings.values() if finding["status"] != "ok")


def test_table_shows_the_fix(monkeypatch, capsys):
    findings = [Finding("python", "ok", "3.11"), Finding("numpy", "fail", "1.20.0", "pip install 'numpy>=1.26'")]
    monkeypatch.setattr("robocas_ms3.doctor.checks.run_checks", lambda: findings)
    assert main(Doctor()) == 1
    shown = capsys.readouterr().out
    assert "FAIL" in shown and "pip install 'numpy>=1.26'" in shown
