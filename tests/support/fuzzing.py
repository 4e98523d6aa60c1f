"""Damage valid files in ways that depend on a seed."""

from __future__ import annotations

import copy
import io
import json
import random
from collections.abc import Iterator
from typing import Any

import numpy as np

NUMBERS = [-1, 0, 2**62, 2**63, 10**400, -1.5, 1e308, -1e308, 5e-324, float("nan"), float("inf")]
TEXTS = ["", "x", "../up", "/etc/passwd", "a:b", "\x00", "\x1b[31m", "1", "{0.__class__}"]
SCALARS = [None, True, *NUMBERS, *TEXTS]
VALUES = [*SCALARS, [], [[]], {}, {"x": 1}, [None], json.loads("[" * 150 + "]" * 150)]

ARRAYS = (np.zeros(0), np.array("x"), np.full((2, 4, 4), np.nan), np.array(2**63, np.uint64), np.array([True]), None)


def damage(name: str, whole: bytes, seed: int) -> bytes:
    """Return a damaged file: a changed JSON value, a changed array, endless brackets, or changed bytes."""
    if seed % 2 and name.endswith(".npz"):
        return change_array(whole, seed)
    if seed % 2 and name.endswith((".json", ".jsonl")):
        first, *others = whole.splitlines() if name.endswith("l") else [whole]
        return b"\n".join([json.dumps(change_value(json.loads(first), seed)).encode(), *others])
    return b"[" * 100_000 if seed == 0 and name.endswith(".json") else flip_bits(whole, seed)


def change_array(whole: bytes, seed: int) -> bytes:
    """Return an .npz file with one array replaced or removed."""
    rng = random.Random(seed)
    arrays = dict(np.load(io.BytesIO(whole)))
    name, value = rng.choice(list(arrays)), rng.choice(ARRAYS)
    if value is None:
        del arrays[name]
    else:
        arrays[name] = value
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def flip_bits(whole: bytes, seed: int) -> bytes:
    """Return data with some flip_bits bits, or without its end."""
    rng = random.Random(seed)
    data = bytearray(whole)
    for _ in range(rng.choice((1, 3, 30))):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(data[: rng.randrange(len(data))] if rng.random() < 0.2 else data)


def _places(node: Any, path: tuple = ()) -> Iterator[tuple]:
    children = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, child in children:
        yield (*path, key)
        yield from _places(child, (*path, key))


def change_value(whole: Any, seed: int) -> Any:
    """Return JSON data with one value changed, removed, or repeated under another key."""
    rng = random.Random(seed)
    data = copy.deepcopy(whole)
    *way, last = rng.choice(list(_places(data)))
    parent = data
    for key in way:
        parent = parent[key]
    how = rng.random()
    if how < 0.2:
        del parent[last]
    elif how < 0.3 and isinstance(parent, dict):
        parent["more"] = parent[last]
    else:
        parent[last] = copy.deepcopy(rng.choice(VALUES))
    return data
