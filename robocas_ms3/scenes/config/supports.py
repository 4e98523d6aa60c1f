"""The words for what objects are on or in, which instructions have synonyms and a preposition for."""

from __future__ import annotations

SUPPORTS: tuple[str, ...] = (
    "cabinet",
    "cabinet top",
    "container",
    "container top",
    "dining table",
    "drawer",
    "plate",
    "refrigerator",
    "shelf",
    "side table",
    "table",
)
