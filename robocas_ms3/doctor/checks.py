"""The checks of ``robocas doctor``.

The checks import no package that may be damaged. They read versions from metadata, and run everything else in a child
process (``probes.py``), so that a crash becomes a finding.
"""

from __future__ import annotations

import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.version import Version

from robocas_ms3.core import paths
from robocas_ms3.doctor.probes import ABSENT

DISTRIBUTION = "robocas-ms3"
PROBE_SECONDS = 120
PROBES = Path(__file__).with_name("probes.py")
GIGABYTE = 1e9
MIN_DISK_GB, RECOMMENDED_DISK_GB = 1.0, 10.0  # a converted episode of pick takes about 0.1 GB

# Purpose of each extra, without lerobot-env, slurm and ray: setup.sh does not install these.
EXTRAS = {
    "language": "sentence embeddings in datasets and language-conditioned policies",
    "train": "training baselines and evaluating them",
    "lerobot": "LeRobot datasets",
    "assets": "making asset packs",
    "remote": "policies over a socket",
    "plots": "plots of robocas stats and of robocas eval clutter-scale",
    "clutter-scale": "the clutter scale (robocas eval clutter-scale)",
}
# Packages with their own row; all others share one row.
PACKAGES_WITH_ROW = ("numpy", "torch", "mani-skill", "sapien", "python-fcl", "gymnasium")

RENDERER_FIX = (
    "Install a Vulkan driver: the driver of the GPU, or Mesa >= 24.3 (mesa-vulkan-drivers and libvulkan1; in a clone, "
    "as root: bash scripts/setup.sh). Without a driver nothing can be rendered."
)

GPU_PHYSICS_FIX = (
    "Check the driver of the GPU. SAPIEN downloads the GPU library of PhysX once; on a machine without internet, copy "
    "~/.sapien/physx/ from another machine."
)


@dataclass(frozen=True)
class Finding:
    """Result of a check: a row of the report."""

    name: str  # of the package, device or folder
    status: Literal["ok", "limited", "fail"]  # limited: an optional feature does not work
    found: str  # version, device or error
    fix: str = ""


def run_checks() -> list[Finding]:
    """Run all checks; return the findings in the order of the report."""
    checks: list[Callable[[], list[Finding]]] = [
        check_python,
        check_packages,
        lambda: [check_extra(extra) for extra in EXTRAS],
        lambda: [run_probe("render device", "render", required=False, fix=RENDERER_FIX)],
        lambda: [run_probe("physics on CPU", "physx_cpu", fix=_reinstall_command("sapien"))],
        lambda: [run_probe("physics on GPU", "physx_cuda", required=False, fix=GPU_PHYSICS_FIX)],
        lambda: [
            run_probe(
                "planner", "planner", fix="Fix the failing rows above first, then " + _reinstall_command("python-fcl")
            )
        ],
        lambda: [run_probe("asset packs", "packs", fix="Restore the pack, or delete its folder.")],
        check_folders,
        lambda: [check_disk(Path.cwd())],
    ]
    with ThreadPoolExecutor(max_workers=2) as pool:
        return [finding for found in pool.map(_run_check, checks) for finding in found]


def check_python() -> list[Finding]:
    """Check that the version of Python is supported."""
    try:
        supported = SpecifierSet(metadata.metadata(DISTRIBUTION)["Requires-Python"])
    except metadata.PackageNotFoundError:
        supported = SpecifierSet()
    if supported.contains(platform.python_version(), prereleases=True):
        return [Finding("python", "ok", platform.python_version())]
    return [Finding("python", "fail", platform.python_version(), f"Use Python {supported}.")]


def check_packages() -> list[Finding]:
    """Check the versions of the required packages."""
    required = {_normalise_name(item.name): item for item in list_requirements(DISTRIBUTION)}
    if not required:
        return [Finding(DISTRIBUTION, "fail", "not installed", "Run bash scripts/setup.sh, or pip install -e .")]
    named = [check_package(required.pop(name)) for name in PACKAGES_WITH_ROW if name in required]
    rest = [check_package(item) for item in required.values()]
    bad = [finding for finding in rest if finding.status != "ok"]
    return named + (bad or [Finding("other packages", "ok", f"{len(rest)} in supported versions")])


def check_package(requirement: Requirement) -> Finding:
    """Check that a package is installed in a supported version."""
    name = _normalise_name(requirement.name)
    fix = f"pip install '{requirement.name}{requirement.specifier}'"
    try:
        found = metadata.version(requirement.name)
    except metadata.PackageNotFoundError:
        return Finding(name, "fail", "not installed", fix)
    # the public version of torch 2.13.0+cpu is 2.13.0
    if not requirement.specifier.contains(Version(found).public, prereleases=True):
        return Finding(name, "fail", f"{found}, expected {requirement.specifier}", fix)
    return Finding(name, "ok", found)


