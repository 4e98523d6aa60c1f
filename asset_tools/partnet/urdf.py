"""Read ``mobility.urdf`` of PartNet-Mobility: shapes and joints of all links in one frame."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal
from xml.parsers import expat

import numpy as np
from scipy.spatial.transform import Rotation

from asset_tools.partnet.annotation import LARGEST, JointAnnotation
from asset_tools.readers.files import read_file
from robocas_ms3.core.errors import AssetError
from robocas_ms3.core.strict_model import check_name

Array = np.ndarray

URDF = "mobility.urdf"
URDF_LIMIT = 16 * 2**20  # bytes; the largest of PartNet-Mobility has 1 MB
# the front of PartNet's URDFs is -x; here it is +x, as in RoboCAS-v0
TURNED = np.diag([-1.0, -1.0, 1.0, 1.0])
KINDS: dict[str, Literal["prismatic", "revolute"]] = {
    "prismatic": "prismatic",
    "revolute": "revolute",
    "continuous": "revolute",
}
SIZES = {"box": ("size", 3), "cylinder": ("radius length", 2), "sphere": ("radius", 1)}  # attributes, numbers
MOST_LINKS, MOST_SHAPES = 1000, 2000
MOST_MOVING = 60  # PhysX simulates articulations of at most 64 bodies
FAR = 1e6  # largest position, size or angle


@dataclass(frozen=True)
class Shape:
    """The `<geometry>` of a URDF.

    Attributes:
        kind: tag of the shape, such as mesh, box, cylinder or sphere.
        size: mesh: scale (3 factors); box: 3 sides; cylinder: radius and length; sphere: radius; m.
        filename: mesh file; empty for other shapes.
    """

    kind: str
    size: tuple[float, ...] = ()
    filename: str = ""


@dataclass(frozen=True)
class Visual:
    """A shape of a part of furniture.

    Attributes:
        part: name of the part, such as ``drawer_side-23``.
        shape: geometry of the part.
        pose: (4, 4) pose of the shape in the furniture's frame with closed joints.
        color: RGB colour in 0..1 of a shape whose file has no material; None: not given.
    """

    part: str
    shape: Shape
    pose: Array
    color: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class MovingLink:
    """A moving link in the furniture's frame with closed joints; metres and radians.

    Attributes:
        name: name of the link.
        parent: name of the moving link to which the joint is attached; empty: the fixed body.
        joint: name of the joint that moves the link.
        kind: type of the joint.
        axis: (3,) unit vector of the joint's axis.
        origin: (3,) a point on the axis.
        limits: lower and upper limit of the joint's position.
        visuals: shapes of the link and of all links that are fixed to it.
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
class PartnetModel:
    """Content of the URDF of a model.

    Attributes:
        folder: folder of the model.
        body: shapes of the fixed body.
        links: moving links; each parent is before its children.
        joints: names of all joints that are not of the type "fixed".
        repairs: notes on joints that were fixed and on replaced shapes.
    """

    folder: Path
    body: list[Visual]
    links: list[MovingLink]
    joints: frozenset[str]
    repairs: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Joint:
    name: str
    kind: str
    parent: str
    child: str
    pose: Array
    element: ET.Element


def read_urdf(folder: Path, notes: Mapping[str, JointAnnotation] | None = None, scale: float = 1.0) -> PartnetModel:
    """Read the links and joints of a model.

    A joint without finite limits becomes fixed, unless its annotation has limits.

    Args:
        folder: folder of the model, with ``mobility.urdf``.
        notes: name of a joint -> annotation.
        scale: metres per unit of the URDF.

    Raises:
        AssetError: the URDF is missing or invalid, or has unsupported names or joints.
    """
    return _Reader(folder, notes or {}, scale).read()


