"""Make an annotation file with the links and joints of a model and example values."""

from __future__ import annotations

import json
import re
from pathlib import Path

from asset_tools.import_scans import make_object_id
from asset_tools.partnet.urdf import read_urdf

TEMPLATE = """\
# {id}.yaml. Replace the example values, and pass the folder of this file with --annotations. Units: m and rad.
# Frame: origin of the model, x out of the front, z up, all joints closed.
name: kitchen cabinet         # name in instructions
category: cabinet
origin_lift: 0.5              # height of the model's origin above its lowest point
# scale: 0.001                # metres per unit of the model, if not 1
surfaces:                     # surfaces on which objects can be placed
  top: {{min_xy: [-0.2, -0.4], max_xy: [0.2, 0.4], z: 0.5}}
{surfaces}handles:                      # pose of the TCP: z is the approach, y the closing direction (across the bar)
{handles}joints:                       # optional keys: mass, friction, damping, closed, limits, fixed
{joints}"""


def make_template(folder: Path) -> str:
    """Return the text of an annotation file with the links and joints of a model and example values.

    Args:
        folder: folder of the model.

    Raises:
        AssetError: the model cannot be read.
    """
    links = read_urdf(folder.resolve()).links
    drawer = "  {0}: {{link: {1}, min_xy: [-0.2, -0.4], max_xy: [0.2, 0.4], z: 0.1, headroom: 0.1}}\n"
    handle = "  {0}: {{joint: {1}, position: [0.3, 0, 0.2], wxyz: [0.5, 0.5, -0.5, -0.5], width: 0.012}}\n"
    joint = "  {0}: {{mass: 2.0, friction: 0.05, damping: 5.0}}  # {1}, moves {2}, {3:.3g} to {4:.3g}\n"
    fixed = "  {0}: {{fixed: true}}  # {1}, moves {2}, which has no mesh\n"
    ids = [make_object_id(link.name) for link in links]
    return TEMPLATE.format(
        id=folder.resolve().name,
        surfaces="".join(
            drawer.format(id_, _quoted(link.name))
            for id_, link in zip(ids, links, strict=True)
            if link.kind == "prismatic" and link.visuals
        ),
        handles="".join(
            handle.format(id_, _quoted(link.joint)) for id_, link in zip(ids, links, strict=True) if link.visuals
        ),
        joints="".join(
            (joint if link.visuals else fixed).format(_quoted(link.joint), link.kind, link.name, *link.limits)
            for link in links
        ),
    )


def _quoted(name: str) -> str:
    """Return a name as a YAML string, with quotes unless the name is a plain word."""
    return name if re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name) else json.dumps(name, ensure_ascii=False)
