"""Builtin furniture: every piece has a maker that gives the source its files are built from."""

from collections.abc import Callable

from asset_tools.builtin.furniture.cabinets import cabinet, container
from asset_tools.builtin.furniture.refrigerator import refrigerator
from asset_tools.builtin.furniture.room import room
from asset_tools.builtin.furniture.shelf import shelf
from asset_tools.builtin.furniture.tables import dining_table, side_table, table
from asset_tools.builtin.furniture.tableware import basket, plate
from asset_tools.sources import FurnitureSource

MAKERS: dict[str, Callable[[], FurnitureSource]] = {
    maker.__name__: maker
    for maker in (
        table,
        dining_table,
        side_table,
        shelf,
        cabinet,
        container,
        refrigerator,
        basket,
        plate,
        room,
    )
}
