"""Shipped configurations resolve to the values they had when each file was complete."""

import hashlib
import json
from pathlib import Path

import pytest

from robocas_ms3.config import load_task_config, shipped_configs

HASHES = json.loads((Path(__file__).parent / "resolved.json").read_text(encoding="utf-8"))
"""Name -> sha256 of the JSON of the resolved model; the order of keys counts, since furniture is built in it."""


def test_each_shipped_configuration_has_a_hash():
    assert HASHES.keys() == shipped_configs().keys()


@pytest.mark.parametrize("name", sorted(HASHES))
def test_the_resolved_configuration_is_unchanged(name):
    text = load_task_config(name).model_dump_json()
    assert hashlib.sha256(text.encode()).hexdigest() == HASHES[name]
