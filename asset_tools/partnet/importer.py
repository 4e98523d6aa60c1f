"""A PartNet-Mobility model with its annotation, as what furniture is built from."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from asset_tools.build import build_furniture
from asset_tools.import_scans import object_id
from asset_tools.partnet.annotation import Annotation, JointNote, find_annotation
from asset_tools.partnet.clearance import trimmed
from asset_tools.partnet.collision import Part, for_gpu, pieces_of
from asset_tools.partnet.looks import merged
from asset_tools.partnet.obj import Faces, read_obj
from asset_tools.partnet.urdf import URDF, Mobility, MovingLink, Visual, read_urdf
from asset_tools.pipeline import Job, content_hash
from asset_tools.sources import FurnitureSource, LinkSource
from robocas_ms3.assets.manifest import FurnitureAsset, Handle, Joint, Surface
from robocas_ms3.errors import AssetError

Array = np.ndarray

LICENCE = "PartNet-Mobility terms: research use only"
ATTRIBUTION = "PartNet-Mobility (SAPIEN, UCSD; PartNet, Stanford; ShapeNet)"
DENSITY = 300.0  # kg/m3 of moving parts whose mass nobody gave: boards with air between
FRICTION = 0.05  # of joints, as PhysX has it
DAMPING = {"prismatic": 8.0, "revolute": 0.8}  # N s/m, N m s/rad
EDGE = 0.002  # m that a surface may reach beyond the model


def read_partnet(folder: Path, annotation: Annotation) -> FurnitureSource:
    """Read a model: collision pieces, one textured mesh a link, joints, surfaces and handles.

    The frame is upstream's: the model's origin, x out of its front, z up; joints closed at 0. Links and joints keep
    the URDF's names.

    Args:
        folder: of the model; its name is the id.
        annotation: what the model doesn't say of itself.

    Raises:
        AssetError: naming the file that is missing or wrong, or what of the annotation doesn't fit the model.
    """
    notes = annotation.joints
    closed = {name: note.closed for name, note in notes.items() if note.closed is not None}
    fixed = frozenset(name for name, note in notes.items() if note.fixed)
    model = read_urdf(folder, closed=closed, fixed=fixed)
    looks = {"": _looks(model.body)} | {link.name: _looks(link.visuals) for link in model.links}
    corners = np.concatenate([faces.corners.reshape(-1, 3) for group in looks.values() for _, _, faces in group])
    bounds = np.array([corners.min(axis=0), corners.max(axis=0)])
    _check(model, annotation, bounds)
    if annotation.mass is not None and model.links:
        fix = "Leave `mass` out; that of moving parts goes under `joints`."
        raise AssetError("furniture with moving parts stands fixed", where=folder.name, found="a mass", fix=fix)
    middle = bounds.mean(axis=0)
    pieces = {name: _for_gpu(pieces_of(_parts(group), middle)) for name, group in looks.items()}
    joints = {link.name: _joint(link, notes.get(link.joint, JointNote())) for link in model.links}
    for link in model.links:
        others = [piece for name, group in pieces.items() if name not in _carried(model, link.name) for piece in group]
        pieces[link.name] = _for_gpu(trimmed(pieces[link.name], others, joints[link.name]))
    links = []
    for link in model.links:
        note = notes.get(link.joint, JointNote())
        volume = sum(ConvexHull(piece).volume for piece in pieces[link.name])
        mesh = merged([faces for _, _, faces in looks[link.name]])
        mass = note.mass or max(0.3, round(DENSITY * volume, 2))
        links.append(LinkSource(link.name, joints[link.name], mesh, pieces[link.name], mass, link.parent))
    names = {link.joint: link.name for link in model.links}
    return FurnitureSource(
        id=object_id(folder.name),
        name=annotation.name,
        category=annotation.category,
        mesh=merged([faces for _, _, faces in looks[""]]),
        pieces=pieces[""],
        mass=annotation.mass,
        origin_height=annotation.origin_lift,
        surfaces=annotation.surfaces,
        links=tuple(links),
        handles={
            name: Handle(link=names[note.joint], position=note.position, wxyz=note.wxyz, width=note.width)
            for name, note in annotation.handles.items()
        },
        source="partnet",
        licence=LICENCE,
        attribution=ATTRIBUTION,
    )


def _for_gpu(pieces: Sequence[np.ndarray]) -> list[np.ndarray]:
    return [part for piece in pieces for part in for_gpu(piece)]


def partnet_jobs(folders: Sequence[Path], annotations: Path | None = None) -> list[Job]:
    """What is to be made of models.

    Args:
        folders: of the models, each with a ``mobility.urdf``; their names are the ids.
        annotations: folder of the user's ``<id>.yaml``; they go before those shipped.

    Raises:
        AssetError: a folder is no model, an annotation is missing or wrong, or two models have one id.
    """
    jobs: dict[str, Job] = {}
    for folder in (folder.resolve() for folder in folders):
        name = object_id(folder.name)
        if name in jobs:
            raise AssetError("two models would get the same id", where=folder, found=name, fix="Rename one.")
        model = read_urdf(folder)  # says what is missing before anything is made
        annotation = find_annotation(folder.name, annotations)
        meshes = {
            visual.path.parent for group in (model.body, *(link.visuals for link in model.links)) for visual in group
        }
        files = [
            folder / URDF,
            *(path for home in sorted(meshes | {folder / "images"}) for path in sorted(home.glob("*.*"))),
        ]
        content = content_hash(name, annotation, files=files, packages=("partnet",))
        jobs[name] = Job(name, partial(_make, folder, annotation), content)
    return list(jobs.values())


def _make(folder: Path, annotation: Annotation, out: Path) -> FurnitureAsset:
    return build_furniture(read_partnet(folder, annotation), out)


def _looks(visuals: Sequence[Visual]) -> list[tuple[str, Path, Faces]]:
    """Faces of each part and file, in the furniture's frame."""
    found = []
    for visual in visuals:
        turn, shift = visual.pose[:3, :3], visual.pose[:3, 3]
        for faces in read_obj(visual.path):
            found.append((visual.part, visual.path, Faces(faces.corners @ turn.T + shift, faces.uv, faces.material)))
    return found


