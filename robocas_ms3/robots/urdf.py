"""Generate robot description files in the cache from mani_skill's Panda; SAPIEN is not needed."""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import json
import shutil
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.files import atomic_folder, make_folder, open_for_append
from robocas_ms3.core.locks import lock_file
from robocas_ms3.core.paths import cache_dir
from robocas_ms3.robots.description import MOBILE_PANDA as c

LINK_TRIANGLES = 1000
_INSTALL = "Install it: pip install 'mani_skill>=3.0.1,<3.1'."

# The mobile base: a body 1 cm above the floor, and a deck that carries the pedestal.
_BODY = ((0.5, 0.4, 0.24), (0.0, 0.0, 0.13 - c.base_link_height), (0.16, 0.17, 0.19))
_DECK = ((0.36, 0.3, 0.04), (0.0, 0.0, 0.27 - c.base_link_height), (0.85, 0.86, 0.88))
_PEDESTAL = (c.pedestal_size, (0.0, 0.0, c.pedestal_above_base_link), (0.85, 0.86, 0.88))
_BASE_MASS = 60.0  # kg

# Tip pads in the finger's frame; y is the closing direction. RoboCAS-v0's 55 mm pad starts at z = 28 mm, covers the
# stock rubber tip, whose inner face is at y = 0 too, and ends 8 mm beyond the TCP.
_TIP_WIDTH, _TIP_THICKNESS, _TIP_START, _TIP_STOCK_END = 0.018, 0.004, 0.028, 0.053
# Stock fingers weigh 15 g; with a 33 N grip PhysX then lets them penetrate objects by 2 mm (0.35 mm at 0.1 kg).
_FINGER_MASS, _FINGER_INERTIA = 0.1, (6e-5, 6e-5, 6e-6)  # kg, kg m^2
_TIP_COLOUR = (0.05, 0.05, 0.05)


@dataclass(frozen=True)
class RobotFiles:
    """Paths of the generated files.

    Attributes:
        urdf: mobile base, arm and hand. SAPIEN loads the SRDF with the same stem.
        arm_urdf: arm and hand, rooted at the arm's base, for planners and inverse kinematics. The base is a fixed link,
            so that the arm avoids it. No visual meshes.
        arm_srdf: pairs of links of ``arm_urdf`` without collision checks.
        folder: folder of all files.
    """

    urdf: Path
    arm_urdf: Path
    arm_srdf: Path
    folder: Path


def make_robot_files(finger_extension: float = c.finger_extension) -> RobotFiles:
    """Return the paths of the default robot's files, which are generated if they are missing.

    The folder is in the cache of the user. Its name is a hash of all inputs and of the code of this generator.

    Args:
        finger_extension: extra length of the fingers in m; 0: ManiSkill's standard fingers.

    Raises:
        RobocasError: mani_skill or its Panda is missing, or the cache is not writable.
    """
    source = _panda_folder()
    folder = cache_dir() / "robots" / _fingerprint(source, finger_extension)
    files = RobotFiles(
        urdf=folder / f"{c.uid}.urdf",
        arm_urdf=folder / "panda_arm.urdf",
        arm_srdf=folder / "panda_arm.srdf",
        folder=folder,
    )
    make_folder_once(folder, lambda tmp: _generate(tmp, source, finger_extension))
    return files


def _panda_folder() -> Path:
    """Return the folder of mani_skill's Panda without importing mani_skill."""
    spec = importlib.util.find_spec("mani_skill")
    if spec is None or not spec.submodule_search_locations:
        raise RobocasError("mani_skill is not installed", fix=_INSTALL)
    folder = Path(spec.submodule_search_locations[0]) / "assets" / "robots" / "panda"
    if not (folder / "panda_v2.urdf").is_file():
        raise RobocasError("missing file of mani_skill's Panda", where=folder / "panda_v2.urdf", fix=_INSTALL)
    return folder


