"""Read PartNet-Mobility's ``mobility.urdf``: shapes and joints of all links, in one frame with closed joints."""

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
    """A `<geometry>`: tag, dimensions in m (mesh scale; box size; radius and length; radius) and mesh file."""

    kind: str
    size: tuple[float, ...] = ()
    filename: str = ""


@dataclass(frozen=True)
class Visual:
    """A shape of a part such as ``drawer_side-23``, with its pose (4, 4) in the furniture's frame, joints closed.

    Attributes:
        color: (3,) in 0..1, for a shape without a material.
    """

    part: str
    shape: Shape
    pose: Array
    color: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class MovingLink:
    """A moving link in the furniture's frame with joints closed; metres, radians.

    ``parent`` is a moving link, or empty for the fixed body. The shapes include those of links fixed to this link.
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
    """A model: shapes of the fixed body, moving links (parents first), names of all movable joints, repairs."""

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
    """Read the links and joints of a model; joints without finite limits are fixed unless a note gives limits.

    Args:
        folder: of the model, with ``mobility.urdf``.
        notes: annotations by joint.
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
            raise AssetError("the model is too large", where=self._path, expected=expected, found=found)
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
                found = f"{joint.name}: {joint.parent} {joint.child}"
                raise AssetError("a joint of unknown links", where=self._path, found=found)
            below[joint.parent].append(joint)
        children = {joint.child for joint in joints}
        roots = [name for name in visuals if name not in children]
        if len(roots) != 1 or len(children) != len(joints):
            found = ", ".join(roots) or "a loop"
            raise AssetError("the links do not form a tree", where=self._path, expected="one root", found=found)
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
            raise AssetError(
                "the links do not form a tree", where=self._path, expected="one root", found=f"a loop of {lost}"
            )
        return body, links

    def _range(self, joint: _Joint) -> tuple[float, tuple[float, float]] | None:
        """Return the closed position in the URDF's units, and the limits relative to it; None for a fixed joint."""
        note = self._notes.get(joint.name, JointAnnotation())
        if joint.kind == "fixed" or note.fixed:
            return None
        if joint.kind not in KINDS:
            fix = f"Fix it in the annotation: `joints: {{{joint.name}: {{fixed: true}}}}`."
            expected = ", ".join(["fixed", *KINDS])
            found = f"{joint.name}: {joint.kind!r}"
            raise AssetError("a joint of an unknown type", where=self._path, expected=expected, found=found, fix=fix)
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
        """Return the limits in m or rad, relative to the URDF's zero; infinite if missing."""
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
            found = f"{joint.name}: {limit.get('lower', '0')} to {limit.get('upper', '0')}"
            fix = "Give the joint `limits` in the annotation, or fix it: `fixed: true`."
            expected = f"lower <= upper, at most {LARGEST:g} m or rad, or `inf`"
            raise AssetError("invalid limits of a joint", where=self._path, expected=expected, found=found, fix=fix)
        return (low, high) if usable else (-np.inf, np.inf)

    def _names(self, elements: list[ET.Element]) -> list[str]:
        names: dict[str, None] = {}
        for element in elements:
            name = check_name(element.get("name", ""), AssetError, where=f"{self._path}, name of a <{element.tag}>")
            if name in names:
                raise AssetError(f"duplicate name of a {element.tag}", where=self._path, found=repr(name))
            names[name] = None
        return list(names)

    def _visuals(self, name: str, link: ET.Element) -> list[Visual]:
        """Return the visual shapes of a link in its frame, or else its collision shapes."""
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
                raise AssetError("zero scale of a mesh", where=where, found=factors.tolist())
            return Shape("mesh", tuple(np.broadcast_to(factors, 3).tolist()), shape.get("filename", ""))
        if shape.tag not in SIZES:
            return Shape(shape.tag)
        names, count = SIZES[shape.tag]
        sizes = _numbers(" ".join(shape.get(name, "") for name in names.split()), where, (count,)) * self._scale
        if not (sizes > 0).all():
            raise AssetError("invalid size of a shape", where=where, expected="sizes > 0", found=sizes.tolist())
        return Shape(shape.tag, tuple(sizes.tolist()))

    def _color(self, material: ET.Element) -> tuple[float, float, float] | None:
        """Return the colour of a material, which may be defined elsewhere in the file by name."""
        name, color = material.get("name", ""), material.find("color")
        if color is None:
            return self._colors.get(name)
        red, green, blue = np.clip(_numbers(color.get("rgba", ""), f"{self._path}, <color>", (3, 4))[:3], 0, 1).tolist()
        self._colors[name] = red, green, blue
        return red, green, blue

    def _joint(self, name: str, element: ET.Element) -> _Joint:
        ends = [element.find(end) for end in ("parent", "child")]
        if any(end is None for end in ends):
            raise AssetError("a joint without parent or child", where=self._path, found=name)
        parent, child = (end.get("link", "") for end in ends if end is not None)
        pose = self._pose(element.find("origin"), f"{self._path}, the joint {name}")
        return _Joint(name, element.get("type", ""), parent, child, pose, element)

    def _axis(self, joint: _Joint) -> Array:
        element, where = joint.element.find("axis"), f"{self._path}, axis of the joint {joint.name}"
        axis = _numbers("1 0 0" if element is None else element.get("xyz", "1 0 0"), where, (3,))
        length = float(np.linalg.norm(axis))
        if length < 1e-9:
            raise AssetError("zero axis of a joint", where=where, found=axis.tolist())
        return axis / length

    def _pose(self, origin: ET.Element | None, where: str) -> Array:
        pose = np.eye(4)
        if origin is not None:
            pose[:3, :3] = Rotation.from_euler("xyz", _numbers(origin.get("rpy", "0 0 0"), where, (3,))).as_matrix()
            pose[:3, 3] = _numbers(origin.get("xyz", "0 0 0"), where, (3,)) * self._scale
        return pose


def find_urdf(folder: Path) -> Path:
    """Return the path of a model's URDF; raise AssetError if it is missing."""
    path = folder / URDF
    if not path.exists():
        expected = "the folder of a PartNet-Mobility model"
        raise AssetError("no such file", where=path, expected=expected, fix="Pass the folder of the model.")
    return path


def _parse(folder: Path) -> ET.Element:
    path = find_urdf(folder)
    data = read_file(path, folder)
    if len(data) > URDF_LIMIT:
        expected, found = f"at most {URDF_LIMIT >> 20} MB", f"{len(data) >> 20} MB"
        raise AssetError("the URDF is too large", where=path, expected=expected, found=found)
    tree, reader = ET.TreeBuilder(), expat.ParserCreate()
    reader.StartElementHandler, reader.EndElementHandler = tree.start, tree.end
    reader.StartDoctypeDeclHandler = partial(_refuse_doctype, path)
    try:
        reader.Parse(data, True)
    except (expat.ExpatError, LookupError, ValueError) as error:  # also for unknown encodings
        raise AssetError("cannot read the URDF", where=path, found=error) from error
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
        expected = f"{' or '.join(map(str, counts))} numbers, at most {FAR:g}"
        raise AssetError("invalid numbers", where=where, expected=expected, found=repr(text[:80]))
    return values


def _motion(kind: str, axis: Array, position: float) -> Array:
    motion = np.eye(4)
    if kind == "prismatic":
        motion[:3, 3] = axis * position
    else:
        motion[:3, :3] = Rotation.from_rotvec(axis * position).as_matrix()
    return motion
