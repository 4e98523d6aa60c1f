"""An annotation to start from, with what a model says of itself."""

from __future__ import annotations

import json
import re
from pathlib import Path

from asset_tools.import_scans import object_id
from asset_tools.partnet.urdf import read_urdf

TEMPLATE = """\
# {id}.yaml: pass its folder with --annotations. m and rad; the model's origin, x out of the front, z up, joints closed.
name: kitchen cabinet         # for language
category: cabinet
origin_lift: 0.5              # height of the model's origin above its lowest point
# scale: 0.001                # metres of one unit of the model, where that is not 1
surfaces:                     # where objects may stand
  top: {{min_xy: [-0.2, -0.4], max_xy: [0.2, 0.4], z: 0.5}}
{surfaces}handles:                      # pose of the gripper's TCP: z approach, y closing (across the bar)
{handles}joints:                       # all optional: mass, friction, damping, closed, limits, fixed: true
{joints}"""


def make_template(folder: Path) -> str:
    """A YAML annotation of a model with its joints and links in place and numbers to be filled in.

    Args:
        folder: of the model.

    Raises:
        AssetError: the model can't be read.
    """
    links = read_urdf(folder.resolve()).links
    drawer = "  {0}: {{link: {1}, min_xy: [-0.2, -0.4], max_xy: [0.2, 0.4], z: 0.1, headroom: 0.1}}\n"
    handle = "  {0}: {{joint: {1}, position: [0.3, 0, 0.2], wxyz: [0.5, 0.5, -0.5, -0.5], width: 0.012}}\n"
    joint = "  {0}: {{mass: 2.0, friction: 0.05, damping: 5.0}}  # {1}, moves {2}, {3:.3g} to {4:.3g}\n"
    still = "  {0}: {{fixed: true}}  # {1}, moves {2}, which has no mesh\n"
    ids = [object_id(link.name) for link in links]
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
            (joint if link.visuals else still).format(_quoted(link.joint), link.kind, link.name, *link.limits)
            for link in links
        ),
    )


def _quoted(name: str) -> str:
    """A name as YAML has it: in quotation marks unless it is a plain word."""
    return name if re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name) else json.dumps(name, ensure_ascii=False)