@lru_cache(maxsize=8)
def _fingerprint(source: Path, finger_extension: float) -> str:
    digest = hashlib.sha256()
    version = importlib.metadata.version("mani_skill")
    digest.update(f"{version} {finger_extension:.6f}".encode())
    meshes = source / "franka_description" / "meshes"
    generator = [Path(__file__).with_name(name) for name in ("description.py", "meshes.py", "urdf.py")]
    for path in [*generator, *sorted(source.glob("panda_v2.*rdf")), *sorted(meshes.glob("*/*"))]:
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _generate(folder: Path, source: Path, finger_extension: float) -> None:
    from robocas_ms3.robots.meshes import decimate_glb, write_boxes_glb  # slow to import

    visual, collision = folder / "visual", folder / "collision"
    visual.mkdir()
    collision.mkdir()
    panda = _parse(source / "panda_v2.urdf")
    tips = _adapt_finger_tips(panda, finger_extension)
    for mesh in panda.iterfind(".//collision/geometry/mesh"):
        # the planner reads the convex hull next to each mesh
        path = source / mesh.attrib["filename"]
        for name in (path.name, f"{path.name}.convex.stl"):
            shutil.copyfile(path.with_name(name), collision / name)
        mesh.set("filename", f"collision/{path.name}")
    for name in {mesh.attrib["filename"] for mesh in panda.iterfind(".//visual/geometry/mesh")}:
        decimate_glb(source / name, visual / Path(name).name, LINK_TRIANGLES)
    for mesh in panda.iterfind(".//visual/geometry/mesh"):
        mesh.set("filename", f"visual/{Path(mesh.attrib['filename']).name}")
    write_boxes_glb(visual / "base.glb", [_BODY, _DECK, _PEDESTAL])

    arm = deepcopy(panda)
    for link in arm.iterfind("link"):
        for element in link.findall("visual"):
            link.remove(element)
    arm.append(_base_link())
    _joint(arm, "arm_base_joint", "fixed", c.arm_base_link, c.base_link, -c.arm_base_above_base_link)
    _write(arm, folder / "panda_arm.urdf")

    for link, (size, centre) in tips.items():
        name = f"visual/tip_{link}.glb"
        shown = (centre[0], centre[1] * 0.95, centre[2])  # 0.1 mm inwards, in front of the rubber in the same plane
        write_boxes_glb(folder / name, [(size, shown, _TIP_COLOUR)])
        _find(panda, "link", link).insert(1, _visual(name))
    _write(_add_mobile_base(panda), folder / f"{c.uid}.urdf")

    srdf = _parse(source / "panda_v2.srdf")
    for pair in srdf.findall("disable_collisions"):
        if {pair.attrib["link1"], pair.attrib["link2"]} == {"panda_link2", "panda_link6"}:
            srdf.remove(pair)  # listed as "Never", but they collide in 0.1 % of all configurations
    for link, reason in ((c.arm_base_link, "Adjacent"), ("panda_link1", "Never")):
        SubElement(srdf, "disable_collisions", link1=c.base_link, link2=link, reason=reason)
    _write(srdf, folder / "panda_arm.srdf")
    _write(srdf, folder / f"{c.uid}.srdf")


def _adapt_finger_tips(panda: Element, extension: float) -> dict[str, tuple[tuple[float, ...], tuple[float, ...]]]:
    """Move the TCP and add a collision box to the tip of each finger.

    Returns:
        Finger link -> size (3,) and centre (3,) of the box, m.
    """
    _origin(panda, "panda_hand_tcp_joint").set("xyz", f"0 0 {c.stock_tcp_in_hand + extension:g}")
    tips = {}
    if extension == 0:
        return tips
    end = _TIP_STOCK_END + extension
    for link, side in zip(c.finger_links, (1, -1), strict=True):
        _origin(panda, f"{link}_pad_joint").set("xyz", f"0 0 {0.0455 + extension:g}")
        size = (_TIP_WIDTH, _TIP_THICKNESS, end - _TIP_START)
        centre = (0.0, side * _TIP_THICKNESS / 2, (end + _TIP_START) / 2)
        tips[link] = (size, centre)
        element = _find(panda, "link", link)
        element.append(_box_collision(size, centre))
        _replace_inertial(element, _inertial(_FINGER_MASS, _FINGER_INERTIA, (0.0, side * 0.01, 0.04)))
    return tips


