"""Make the furniture of the builtin pack: one function per piece returns its source."""

from collections.abc import Callable

from asset_tools.builtin.furniture.cabinets import make_cabinet, make_container
from asset_tools.builtin.furniture.refrigerator import make_refrigerator
from asset_tools.builtin.furniture.room import make_room
from asset_tools.builtin.furniture.shelf import make_shelf
from asset_tools.builtin.furniture.tables import make_dining_table, make_side_table, make_table
from asset_tools.builtin.furniture.tableware import make_basket, make_plate
from asset_tools.sources import FurnitureSource

MAKERS: dict[str, Callable[[], FurnitureSource]] = {
    maker.__name__.removeprefix("make_"): maker
    for maker in (
        make_table,
        make_dining_table,
        make_side_table,
        make_shelf,
        make_cabinet,
        make_container,
        make_refrigerator,
        make_basket,
        make_plate,
        make_room,
    )
}
