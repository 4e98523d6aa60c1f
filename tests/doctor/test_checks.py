import signal
from importlib import metadata

import pytest
from packaging.requirements import Requirement

from robocas_ms3.doctor import checks

CRASH = f"crashed ({signal.strsignal(signal.SIGSEGV)})"


@pytest.mark.parametrize(
    ("source", "required", "status", "found"),
    [
        ("import os; os.kill(os.getpid(), 11)", True, "fail", CRASH),
        ("import os; os.kill(os.getpid(), 11)", False, "limited", CRASH),
        ("import time; time.sleep(30)", True, "fail", "no answer within 1.0 s"),
        (
            "sys.stderr.write('noise\\nValueError: no such device\\n'); sys.exit(1)",
            True,
            "fail",
            "ValueError: no such device",
        ),
        (f"sys.stderr.write('no GPU'); sys.exit({checks.ABSENT})", True, "ok", "not used: no GPU"),
    ],
)
def test_probe_that_crashes_hangs_fails_or_lacks_a_device(tmp_path, monkeypatch, source, required, status, found):
    (tmp_path / "probes.py").write_text(f"import sys; {source}")
    monkeypatch.setattr(checks, "PROBES", tmp_path / "probes.py")
    monkeypatch.setattr(checks, "PROBE_SECONDS", 1.0)
    finding = checks.run_probe("planner", "planner", fix="reinstall it", required=required)
    assert finding == checks.Finding("planner", status, found, "" if status == "ok" else "reinstall it")


def test_stdout_of_a_probe_is_its_line_only():
    found = checks.run_probe("physics on CPU", "physx_cpu", fix="reinstall it")
    assert found == checks.Finding("physics on CPU", "ok", "ok")


@pytest.mark.parametrize(
    ("requirement", "version", "status"),
    [
        ("numpy>=1.26", "1.26.4", "ok"),
        ("numpy>=1.26", "1.25.0", "fail"),
        ("torch==2.13.0", "2.13.0+cpu", "ok"),
        ("mani_skill>=3.0.1,<3.1", None, "fail"),
    ],
)
def test_versions_of_packages(monkeypatch, requirement, version, status):
    def find(name):
        if version is None:
            raise metadata.PackageNotFoundError(name)
        return version

    monkeypatch.setattr(metadata, "version", find)
    found = checks.check_package(Requirement(requirement))
    assert found.status == status
    if status == "fail":
        assert found.fix.startswith(f"pip install '{requirement[:5]}")
    if version is None:
        assert checks.check_extra("language").status == "limited"


def test_requirements_are_those_of_the_metadata():
    names = {item.name for item in checks.list_requirements("robocas-ms3")}
    assert {"numpy", "mani-skill", "sapien", "torch"} <= names
    assert "pytest" not in names
    assert {item.name for item in checks.list_requirements("robocas-ms3", "language")} == {"sentence-transformers"}
    assert list(checks.list_requirements("no-such-distribution")) == []


def test_missing_distribution_is_one_finding(monkeypatch):
    monkeypatch.setattr(checks, "DISTRIBUTION", "no-such-distribution")
    (found,) = checks.check_packages()
    assert found.status == "fail"


def test_python_versions(monkeypatch):
    for version, status in (("3.9.7", "fail"), ("3.10.0", "ok"), ("3.13.1", "ok"), ("3.14.0", "fail")):
        monkeypatch.setattr(checks.platform, "python_version", lambda version=version: version)
        assert checks.check_python()[0].status == status


def test_folders_that_are_not_writable(tmp_path, monkeypatch):
    file = tmp_path / "file"
    file.touch()
    monkeypatch.setenv("ROBOCAS_CACHE", str(file / "cache"))
    monkeypatch.setenv("ROBOCAS_DATA", str(file / "data"))
    cache, data = checks.check_folders()
    assert (cache.status, data.status) == ("fail", "limited")
    assert "ROBOCAS_CACHE" in cache.fix
    monkeypatch.setenv("ROBOCAS_CACHE", str(tmp_path / "a" / "b"))
    assert checks.check_folders()[0].status == "ok"
    assert not (tmp_path / "a").exists()


def test_temporary_cache_folder_is_limited(tmp_path, monkeypatch):
    monkeypatch.delenv("ROBOCAS_CACHE", raising=False)
    monkeypatch.setattr(checks.paths, "cache_dir", lambda: tmp_path)
    monkeypatch.setattr(checks.paths, "make_temporary_cache", lambda: tmp_path)
    cache = checks.check_folders()[0]
    assert cache.status == "limited"
    assert "ROBOCAS_CACHE" in cache.fix


@pytest.mark.parametrize(("free", "status"), [(50e9, "ok"), (5e9, "limited"), (0.5e9, "fail")])
def test_disk(tmp_path, monkeypatch, free, status):
    usage = checks.shutil.disk_usage(tmp_path)._replace(free=int(free))
    monkeypatch.setattr(checks.shutil, "disk_usage", lambda folder: usage)
    assert checks.check_disk(tmp_path).status == status


def test_check_that_raises_is_a_finding(monkeypatch):
    def check_sky(folder):
        raise RuntimeError("fell down")

    monkeypatch.setattr(checks, "run_probe", lambda name, *_, **__: checks.Finding(name, "ok", ""))
    monkeypatch.setattr(checks, "check_disk", check_sky)
    *_, found = checks.run_checks()
    assert (found.status, found.found) == ("fail", "RuntimeError: fell down")