def _add_mobile_base(panda: Element) -> Element:
    """Add the mobile base below the arm.

    It has a root link, three joints, the base link, and a fixed joint to the arm's base.
    """
    robot = Element("robot", name=c.uid)
    # reduced-coordinate solvers become unstable for mass ratios over a few hundred along a chain
    for link in ("root", "base_x_link", "base_y_link"):
        SubElement(robot, "link", name=link).append(_inertial(1.0, (0.01, 0.01, 0.01), (0, 0, 0)))
    base = _base_link()
    base.append(_visual("visual/base.glb"))
    robot.append(base)
    chain = ("root", "base_x_link", "base_y_link", c.base_link)
    for i, (name, axis, limits) in enumerate(
        zip(c.base_joints, ("1 0 0", "0 1 0", "0 0 1"), c.base_limits, strict=True)
    ):
        height = c.base_link_height if chain[i + 1] == c.base_link else 0.0
        joint = _joint(robot, name, "revolute" if i == 2 else "prismatic", chain[i], chain[i + 1], height)
        SubElement(joint, "axis", xyz=axis)
        lower, upper = (f"{limit:.10g}" for limit in limits)
        SubElement(joint, "limit", effort="1000", lower=lower, upper=upper, velocity="1")
    _joint(robot, "arm_base_joint", "fixed", c.base_link, c.arm_base_link, c.arm_base_above_base_link)
    robot.extend(list(panda))
    return robot


def _base_link() -> Element:
    base = Element("link", name=c.base_link)
    for size, centre, _ in (_BODY, _DECK, _PEDESTAL):
        base.append(_box_collision(size, centre))
    x, y, z = _BODY[0]
    inertia = tuple(_BASE_MASS / 12 * (a * a + b * b) for a, b in ((y, z), (x, z), (x, y)))
    base.append(_inertial(_BASE_MASS, inertia, _BODY[1]))
    return base


def _joint(robot: Element, name: str, kind: str, parent: str, child: str, height: float) -> Element:
    joint = SubElement(robot, "joint", name=name, type=kind)
    SubElement(joint, "origin", rpy="0 0 0", xyz=f"0 0 {height:g}")
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    return joint


def _visual(filename: str) -> Element:
    visual = Element("visual")
    SubElement(SubElement(visual, "geometry"), "mesh", filename=filename)
    return visual


def _box_collision(size: tuple[float, ...], centre: tuple[float, ...]) -> Element:
    collision = Element("collision")
    SubElement(collision, "origin", rpy="0 0 0", xyz=_format_numbers(centre))
    SubElement(SubElement(collision, "geometry"), "box", size=_format_numbers(size))
    return collision


def _inertial(mass: float, diagonal: tuple[float, ...], centre: tuple[float, ...]) -> Element:
    inertial = Element("inertial")
    SubElement(inertial, "origin", rpy="0 0 0", xyz=_format_numbers(centre))
    SubElement(inertial, "mass", value=f"{mass:g}")
    xx, yy, zz = (f"{value:.6g}" for value in diagonal)
    SubElement(inertial, "inertia", ixx=xx, ixy="0", ixz="0", iyy=yy, iyz="0", izz=zz)
    return inertial


def _replace_inertial(link: Element, inertial: Element) -> None:
    for old in link.findall("inertial"):
        link.remove(old)
    link.append(inertial)


def _format_numbers(numbers: tuple[float, ...]) -> str:
    return " ".join(f"{number:.6g}" for number in numbers)


def _parse(path: Path) -> Element:
    return ElementTree.parse(path).getroot()


def _find(root: Element, tag: str, name: str) -> Element:
    element = root.find(f"{tag}[@name='{name}']")
    if element is None:
        raise RobocasError(f"mani_skill's Panda has no {tag} with this name", where=name, fix=_INSTALL)
    return element


def _origin(root: Element, joint: str) -> Element:
    element = _find(root, "joint", joint).find("origin")
    if element is None:
        raise RobocasError("mani_skill's Panda has no origin for this joint", where=joint, fix=_INSTALL)
    return element


def _write(root: Element, path: Path) -> None:
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def make_folder_once(folder: Path, make: Callable[[Path], None]) -> None:
    """Make a folder of generated files unless it is complete; other processes that need it wait.

    Args:
        folder: the folder. Its name must change with everything on which the files depend, such as a hash.
        make: writes all files into the folder that it gets.
    """
    if _is_complete(folder):
        return
    make_folder(folder.parent)
    with open_for_append(folder.parent.with_suffix(".lock")) as lock:
        lock_file(lock, folder, wait=True)
        if _is_complete(folder):
            return
        with atomic_folder(folder) as tmp:
            make(tmp)
            names = sorted(str(path.relative_to(tmp)) for path in tmp.rglob("*") if path.is_file())
            (tmp / "files.json").write_text(json.dumps(names, indent=1), encoding="utf-8")


def _is_complete(folder: Path) -> bool:
    try:
        names = load_json(folder / "files.json")
    except (OSError, ValueError):
        return False
    return isinstance(names, list) and all((folder / name).is_file() for name in names)
