import signal
from importlib import metadata

import pytest
from packaging.requirements import Requirement

from robocas_ms3.doctor import checks


@pytest.fixture
def trial(tmp_path, monkeypatch):
    """Replace the probes by a script."""

    def write(source: str) -> None:
        path = tmp_path / "trial.py"
        path.write_text(source)
        monkeypatch.setattr(checks, "PROBES", path)

    return write


def test_a_crash_is_a_finding(trial):
    trial("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    assert checks.probe("planner", "planner", fix="mend") == checks.Finding(
        "planner", "fail", f"crashed ({signal.strsignal(signal.SIGSEGV)})", "mend"
    )
    assert checks.probe("render device", "render", fix="mend", required=False).status == "limited"


def test_a_hang_is_a_finding(trial, monkeypatch):
    monkeypatch.setattr(checks, "PROBE_SECONDS", 0.2)
    trial("import time; time.sleep(30)")
    found = checks.probe("planner", "planner", fix="mend")
    assert found.status == "fail"
    assert "no answer" in found.found


def test_an_exception_is_its_last_line(trial):
    trial("import sys; sys.stderr.write('noise\\nValueError: no such device\\n'); sys.exit(1)")
    assert checks.probe("x", "x", fix="mend").found == "ValueError: no such device"


def test_what_the_machine_lacks_is_no_failure(trial):
    trial(f"import sys; sys.stderr.write('no GPU'); sys.exit({checks.ABSENT})")
    assert checks.probe("physics on GPU", "x", fix="mend") == checks.Finding("physics on GPU", "ok", "not used: no GPU")


def test_probes_answer_on_stdout_only():
    found = checks.probe("physics on CPU", "physx_cpu", fix="mend")
    assert found == checks.Finding("physics on CPU", "ok", "works")


@pytest.mark.parametrize(
    ("version", "status"), [("1.26.4", "ok"), ("2.0.0", "ok"), ("2.5.5", "ok"), ("1.25.0", "fail")]
)
def test_numpy_versions(monkeypatch, version, status):
    monkeypatch.setattr(metadata, "version", lambda name: version)
    found = checks.check_package(Requirement("numpy>=1.26"))
    assert found.status == status
    if status == "fail":
        assert version in found.found
        assert found.fix == "pip install 'numpy>=1.26'"


def test_a_local_build_of_torch_is_the_same_version(monkeypatch):
    monkeypatch.setattr(metadata, "version", lambda name: "2.13.0+cpu")
    assert checks.check_package(Requirement("torch==2.13.0")).status == "ok"


def test_a_missing_package(monkeypatch):
    def missing(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", missing)
    found = checks.check_package(Requirement("mani_skill>=3.0.1,<3.1"))
    assert (found.status, found.found) == ("fail", "not installed")
    assert "pip install 'mani_skill" in found.fix
    assert checks.check_extra("language").status == "limited"


def test_requirements_are_those_of_the_metadata():
    names = {item.name for item in checks.requirements("robocas-ms3")}
    assert {"numpy", "mani-skill", "sapien", "torch"} <= names
    assert "pytest" not in names
    assert {item.name for item in checks.requirements("robocas-ms3", "language")} == {"sentence-transformers"}
    assert list(checks.requirements("no-such-distribution")) == []


def test_a_package_that_is_not_installed_is_one_finding(monkeypatch):
    monkeypatch.setattr(checks, "DISTRIBUTION", "no-such-distribution")
    (found,) = checks.check_packages()
    assert found.status == "fail"


def test_python_versions(monkeypatch):
    for version, status in (("3.9.7", "fail"), ("3.10.0", "ok"), ("3.13.1", "ok"), ("3.14.0", "fail")):
        monkeypatch.setattr(checks.platform, "python_version", lambda version=version: version)
        assert checks.check_python()[0].status == status


def test_folders_that_can_not_be_written(tmp_path, monkeypatch):
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


def test_a_cache_among_temporary_files_is_said(tmp_path, monkeypatch):
    monkeypatch.delenv("ROBOCAS_CACHE", raising=False)
    monkeypatch.setattr(checks.paths, "cache_dir", lambda: tmp_path)
    monkeypatch.setattr(checks.paths, "temporary_cache", lambda: tmp_path)
    cache = checks.check_folders()[0]
    assert cache.status == "limited"
    assert "ROBOCAS_CACHE" in cache.fix


@pytest.mark.parametrize(("free", "status"), [(50e9, "ok"), (5e9, "limited"), (0.5e9, "fail")])
def test_disk(tmp_path, monkeypatch, free, status):
    usage = checks.shutil.disk_usage(tmp_path)._replace(free=int(free))
    monkeypatch.setattr(checks.shutil, "disk_usage", lambda folder: usage)
    assert checks.check_disk(tmp_path).status == status


def test_a_check_that_breaks_is_a_finding(monkeypatch):
    def check_sky(folder):
        raise RuntimeError("fell down")

    monkeypatch.setattr(checks, "probe", lambda name, *_, **__: checks.Finding(name, "ok", ""))
    monkeypatch.setattr(checks, "check_disk", check_sky)
    *_, found = checks.examine()
    assert (found.status, found.found) == ("fail", "RuntimeError: fell down")
