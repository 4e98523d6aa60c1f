"""Pytest plugin: ``PYTHONPATH=tests/support python -m pytest -p gpu_emulation.plugin -m gpu tests/gpu``."""

from __future__ import annotations

from typing import Any

import gpu_emulation


def pytest_addoption(parser: Any) -> None:
    parser.addoption("--emulated-envs", type=int, default=4, help="number of envs on the emulated GPU interface")


def pytest_configure(config: Any) -> None:
    gpu_emulation.install(config.getoption("--emulated-envs"))
