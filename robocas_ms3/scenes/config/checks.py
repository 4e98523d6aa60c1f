"""What configurations of some tasks have to be; tasks name these functions as their ``checks``."""

from __future__ import annotations

from robocas_ms3.scenes.config.task import OrderlyLayout, TaskConfig


def has_basket(config: TaskConfig) -> None:
    """There is a basket.

    Raises:
        ValueError: there is none.
    """
    if config.basket is None:
        raise ValueError(f"task {config.task} needs a `basket`")


def has_copies(config: TaskConfig) -> None:
    """There are several objects of a kind, in rows.

    Raises:
        ValueError: there aren't.
    """
    if not (isinstance(config.layout, OrderlyLayout) and config.layout.copies > 1):
        raise ValueError(f"task {config.task} needs layout.kind orderly with layout.copies > 1")