def check_extra(extra: str) -> Finding:
    """Check that the packages of an optional extra are installed in supported versions."""
    findings = [check_package(item) for item in list_requirements(DISTRIBUTION, extra)]
    name, bad = f"extra {extra}", [finding for finding in findings if finding.status != "ok"]
    if not findings or bad:
        found = ", ".join(f"{finding.name} {finding.found}" for finding in bad) or "not installed"
        return Finding(name, "limited", found, f"For {EXTRAS[extra]}: pip install -e '.[{extra}]' in the clone")
    return Finding(name, "ok", ", ".join(f"{finding.name} {finding.found}" for finding in findings))


def check_folders() -> list[Finding]:
    """Check that the cache folder (required) and the folder of imported packs (optional) are writable."""
    cache = check_writable("cache folder", paths.cache_dir(), paths.CACHE, required=True)
    if cache.status == "ok" and not os.environ.get(paths.CACHE) and paths.cache_dir() == paths.make_temporary_cache():
        found = f"{cache.found} (temporary: the cache folder of the user is not writable)"
        cache = Finding(cache.name, "limited", found, f"Set ${paths.CACHE} to a permanent folder.")
    return [cache, check_writable("data folder", paths.data_dir(), paths.DATA, required=False)]


def check_writable(name: str, folder: Path, variable: str, *, required: bool) -> Finding:
    """Check that files can be created in a folder, or in its nearest existing parent.

    Args:
        name: name of the finding.
        folder: the folder.
        variable: environment variable that sets another folder, for the fix.
        required: whether a folder that is not writable is a failure.
    """
    existing = next((parent for parent in (folder, *folder.parents) if parent.exists()), Path("/"))
    try:
        with tempfile.TemporaryDirectory(dir=existing):
            return Finding(name, "ok", str(folder))
    except OSError as error:
        found = f"{folder} is not writable ({error.strerror})"
        fix = f"Set ${variable} to a writable folder."
        return Finding(name, "fail" if required else "limited", found, fix)


def check_disk(folder: Path) -> Finding:
    """Check the free space of the disk that contains a folder."""
    free = shutil.disk_usage(folder).free / GIGABYTE
    found = f"{free:.1f} GB free in {folder}"
    if free < MIN_DISK_GB:
        return Finding("disk", "fail", found, "Free at least 1 GB.")
    if free < RECOMMENDED_DISK_GB:
        return Finding("disk", "limited", found, "A dataset takes about 0.1 GB per episode.")
    return Finding("disk", "ok", found)


def run_probe(name: str, probe: str, *, fix: str, required: bool = True) -> Finding:
    """Run one of `probes.PROBES` in a child process.

    Args:
        name: name of the finding.
        probe: key of `probes.PROBES`.
        fix: how to fix a failure.
        required: whether a failure has the status ``fail``; otherwise the status is ``limited``.
    """
    bad: Literal["fail", "limited"] = "fail" if required else "limited"
    try:
        done = subprocess.run(
            [sys.executable, str(PROBES), probe], capture_output=True, text=True, timeout=PROBE_SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        return Finding(name, bad, f"no answer within {PROBE_SECONDS} s", fix)
    if done.returncode == 0:
        return Finding(name, "ok", done.stdout.strip())
    error_lines = done.stderr.strip().splitlines()
    if done.returncode == ABSENT:
        return Finding(name, "ok", f"not used: {error_lines[-1] if error_lines else 'absent'}")
    if done.returncode < 0:
        return Finding(name, bad, f"crashed ({signal.strsignal(-done.returncode) or -done.returncode})", fix)
    return Finding(name, bad, error_lines[-1] if error_lines else f"exit status {done.returncode}", fix)


def list_requirements(distribution: str, extra: str = "") -> Iterator[Requirement]:
    """Yield the requirements of an installed distribution on this machine, or only those that an extra adds."""
    try:
        lines = metadata.requires(distribution) or []
    except metadata.PackageNotFoundError:
        return
    for item in map(Requirement, lines):
        always = item.marker is None or item.marker.evaluate({"extra": ""})
        if always if not extra else not always and item.marker and item.marker.evaluate({"extra": extra}):
            yield item


def _run_check(check: Callable[[], list[Finding]]) -> list[Finding]:
    try:
        return check()
    except Exception as error:  # a check with a bug is a finding
        name = getattr(check, "__name__", "check").removeprefix("check_")
        return [Finding(name, "fail", f"{type(error).__name__}: {error}", "Report this bug.")]


def _reinstall_command(package: str) -> str:
    return f"pip install --force-reinstall --no-deps {package}"


def _normalise_name(name: str) -> str:
    return name.lower().replace("_", "-")
