"""Import PartNet-Mobility models: convert a model and its annotation to a furniture source."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from asset_tools.build import build_furniture
from asset_tools.import_scans import make_object_id
from asset_tools.partnet.annotation import LARGEST, JointAnnotation, ModelAnnotation, find_annotation
from asset_tools.partnet.clearance import trim_colliding_pieces
from asset_tools.partnet.collision import CollisionPart, make_collision_pieces, split_slender_hull
from asset_tools.partnet.geometry import GeometryReader
from asset_tools.partnet.obj import Faces
from asset_tools.partnet.textures import merge_faces
from asset_tools.partnet.urdf import URDF, MovingLink, PartnetModel, Visual, find_urdf, read_urdf
from asset_tools.pipeline import AssetJob, compute_content_hash, make_failing_job
from asset_tools.readers.files import LARGEST_FILE, find_files
from asset_tools.readers.limits import limit_time_and_memory
from asset_tools.sources import FurnitureSource, LinkSource
from robocas_ms3.assets.manifest import BODY, FurnitureAsset, Handle, Joint, Surface
from robocas_ms3.core.errors import AssetError

Array = np.ndarray

LICENCE = "PartNet-Mobility terms: research use only"
ATTRIBUTION = "PartNet-Mobility (SAPIEN, UCSD; PartNet, Stanford; ShapeNet)"
DENSITY = 300.0  # kg/m3 of moving parts without a given mass: hollow parts made of boards
FRICTION = 0.05  # of joints, in PhysX's units
DAMPING = {"prismatic": 8.0, "revolute": 0.8}  # N s/m, N m s/rad
SMALLEST = 0.01  # m of the longest side
MOST_REPAIRS = 30  # maximum number of lines in the manifest
# suffixes of the files of a model
SUFFIXES = {".obj", ".stl", ".mtl", ".png", ".jpg", ".jpeg", ".bmp", ".tga", ".tif", ".tiff", ".webp", ".gif"}
EDGE = 0.002  # m, tolerance for surfaces beyond the model's bounds


def read_partnet(folder: Path, annotation: ModelAnnotation) -> FurnitureSource:
    """Read a model as the source of a piece of furniture.

    The source has collision pieces and one textured mesh per link, joints, surfaces and handles. As in RoboCAS-v0, the
    origin of its frame is the origin of the model, x points out of the front, and z points up. Joints are closed at 0.
    Links and joints keep their names in the URDF if these names are valid in a pack.

    Args:
        folder: folder of the model, whose name is the id. Files outside of this folder are not read.
        annotation: annotation of the model.

    Raises:
        AssetError: a file is missing or invalid, or the annotation does not fit the model.
    """
    folder = folder.resolve()
    model = read_urdf(folder, annotation.joints, annotation.scale)
    geometry = GeometryReader(folder)
    with limit_time_and_memory(folder):
        faces_by_link = {name: geometry.read_faces(name, visuals) for name, visuals in _groups(model)}
    corners = np.concatenate(
        [np.zeros((0, 3))] + [faces.corners.reshape(-1, 3) for group in faces_by_link.values() for _, _, faces in group]
    )
    empty = next((name for name, group in faces_by_link.items() if not group), None)
    if empty is not None:
        what = f"the moving link {empty} has no mesh" if empty else "the fixed body has no mesh"
        fix = "Fix the joint of the link in the annotation with `fixed: true`." if empty else "Use another model."
        raise AssetError(what, where=folder / URDF, expected="a <visual> with faces in each link", fix=fix)
    bounds = np.array([corners.min(axis=0), corners.max(axis=0)])
    _check_size(bounds, folder.name)
    _check(model, annotation, bounds)
    if annotation.mass is not None and model.links:
        fix = "Remove `mass` at the top level; set masses of moving parts under `joints`."
        raise AssetError(
            "furniture with moving parts must be fixed",
            where=folder.name,
            expected="an annotation without `mass`",
            found=f"mass: {annotation.mass:g}",
            fix=fix,
        )
    repairs = [*model.repairs, *geometry.repairs]
    ids = _ids([link.name for link in model.links], repairs)
    joint_ids = _ids([link.joint for link in model.links], repairs)
    middle = bounds.mean(axis=0)
    pieces = {name: _for_gpu(make_collision_pieces(_parts(group), middle)) for name, group in faces_by_link.items()}
    joints = {link.name: _joint(link, joint_ids[link.joint], annotation) for link in model.links}
    for link in model.links:
        others = [piece for name, group in pieces.items() if name not in _carried(model, link.name) for piece in group]
        pieces[link.name] = _for_gpu(trim_colliding_pieces(pieces[link.name], others, joints[link.name]))
    links = []
    for link in model.links:
        note = annotation.joints.get(link.joint, JointAnnotation())
        volume = sum(ConvexHull(piece).volume for piece in pieces[link.name])
        mesh = merge_faces([faces for _, _, faces in faces_by_link[link.name]])
        mass = note.mass or max(0.3, round(DENSITY * volume, 2))
        parent = ids[link.parent] if link.parent else ""
        links.append(LinkSource(ids[link.name], joints[link.name], mesh, pieces[link.name], mass, parent))
    moved = {link.joint: ids[link.name] for link in model.links}
    return FurnitureSource(
        id=make_object_id(folder.name),
        name=annotation.name,
        category=annotation.category,
        mesh=merge_faces([faces for _, _, faces in faces_by_link[""]]),
        pieces=pieces[""],
        mass=annotation.mass,
        origin_height=annotation.origin_lift,
        surfaces={
            name: surface.model_copy(update={"link": ids[surface.link]}) if surface.link else surface
            for name, surface in annotation.surfaces.items()
        },
        links=tuple(links),
        handles={
            name: Handle(link=moved[note.joint], position=note.position, wxyz=note.wxyz, width=note.width)
            for name, note in annotation.handles.items()
        },
        source="partnet",
        licence=LICENCE,
        attribution=ATTRIBUTION,
        repairs=_short(repairs),
    )


def _groups(model: PartnetModel) -> list[tuple[str, list[Visual]]]:
    """Return the name and the shapes of the fixed body, whose name is empty, and of each moving link."""
    return [("", model.body), *((link.name, link.visuals) for link in model.links)]


def _ids(names: Sequence[str], repairs: list[str]) -> dict[str, str]:
    """Map names of a URDF to unique names in a pack, of lower-case letters, digits and underscores.

    Args:
        names: names in the URDF.
        repairs: list to which the function appends one note per changed name.
    """
    ids: dict[str, str] = {}
    taken = {BODY}
    for name in names:
        plain = name if re.fullmatch("[a-z0-9_]+", name) else make_object_id(name)
        found, number = plain, 2
        while found in taken:
            found, number = f"{plain}_{number}", number + 1
        taken.add(found)
        ids[name] = found
        if found != name:
            repairs.append(f"renamed {name!r} to {found}")
    return ids


def _short(repairs: Sequence[str]) -> tuple[str, ...]:
    """Return at most 30 notes without duplicates; a last line has the number of notes that are left out."""
    lines = list(dict.fromkeys(repairs))
    left = len(lines) - MOST_REPAIRS
    return (*lines[:MOST_REPAIRS], *([f"{left} more lines"] if left > 0 else []))


def _for_gpu(pieces: Sequence[np.ndarray]) -> list[np.ndarray]:
    return [part for piece in pieces for part in split_slender_hull(piece)]


def make_partnet_jobs(folders: Sequence[Path], annotations: Path | None = None) -> list[AssetJob]:
    """Return one job per model; the job of a model with an error raises the error when it runs.

    Args:
        folders: folders of the models, each with a ``mobility.urdf``; the names of the folders are the ids.
        annotations: folder of the user's ``<id>.yaml`` files, which have priority over bundled annotations.

    Returns:
        The jobs. Jobs of models with errors come first, so that an import stops before it builds an asset.
    """
    good: dict[str, AssetJob] = {}
    bad: dict[str, AssetJob] = {}
    for folder in dict.fromkeys(folder.resolve() for folder in folders):
        name = make_object_id(folder.name)
        try:
            if name in good or name in bad:
                fix = "Rename the folder of one of the two models."
                raise AssetError("two models have the same id", where=folder, found=name, fix=fix)
            good[name] = _job(name, folder, annotations)
        except AssetError as error:
            label = name if name not in good and name not in bad else make_object_id(str(folder))
            bad[label] = make_failing_job(label, error)
    return [*bad.values(), *good.values()]


def _job(name: str, folder: Path, annotations: Path | None) -> AssetJob:
    find_urdf(folder)  # otherwise the error would be a missing annotation
    annotation = find_annotation(folder.name, annotations)
    model, geometry = read_urdf(folder, annotation.joints, annotation.scale), GeometryReader(folder)
    for link, visuals in _groups(model):
        geometry.check_files(link, visuals)
    content = compute_content_hash(name, annotation, files=_files(folder), packages=("partnet", "readers"))
    return AssetJob(name, partial(_make, folder, annotation), content)


def _files(folder: Path) -> list[Path]:
    """Return the URDF of a model and all mesh, material and image files in its folder."""
    found = [folder / URDF]
    for path in find_files(folder):
        inside = path.suffix.lower() in SUFFIXES and path.is_file() and path.resolve().is_relative_to(folder)
        if inside and path.stat().st_size <= LARGEST_FILE:  # larger files are not read
            found.append(path)
    return found


def _make(folder: Path, annotation: ModelAnnotation, out: Path) -> FurnitureAsset:
    return build_furniture(read_partnet(folder, annotation), out)


def _parts(group: Sequence[tuple[str, str, Faces]]) -> list[CollisionPart]:
    parts: dict[str, dict[str, list[Array]]] = {}
    for name, source, faces in group:
        parts.setdefault(name, {}).setdefault(source, []).append(faces.corners)
    return [
        CollisionPart(name, [np.concatenate(blocks) for blocks in meshes.values()]) for name, meshes in parts.items()
    ]


def _joint(link: MovingLink, name: str, annotation: ModelAnnotation) -> Joint:
    note, limits = annotation.joints.get(link.joint, JointAnnotation()), link.limits
    if not limits[0] <= 0 <= limits[1] or limits[0] == limits[1]:
        fix = "Correct `limits` or `closed` of the joint in the annotation."
        expected, found = "limits that include 0, the closed position", f"{limits[0]:g} to {limits[1]:g}"
        raise AssetError("invalid limits of a joint", where=link.joint, expected=expected, found=found, fix=fix)
    x, y, z = (float(value) for value in np.round(link.axis, 9) + 0.0)
    a, b, c = (float(value) for value in np.round(link.origin, 9) + 0.0)
    return Joint(
        name=name,
        kind=link.kind,
        axis=(x, y, z),
        origin=(a, b, c),
        limits=(round(limits[0], 9), round(limits[1], 9)),
        friction=FRICTION if note.friction is None else note.friction,
        damping=DAMPING[link.kind] if note.damping is None else note.damping,
    )


def _carried(model: PartnetModel, name: str) -> set[str]:
    """Return the names of a link and of all links that move with it."""
    carried = {name}
    for link in model.links:
        if link.parent in carried:
            carried.add(link.name)
    return carried


def _check(model: PartnetModel, annotation: ModelAnnotation, bounds: Array) -> None:
    where = model.folder.name
    moving = {link.joint for link in model.links}
    for name in annotation.joints:
        if name not in model.joints:
            expected = f"one of {', '.join(sorted(model.joints)) or '(none)'}"
            raise AssetError("unknown joint in the annotation", where=where, expected=expected, found=name)
    for name, handle in annotation.handles.items():
        if handle.joint not in moving:
            expected = f"one of {', '.join(sorted(moving)) or '(none)'}"
            found, known = handle.joint, handle.joint in model.joints
            what = f"handle {name!r} in the annotation belongs to {'a fixed joint' if known else 'an unknown joint'}"
            fix = "Give the joint `limits` in the annotation, or remove the handle." if known else ""
            raise AssetError(what, where=where, expected=expected, found=found, fix=fix)
    links = {"", *(link.name for link in model.links)}
    for name, surface in annotation.surfaces.items():
        if surface.link not in links:
            expected = f"a moving link, which is one of {', '.join(sorted(links - {''})) or '(none)'}"
            found = surface.link
            what = f"surface {name!r} in the annotation has an unknown link"
            raise AssetError(what, where=where, expected=expected, found=found)
        _check_surface(name, surface, bounds, where)


def _check_size(bounds: Array, where: str) -> None:
    size = float((bounds[1] - bounds[0]).max())
    if size < SMALLEST or np.abs(bounds).max() > LARGEST:
        expected = f"a longest side of at least {SMALLEST} m, and coordinates of at most {LARGEST:g} m"
        found = f"a longest side of {size:.4g} m, coordinates of up to {float(np.abs(bounds).max()):.4g} m"
        fix = "Set `scale` in the annotation: metres per unit of the model."
        raise AssetError("implausible size of furniture", where=where, expected=expected, found=found, fix=fix)


def _check_surface(name: str, surface: Surface, bounds: Array, where: str) -> None:
    low, high = np.array([*surface.min_xy, surface.z]), np.array([*surface.max_xy, surface.z])
    if (low < bounds[0] - EDGE).any() or (high > bounds[1] + EDGE).any():
        span = " ".join(f"{axis} {a:.3f}..{b:.3f}" for axis, a, b in zip("xyz", *bounds, strict=True))
        found = f"{[round(float(value), 3) for value in low]} to {[round(float(value), 3) for value in high]}"
        what, expected = f"surface {name!r} in the annotation is outside of the model", f"coordinates within {span}"
        raise AssetError(what, where=where, expected=expected, found=found)
