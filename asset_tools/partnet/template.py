"""An annotation to start from, with what a model says of itself."""

from __future__ import annotations

from pathlib import Path

from asset_tools.partnet.urdf import read_urdf

TEMPLATE = """\
# {id}.yaml: pass its folder with --annotations. m and rad; the model's origin, x out of the front, z up, joints closed.
name: kitchen cabinet         # for language
category: cabinet
origin_lift: 0.5              # height of the model's origin above its lowest point
surfaces:                     # where objects may stand
  top: {{min_xy: [-0.2, -0.4], max_xy: [0.2, 0.4], z: 0.5}}
{surfaces}handles:                      # pose of the gripper's TCP: z approach, y closing (across the bar)
{handles}joints:                       # all optional: mass, friction, damping, closed, limits, fixed: true
{joints}"""


def template(folder: Path) -> str:
    """A YAML annotation of a model with its joints and links in place and numbers to be filled in.

    Args:
        folder: of the model.

    Raises:
        AssetError: the model can't be read.
    """
    links = read_urdf(folder).links
    drawer = "  {0}: {{link: {0}, min_xy: [-0.2, -0.4], max_xy: [0.2, 0.4], z: 0.1, headroom: 0.1}}\n"
    handle = "  {0}: {{joint: {1}, position: [0.3, 0, 0.2], wxyz: [0.5, 0.5, -0.5, -0.5], width: 0.012}}\n"
    joint = "  {0}: {{mass: 2.0, friction: 0.05, damping: 5.0}}  # {1}, moves {2}, {3:.3g} to {4:.3g}\n"
    return TEMPLATE.format(
        id=folder.resolve().name,
        surfaces="".join(drawer.format(link.name) for link in links if link.kind == "prismatic"),
        handles="".join(handle.format(link.name, link.joint) for link in links),
        joints="".join(joint.format(link.joint, link.kind, link.name, *link.limits) for link in links),
    )
