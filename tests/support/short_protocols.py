"""Copies of bundled protocols with short episodes, or only the first of them."""

import shutil
from pathlib import Path

import yaml

from robocas_ms3.evaluation.protocols.bundled_protocols import bundled_protocols
from robocas_ms3.evaluation.protocols.protocol import EPISODES, RULES


def shorten(name: str, folder: Path, max_steps: int, episodes: int | None = None) -> Path:
    shutil.copytree(bundled_protocols()[name], folder)
    rules = yaml.safe_load((folder / RULES).read_text())
    (folder / RULES).write_text(yaml.safe_dump(rules | {"max_steps": max_steps}))
    lines = (folder / EPISODES).read_text().splitlines(keepends=True)
    (folder / EPISODES).write_text("".join(lines[:episodes]))
    return folder
