"""``robocas assets``: look at asset packs, make new ones."""

from __future__ import annotations

from robocas_ms3.cli import assets_make, assets_show

DESCRIPTION = "Look at asset packs, and make new ones from scans and datasets. Without a command: list."
COMMANDS = {
    "list": assets_show.list_packs,
    "info": assets_show.info,
    "verify": assets_show.verify,
    "sheet": assets_show.sheet,
    "build": assets_make.build,
    "import-scans": assets_make.import_scans,
    "import-graspnet": assets_make.import_graspnet,
    "import-ycb": assets_make.import_ycb,
    "import-partnet": assets_make.import_partnet,
}
DEFAULT = "list"
