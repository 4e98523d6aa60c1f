"""Words of messages."""

from __future__ import annotations


def count_of(count: int, noun: str) -> str:
    """``1 episode``, ``2 episodes``."""
    return f"{count} {noun}" + ("" if count == 1 else "s")


def called(asset_id: str, name: str = "") -> str:
    """What people read of an object: what instructions call it, and its id where that says something else.

    Args:
        asset_id: of its pack; empty: not known.
        name: in instructions; empty: not known.
    """
    plain = asset_id.replace("_", " ")
    return f"{name} ({plain})" if name and plain and name != plain else name or plain
