"""Files that were whole, damaged in ways that follow from a seed."""

from __future__ import annotations

import copy
import json
import random
from collections.abc import Iterator
from typing import Any

NUMBERS = [-1, 0, 2**62, 2**63, 10**400, -1.5, 1e308, -1e308, 5e-324, float("nan"), float("inf")]
TEXTS = ["", "x", "../up", "/etc/passwd", "a:b", "\x00", "\x1b[31m", "1", "{0.__class__}"]
SCALARS = [None, True, *NUMBERS, *TEXTS]
VALUES = [*SCALARS, [], [[]], {}, {"x": 1}, [None], json.loads("[" * 150 + "]" * 150)]


def flipped(whole: bytes, seed: int) -> bytes:
    """Some bytes are others, or the end is missing."""
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


def twisted(whole: Any, seed: int) -> Any:
    """A value of JSON is another one, or missing, or there once more under another key."""
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