class _Reader:
    def __init__(self, folder: Path, notes: Mapping[str, JointAnnotation], scale: float) -> None:
        self._folder, self._path, self._notes, self._scale = folder, folder / URDF, notes, scale
        self._repairs: list[str] = []
        self._colors: dict[str, tuple[float, float, float]] = {}

    def read(self) -> PartnetModel:
        root = _parse(self._folder)
        named = root.findall("link"), root.findall("joint")
        shapes = max(len(root.findall(f"link/{tag}")) for tag in ("visual", "collision"))
        if len(named[0]) > MOST_LINKS or shapes > MOST_SHAPES:
            expected = f"at most {MOST_LINKS} links and {MOST_SHAPES} shapes"
            found = f"{len(named[0])} links, {shapes} shapes"
            raise AssetError("the model has too many links or shapes", where=self._path, expected=expected, found=found)
        for material in root.findall("material"):
            self._color(material)
        links = dict(zip(self._names(named[0]), named[0], strict=True))
        visuals = {name: self._visuals(name, link) for name, link in links.items()}
        joints = [self._joint(*both) for both in zip(self._names(named[1]), named[1], strict=True)]
        body, moving = self._placed(visuals, joints)
        if len(moving) > MOST_MOVING:
            expected, fix = f"at most {MOST_MOVING}", "Fix some of their joints in the annotation: `fixed: true`."
            raise AssetError("too many moving links", where=self._path, expected=expected, found=len(moving), fix=fix)
        could_move = frozenset(joint.name for joint in joints if joint.kind != "fixed")
        return PartnetModel(self._folder, body, moving, could_move, tuple(self._repairs))

    def _placed(
        self, visuals: Mapping[str, list[Visual]], joints: list[_Joint]
    ) -> tuple[list[Visual], list[MovingLink]]:
        below: dict[str, list[_Joint]] = {name: [] for name in visuals}
        for joint in joints:
            if joint.parent not in visuals or joint.child not in visuals:
                what, expected = "a joint refers to a link that the file does not define", "the name of a <link>"
                found = f"{joint.name} with parent {joint.parent!r} and child {joint.child!r}"
                raise AssetError(what, where=self._path, expected=expected, found=found)
            below[joint.parent].append(joint)
        children = {joint.child for joint in joints}
        roots = [name for name in visuals if name not in children]
        if len(roots) != 1 or len(children) != len(joints):
            expected = "exactly one link without a parent, and one joint per other link"
            found = f"links without a parent: {', '.join(roots) or 'none'}"
            raise AssetError("the links do not form a tree", where=self._path, expected=expected, found=found)
        body: list[Visual] = []
        links: list[MovingLink] = []
        queue: list[tuple[str, Array, MovingLink | None]] = [(roots[0], TURNED, None)]
        for name, pose, carrier in queue:
            (carrier.visuals if carrier else body).extend(
                Visual(shape.part, shape.shape, pose @ shape.pose, shape.color) for shape in visuals[name]
            )
            for joint in below[name]:
                frame = pose @ joint.pose
                span = self._range(joint)
                if span is None:
                    queue.append((joint.child, frame, carrier))
                    continue
                closed, limits = span
                axis = self._axis(joint)
                parent = carrier.name if carrier else ""
                turned, kind = frame[:3, :3] @ axis, KINDS[joint.kind]
                links.append(MovingLink(joint.child, parent, joint.name, kind, turned, frame[:3, 3], limits))
                queue.append((joint.child, frame @ _motion(kind, axis, closed), links[-1]))
        if len(queue) != len(visuals):
            lost = sorted(visuals.keys() - {name for name, _, _ in queue})
            expected, found = "joints without a loop", f"a loop of the links {', '.join(lost)}"
            raise AssetError("the links do not form a tree", where=self._path, expected=expected, found=found)
        return body, links

    def _range(self, joint: _Joint) -> tuple[float, tuple[float, float]] | None:
        """Return closed position and limits, relative to the closed position; None for a fixed joint."""
        note = self._notes.get(joint.name, JointAnnotation())
        if joint.kind == "fixed" or note.fixed:
            return None
        if joint.kind not in KINDS:
            fix = f"Fix the joint in the annotation: `joints: {{{joint.name}: {{fixed: true}}}}`."
            expected = f"one of {', '.join(['fixed', *KINDS])}"
            found = f"{joint.kind!r} of {joint.name}"
            raise AssetError("unknown type of a joint", where=self._path, expected=expected, found=found, fix=fix)
        if joint.element.find("mimic") is not None:
            self._repairs.append(f"the joint {joint.name} moves independently: `mimic` is not simulated")
        unit = self._scale if joint.kind == "prismatic" else 1.0
        low, high = self._limits(joint, note, unit)
        finite = np.isfinite([low, high]).all()
        closed = low if finite else 0.0
        if note.closed is not None:
            closed = note.closed * unit
        if note.limits is not None:
            return closed, note.limits
        if not finite or low == high:
            reason = "it has no range" if finite else "it has no finite limits"
            self._repairs.append(f"fixed the joint {joint.name} in its closed position: {reason}")
            return None
        return closed, (low - closed, high - closed)

    def _limits(self, joint: _Joint, note: JointAnnotation, unit: float) -> tuple[float, float]:
        """Return the limits of a joint in m or rad, relative to the zero position of the URDF.

        Missing limits are infinite.
        """
        limit = joint.element.find("limit")
        if limit is None or joint.kind == "continuous":
            return -np.inf, np.inf
        try:
            low, high = (float(limit.get(end, "0")) * unit for end in ("lower", "upper"))
        except ValueError:
            low = high = np.nan
        ends = np.array([low, high])
        usable = low <= high and not (np.isfinite(ends) & (np.abs(ends) > LARGEST)).any()
        if not usable and note.limits is None:
            found = f"lower {limit.get('lower', '0')}, upper {limit.get('upper', '0')} of {joint.name}"
            fix = "Set `limits` of the joint in the annotation, or fix the joint with `fixed: true`."
            expected = f"lower <= upper, each at most {LARGEST:g} m or rad, or infinite"
            raise AssetError("invalid limits of a joint", where=self._path, expected=expected, found=found, fix=fix)
        return (low, high) if usable else (-np.inf, np.inf)

    def _names(self, elements: list[ET.Element]) -> list[str]:
        names: dict[str, None] = {}
        for element in elements:
            name = check_name(element.get("name", ""), AssetError, where=f"{self._path}, name of a <{element.tag}>")
            if name in names:
                raise AssetError(f"two <{element.tag}> elements have the same name", where=self._path, found=repr(name))
            names[name] = None
        return list(names)

    def _visuals(self, name: str, link: ET.Element) -> list[Visual]:
        """Return the visual shapes of a link in the frame of the link.

        A link without visual shapes gets its collision shapes.
        """
        found, tag = link.findall("visual"), "visual"
        if not found and link.find("collision") is not None:
            found, tag = link.findall("collision"), "collision"
            self._repairs.append(f"the link {name} has no <visual>: shows its <collision>")
        visuals = []
        for index, item in enumerate(found):
            where = f"{self._path}, <{tag}> {index} of the link {name}"
            part = item.get("name") or f"part-{index}"
            shape, pose = self._shape(item.find("geometry"), where), self._pose(item.find("origin"), where)
            material = item.find("material")
            visuals.append(Visual(part, shape, pose, None if material is None else self._color(material)))
        return visuals

    def _shape(self, geometry: ET.Element | None, where: str) -> Shape:
        shape = next(iter(geometry), None) if geometry is not None else None
        if shape is None:
            return Shape("nothing")
        if shape.tag == "mesh":
            factors = _numbers(shape.get("scale", "1 1 1"), where, (1, 3)) * self._scale
            if not factors.all():
                what, expected = "invalid scale of a mesh", "factors other than 0"
                raise AssetError(what, where=where, expected=expected, found=factors.tolist())
            return Shape("mesh", tuple(np.broadcast_to(factors, 3).tolist()), shape.get("filename", ""))
        if shape.tag not in SIZES:
            return Shape(shape.tag)
        names, count = SIZES[shape.tag]
        sizes = _numbers(" ".join(shape.get(name, "") for name in names.split()), where, (count,)) * self._scale
        if not (sizes > 0).all():
            raise AssetError("invalid size of a shape", where=where, expected="numbers above 0", found=sizes.tolist())
        return Shape(shape.tag, tuple(sizes.tolist()))

    def _color(self, material: ET.Element) -> tuple[float, float, float] | None:
        """Return the RGB colour of a material in 0..1.

        A material without a colour gets the colour of a material with its name elsewhere in the file.
        """
        name, color = material.get("name", ""), material.find("color")
        if color is None:
            return self._colors.get(name)
        red, green, blue = np.clip(_numbers(color.get("rgba", ""), f"{self._path}, <color>", (3, 4))[:3], 0, 1).tolist()
        self._colors[name] = red, green, blue
        return red, green, blue

    def _joint(self, name: str, element: ET.Element) -> _Joint:
        ends = [element.find(end) for end in ("parent", "child")]
        if any(end is None for end in ends):
            what, expected = "a joint has no parent or no child", "a <parent> and a <child>"
            raise AssetError(what, where=self._path, expected=expected, found=name)
        parent, child = (end.get("link", "") for end in ends if end is not None)
        pose = self._pose(element.find("origin"), f"{self._path}, the joint {name}")
        return _Joint(name, element.get("type", ""), parent, child, pose, element)

    def _axis(self, joint: _Joint) -> Array:
        element, where = joint.element.find("axis"), f"{self._path}, axis of the joint {joint.name}"
        axis = _numbers("1 0 0" if element is None else element.get("xyz", "1 0 0"), where, (3,))
        length = float(np.linalg.norm(axis))
        if length < 1e-9:
            what, expected = "invalid axis of a joint", "a vector of a length above 0"
            raise AssetError(what, where=where, expected=expected, found=axis.tolist())
        return axis / length

    def _pose(self, origin: ET.Element | None, where: str) -> Array:
        pose = np.eye(4)
        if origin is not None:
            pose[:3, :3] = Rotation.from_euler("xyz", _numbers(origin.get("rpy", "0 0 0"), where, (3,))).as_matrix()
            pose[:3, 3] = _numbers(origin.get("xyz", "0 0 0"), where, (3,)) * self._scale
        return pose


