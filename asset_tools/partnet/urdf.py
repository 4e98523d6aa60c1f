"""PartNet-Mobility's ``mobility.urdf``: which meshes hang on which joints, in one frame with every joint closed."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from robocas_ms3.errors import AssetError

Array = np.ndarray

URDF = "mobility.urdf"
# PartNet's URDFs look along -x; furniture here looks along +x, as upstream turns them
TURNED = np.diag([-1.0, -1.0, 1.0, 1.0])
KINDS: dict[str, Literal["prismatic", "revolute"]] = {
    "prismatic": "prismatic",
    "revolute": "revolute",
    "continuous": "revolute",
}


@dataclass(frozen=True)
class Visual:
    """A mesh of a link.

    Attributes:
        part: the part of the furniture it belongs to: ``drawer_side-23``.
        path: the mesh file.
        pose: 4x4 of it in the furniture's frame, joints closed.
    """

    part: str
    path: Path
    pose: Array


@dataclass(frozen=True)
class MovingLink:
    """A link that moves.

    Attributes:
        name: of the link.
        parent: of the moving link it hangs on; empty: the fixed body.
        joint: name of its joint.
        kind: of the joint.
        axis: (3,) unit vector, furniture's frame, joints closed.
        origin: (3,) point on the axis, m.
        limits: of the joint, 0 is closed.
        visuals: its meshes and those of links fixed to it.
    """

    name: str
    parent: str
    joint: str
    kind: Literal["prismatic", "revolute"]
    axis: Array
    origin: Array
    limits: tuple[float, float]
    visuals: list[Visual] = field(default_factory=list)


@dataclass(frozen=True)
class Mobility:
    """A model.

    Attributes:
        folder: where it was read from.
        body: meshes of the fixed body.
        links: moving parts, parents first.
        joints: names of all joints that could move.
    """

    folder: Path
    body: list[Visual]
    links: list[MovingLink]
    joints: frozenset[str]


@dataclass(frozen=True)
class _Joint:
    name: str
    kind: str
    parent: str
    child: str
    pose: Array
    axis: Array
    limits: tuple[float, float] | None


def read_urdf(
    folder: Path, *, closed: Mapping[str, float] | None = None, fixed: frozenset[str] = frozenset()
) -> Mobility:
    """Read a model's links and joints. Fixed joints are merged, and so are those that turn without limits (casters).

    Args:
        folder: of the model; holds ``mobility.urdf``.
        closed: position of joints by name at which they are closed, as the URDF counts; others at their lower limit.
        fixed: joints that are held closed.

    Raises:
        AssetError: no URDF, or one that can't be read; a mesh that is not there; a joint of an unknown type.
    """
    path = folder / URDF
    root = _parse(path)
    visuals = {_name(link, path): _visuals(link, folder) for link in root.findall("link")}
    joints = [_joint(element, path) for element in root.findall("joint")]
    below = {joint.child: joint for joint in joints}
    for joint in joints:
        if joint.parent not in visuals or joint.child not in visuals:
            raise AssetError(
                "a joint of unknown links", where=path, found=f"{joint.name}: {joint.parent} {joint.child}"
            )
    roots = [name for name in visuals if name not in below]
    if len(roots) != 1 or len(below) != len(joints):
        raise AssetError("the links are no tree", where=path, expected="one root", found=", ".join(roots) or "a loop")
    body: list[Visual] = []
    links: list[MovingLink] = []
    queue: list[tuple[str, Array, MovingLink | None]] = [(roots[0], TURNED, None)]
    while queue:
        name, pose, carrier = queue.pop(0)
        (carrier.visuals if carrier else body).extend(
            Visual(part, mesh, pose @ placed) for part, mesh, placed in visuals[name]
        )
        for joint in joints:
            if joint.parent != name:
                continue
            frame = pose @ joint.pose
            moves = joint.kind != "fixed" and joint.limits is not None and joint.name not in fixed
            if not moves:
                queue.append((joint.child, frame, carrier))
                continue
            assert joint.limits is not None
            zero = (closed or {}).get(joint.name, joint.limits[0])
            link = MovingLink(
                joint.child,
                carrier.name if carrier else "",
                joint.name,
                KINDS[joint.kind],
                frame[:3, :3] @ joint.axis,
                frame[:3, 3],
                (joint.limits[0] - zero, joint.limits[1] - zero),
            )
            links.append(link)
            queue.append((joint.child, frame @ _motion(joint, zero), link))
    for link in links:
        if not link.visuals:
            raise AssetError(
                "a moving link without a mesh", where=path, found=link.name, fix="Hold its joint: `fixed: true`."
            )
    return Mobility(folder, body, links, frozenset(joint.name for joint in joints if joint.kind != "fixed"))


def _parse(path: Path) -> ET.Element:
    if not path.is_file():
        raise AssetError(
            "no such file", where=path, expected="the folder of a PartNet-Mobility model", fix="Give its folder."
        )
    try:
        return ET.parse(path).getroot()
    except ET.ParseError as error:
        raise AssetError("the URDF can't be read", where=path, found=error) from error


def _name(element: ET.Element, path: Path) -> str:
    name = element.get("name")
    if not name:
        raise AssetError(f"a {element.tag} without a name", where=path)
    return name


def _visuals(link: ET.Element, folder: Path) -> list[tuple[str, Path, Array]]:
    found = []
    for index, visual in enumerate(link.findall("visual")):
        mesh = visual.find("geometry/mesh")
        if mesh is None:
            raise AssetError("only meshes can be read", where=folder / URDF, found=f"link {link.get('name')}")
        path = folder / mesh.get("filename", "")
        if not path.is_file():
            raise AssetError("this mesh of the model is missing", where=path, fix="Download the model again.")
        found.append((visual.get("name") or f"part-{index}", path, _pose(visual.find("origin"), folder / URDF)))
    return found


def _joint(element: ET.Element, path: Path) -> _Joint:
    name, kind = _name(element, path), element.get("type", "")
    if kind != "fixed" and kind not in KINDS:
        expected = ", ".join(["fixed", *KINDS])
        raise AssetError("a joint of an unknown type", where=path, expected=expected, found=f"{name}: {kind}")
    ends = [element.find(end) for end in ("parent", "child")]
    if any(end is None for end in ends):
        raise AssetError("a joint without parent or child", where=path, found=name)
    axis = element.find("axis")
    direction = _numbers(axis.get("xyz", "1 0 0") if axis is not None else "1 0 0", path)
    length = float(np.linalg.norm(direction))
    if length < 1e-9:
        raise AssetError("a joint with an axis of no length", where=path, found=name)
    limit, limits = element.find("limit"), None
    if limit is not None and kind in ("prismatic", "revolute"):
        low, high = (float(_numbers(limit.get(end, "0"), path, 1)[0]) for end in ("lower", "upper"))
        limits = (low, high)
        if not low < high:
            raise AssetError("a joint without a range", where=path, expected="lower < upper", found=f"{name}: {limits}")
    parent, child = (end.get("link", "") for end in ends if end is not None)
    return _Joint(name, kind, parent, child, _pose(element.find("origin"), path), direction / length, limits)


def _pose(origin: ET.Element | None, path: Path) -> Array:
    pose = np.eye(4)
    if origin is not None:
        pose[:3, :3] = Rotation.from_euler("xyz", _numbers(origin.get("rpy", "0 0 0"), path)).as_matrix()
        pose[:3, 3] = _numbers(origin.get("xyz", "0 0 0"), path)
    return pose


def _numbers(text: str, path: Path, count: int = 3) -> Array:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise AssetError("numbers that can't be read", where=path, expected=f"{count} numbers", found=repr(text))
    return values


def _motion(joint: _Joint, position: float) -> Array:
    motion = np.eye(4)
    if joint.kind == "prismatic":
        motion[:3, 3] = joint.axis * position
    else:
        motion[:3, :3] = Rotation.from_rotvec(joint.axis * position).as_matrix()
    return motion
