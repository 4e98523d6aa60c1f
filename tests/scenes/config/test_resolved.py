"""Shipped configurations resolve to the stored values.

`python tests/scenes/config/test_resolved.py` writes `resolved.json` again, after a change of a value that is intended.
"""

import hashlib
import json
from pathlib import Path

import pytest

from robocas_ms3.scenes.config import load_task_config, shipped_configs

STORED = Path(__file__).parent / "resolved.json"
HASHES = json.loads(STORED.read_text(encoding="utf-8"))
"""Name -> sha256 of the JSON of the resolved model; the order of keys counts, since furniture is built in it."""


def resolved_hash(name: str) -> str:
    return hashlib.sha256(load_task_config(name).model_dump_json().encode()).hexdigest()


def test_each_shipped_configuration_has_a_hash():
    assert HASHES.keys() == shipped_configs().keys()


@pytest.mark.parametrize("name", sorted(HASHES))
def test_the_resolved_configuration_is_unchanged(name):
    assert resolved_hash(name) == HASHES[name]


if __name__ == "__main__":
    hashes = {name: resolved_hash(name) for name in sorted(shipped_configs())}
    STORED.write_text(json.dumps(hashes, indent=1) + "\n", encoding="utf-8")
