"""The checks of ``robocas doctor``.

They import nothing that may be broken: versions are read from metadata, everything else runs in a child process
(``probes.py``), so that a crash is a finding.
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
LEAST_DISK, ENOUGH_DISK = 1.0, 10.0  # GB; a converted episode of pick takes about 0.1

# Purpose of each extra. lerobot-env, slurm and ray are left out: setup.sh does not install them into the environment of
# the package, where lerobot-env would replace torch and numpy.
EXTRAS = {
    "language": "sentence embeddings in datasets, and language-conditioned policies",
    "train": "training baselines and running the trained policies",
    "lerobot": "LeRobot datasets",
    "assets": "making asset packs",
    "remote": "policies over a socket",
    "plots": "plots of robocas stats",
}
# Packages with a row of their own; the others share one.
NAMED = ("numpy", "torch", "mani-skill", "sapien", "python-fcl", "gymnasium")

RENDERER_FIX = (
    "Install a Vulkan driver: the GPU's own, or Mesa >= 24.3 (mesa-vulkan-drivers and libvulkan1; in a checkout, as "
    "root: bash scripts/setup.sh). Without one everything runs state-only."
)

GPU_PHYSICS_FIX = (
    "Check the GPU's driver. SAPIEN downloads PhysX's library for GPUs once; offline, copy ~/.sapien/physx/ from "
    "another machine."
)


@dataclass(frozen=True)
class Finding:
    """Result of a check."""

    name: str  # of the thing that was checked
    status: Literal["ok", "limited", "fail"]  # limited: something optional does not work
    found: str  # version, device or reason
    fix: str = ""


def examine() -> list[Finding]:
    """Run every check, in the order of the report."""
    checks: list[Callable[[], list[Finding]]] = [
        check_python,
        check_packages,
        lambda: [check_extra(extra) for extra in EXTRAS],
        lambda: [probe("render device", "render", required=False, fix=RENDERER_FIX)],
        lambda: [probe("physics on CPU", "physx_cpu", fix=_reinstall("sapien"))],
        lambda: [probe("physics on GPU", "physx_cuda", required=False, fix=GPU_PHYSICS_FIX)],
        lambda: [probe("planner", "planner", fix="Fix the failing rows above first, then " + _reinstall("python-fcl"))],
        lambda: [probe("asset packs", "packs", fix="Restore the named pack, or remove its folder.")],
        check_folders,
        lambda: [check_disk(Path.cwd())],
    ]
    with ThreadPoolExecutor(max_workers=2) as pool:
        return [finding for found in pool.map(_guarded, checks) for finding in found]


def check_python() -> list[Finding]:
    try:
        supported = SpecifierSet(metadata.metadata(DISTRIBUTION)["Requires-Python"])
    except metadata.PackageNotFoundError:
        supported = SpecifierSet()
    if supported.contains(platform.python_version(), prereleases=True):
        return [Finding("python", "ok", platform.python_version())]
    return [Finding("python", "fail", platform.python_version(), f"Use Python {supported}.")]


def check_packages() -> list[Finding]:
    wanted = {_key(item.name): item for item in requirements(DISTRIBUTION)}
    if not wanted:
        return [Finding(DISTRIBUTION, "fail", "not installed", "Run bash scripts/setup.sh, or pip install -e .")]
    named = [check_package(wanted.pop(name)) for name in NAMED if name in wanted]
    rest = [check_package(item) for item in wanted.values()]
    bad = [finding for finding in rest if finding.status != "ok"]
    return named + (bad or [Finding("other packages", "ok", f"{len(rest)} as required")])


def check_package(wanted: Requirement) -> Finding:
    """Check that a package is installed in a supported version."""
    name = _key(wanted.name)
    fix = f"pip install '{wanted.name}{wanted.specifier}'"
    try:
        found = metadata.version(wanted.name)
    except metadata.PackageNotFoundError:
        return Finding(name, "fail", "not installed", fix)
    # torch 2.13.0+cpu is torch 2.13.0
    if not wanted.specifier.contains(Version(found).public, prereleases=True):
        return Finding(name, "fail", f"{found}, needs {wanted.specifier}", fix)
    return Finding(name, "ok", found)


def check_extra(extra: str) -> Finding:
    """Check that the packages of an extra are installed; they are optional."""
    findings = [check_package(item) for item in requirements(DISTRIBUTION, extra)]
    name, bad = f"extra {extra}", [finding for finding in findings if finding.status != "ok"]
    if not findings or bad:
        found = ", ".join(f"{finding.name} {finding.found}" for finding in bad) or "not installed"
        return Finding(name, "limited", found, f"For {EXTRAS[extra]}: pip install -e '.[{extra}]' in the clone")
    return Finding(name, "ok", ", ".join(f"{finding.name} {finding.found}" for finding in findings))


def check_folders() -> list[Finding]:
    """Check that the folders of caches (required: files of the robot) and of imported packs (optional) are writable."""
    cache = check_writable("cache folder", paths.cache_dir(), paths.CACHE, required=True)
    if cache.status == "ok" and not os.environ.get(paths.CACHE) and paths.cache_dir() == paths.temporary_cache():
        found = f"{cache.found}: the cache folder of the user is not writable"
        cache = Finding(cache.name, "limited", found, f"Set ${paths.CACHE} to a permanent folder.")
    return [cache, check_writable("data folder", paths.data_dir(), paths.DATA, required=False)]


def check_writable(name: str, folder: Path, variable: str, *, required: bool) -> Finding:
    """Check that a file can be created in a folder, or in its nearest parent that exists."""
    existing = next((parent for parent in (folder, *folder.parents) if parent.exists()), Path("/"))
    try:
        with tempfile.TemporaryDirectory(dir=existing):
            return Finding(name, "ok", str(folder))
    except OSError as error:
        found = f"{folder}: can't be written ({error.strerror})"
        fix = f"Set ${variable} to a folder that can be written to."
        return Finding(name, "fail" if required else "limited", found, fix)


def check_disk(folder: Path) -> Finding:
    free = shutil.disk_usage(folder).free / GIGABYTE
    found = f"{free:.1f} GB free in {folder}"
    if free < LEAST_DISK:
        return Finding("disk", "fail", found, "Free some space.")
    if free < ENOUGH_DISK:
        return Finding("disk", "limited", found, "Converted datasets take about 0.1 GB an episode.")
    return Finding("disk", "ok", found)


def probe(name: str, trial: str, *, fix: str, required: bool = True) -> Finding:
    """Run a probe, one of `probes.PROBES`, in a child process; ``limited`` if it fails and is not required."""
    bad: Literal["fail", "limited"] = "fail" if required else "limited"
    try:
        done = subprocess.run(
            [sys.executable, str(PROBES), trial], capture_output=True, text=True, timeout=PROBE_SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        return Finding(name, bad, f"no answer within {PROBE_SECONDS} s", fix)
    if done.returncode == 0:
        return Finding(name, "ok", done.stdout.strip())
    said = done.stderr.strip().splitlines()
    if done.returncode == ABSENT:
        return Finding(name, "ok", f"not used: {said[-1] if said else 'absent'}")
    if done.returncode < 0:
        return Finding(name, bad, f"crashed ({signal.strsignal(-done.returncode) or -done.returncode})", fix)
    return Finding(name, bad, said[-1] if said else f"exit code {done.returncode}", fix)


def requirements(distribution: str, extra: str = "") -> Iterator[Requirement]:
    """Yield the requirements of an installed distribution on this Python, or only what an extra adds."""
    try:
        lines = metadata.requires(distribution) or []
    except metadata.PackageNotFoundError:
        return
    for item in map(Requirement, lines):
        always = item.marker is None or item.marker.evaluate({"extra": ""})
        if always if not extra else not always and item.marker and item.marker.evaluate({"extra": extra}):
            yield item


def _guarded(check: Callable[[], list[Finding]]) -> list[Finding]:
    try:
        return check()
    except Exception as error:  # a check that breaks is a finding, not the end of the report
        name = getattr(check, "__name__", "check").removeprefix("check_")
        return [Finding(name, "fail", f"{type(error).__name__}: {error}", "Report this.")]


def _reinstall(package: str) -> str:
    return f"pip install --force-reinstall --no-deps {package}"


def _key(name: str) -> str:
    return name.lower().replace("_", "-")