def _parts(group: Sequence[tuple[str, Path, Faces]]) -> list[Part]:
    parts: dict[str, dict[Path, list[Array]]] = {}
    for name, path, faces in group:
        parts.setdefault(name, {}).setdefault(path, []).append(faces.corners)
    return [Part(name, [np.concatenate(blocks) for blocks in meshes.values()]) for name, meshes in parts.items()]


def _joint(link: MovingLink, note: JointNote) -> Joint:
    limits = note.limits or link.limits
    if not limits[0] <= 0 <= limits[1]:
        raise AssetError("a joint's range doesn't hold 0, which is closed", where=link.joint, found=limits)
    x, y, z = (float(value) for value in np.round(link.axis, 9) + 0.0)
    a, b, c = (float(value) for value in np.round(link.origin, 9) + 0.0)
    return Joint(
        name=link.joint,
        kind=link.kind,
        axis=(x, y, z),
        origin=(a, b, c),
        limits=(round(limits[0], 9), round(limits[1], 9)),
        friction=FRICTION if note.friction is None else note.friction,
        damping=DAMPING[link.kind] if note.damping is None else note.damping,
    )


def _carried(model: Mobility, name: str) -> set[str]:
    """A link and all that hangs on it."""
    carried = {name}
    for link in model.links:
        if link.parent in carried:
            carried.add(link.name)
    return carried


def _check(model: Mobility, annotation: Annotation, bounds: Array) -> None:
    where = model.folder.name
    moving = {link.joint for link in model.links}
    for name in annotation.joints:
        if name not in model.joints:
            expected = f"one of {', '.join(sorted(model.joints)) or '(none)'}"
            raise AssetError("the annotation names an unknown joint", where=where, expected=expected, found=name)
    for name, handle in annotation.handles.items():
        if handle.joint not in moving:
            expected = f"one of {', '.join(sorted(moving)) or '(none)'}"
            found = handle.joint
            raise AssetError(f"the handle {name!r} is of an unknown joint", where=where, expected=expected, found=found)
    links = {"", *(link.name for link in model.links)}
    for name, surface in annotation.surfaces.items():
        if surface.link not in links:
            expected = f"one of {', '.join(sorted(links - {''})) or '(none)'}"
            found = surface.link
            raise AssetError(f"the surface {name!r} is of an unknown link", where=where, expected=expected, found=found)
        _check_surface(name, surface, bounds, where)


def _check_surface(name: str, surface: Surface, bounds: Array, where: str) -> None:
    low, high = np.array([*surface.min_xy, surface.z]), np.array([*surface.max_xy, surface.z])
    if (low < bounds[0] - EDGE).any() or (high > bounds[1] + EDGE).any():
        span = " ".join(f"{axis} {a:.3f}..{b:.3f}" for axis, a, b in zip("xyz", *bounds, strict=True))
        found = f"{[round(float(value), 3) for value in low]} to {[round(float(value), 3) for value in high]}"
        raise AssetError(f"the surface {name!r} lies outside of the model", where=where, expected=span, found=found)