def find_urdf(folder: Path) -> Path:
    """Return the path of ``mobility.urdf`` in the folder of a model.

    Raises:
        AssetError: the file is missing.
    """
    path = folder / URDF
    if not path.exists():
        expected = f"a folder of a PartNet-Mobility model, which contains {URDF}"
        raise AssetError(f"missing {URDF}", where=folder, expected=expected, fix="Pass the folder of the model.")
    return path


def _parse(folder: Path) -> ET.Element:
    path = find_urdf(folder)
    data = read_file(path, folder)
    if len(data) > URDF_LIMIT:
        expected, found = f"at most {URDF_LIMIT >> 20} MB", f"{len(data) >> 20} MB"
        raise AssetError("the URDF file is too large", where=path, expected=expected, found=found)
    tree, reader = ET.TreeBuilder(), expat.ParserCreate()
    reader.StartElementHandler, reader.EndElementHandler = tree.start, tree.end
    reader.StartDoctypeDeclHandler = partial(_refuse_doctype, path)
    try:
        reader.Parse(data, True)
    except (expat.ExpatError, LookupError, ValueError) as error:  # also for unknown encodings
        fix = "Download the model again."
        raise AssetError("cannot read the URDF", where=path, expected="XML", found=error, fix=fix) from error
    root = tree.close()
    if root.tag != "robot":
        raise AssetError("the file is not a URDF", where=path, expected="<robot>", found=f"<{root.tag[:40]}>")
    return root


def _refuse_doctype(path: Path, *_: object) -> None:
    # a few lines of entities can expand to gigabytes, or include other files
    fix = "Remove the line `<!DOCTYPE ...>` and the entities in it."
    raise AssetError("the URDF declares a document type", where=path, expected="plain XML", fix=fix)


def _numbers(text: str, where: str, counts: tuple[int, ...]) -> Array:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) not in counts or not (np.abs(values) <= FAR).all():  # false for NaN
        expected = f"{' or '.join(map(str, counts))} numbers, each between -{FAR:g} and {FAR:g}"
        raise AssetError("invalid numbers", where=where, expected=expected, found=repr(text[:80]))
    return values


def _motion(kind: str, axis: Array, position: float) -> Array:
    motion = np.eye(4)
    if kind == "prismatic":
        motion[:3, 3] = axis * position
    else:
        motion[:3, :3] = Rotation.from_rotvec(axis * position).as_matrix()
    return motion
