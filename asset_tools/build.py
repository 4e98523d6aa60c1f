"""Build the files of an asset: visual meshes, hulls, annotations, mass properties, quality."""

from __future__ import annotations

import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from asset_tools.decompose import Decomposition, decompose_mesh, is_hollow
from asset_tools.glb import write_glb
from asset_tools.grasps import sample_grasps
from asset_tools.inertia import compute_piece_inertia, compute_principal_inertia, round_moments, round_vector
from asset_tools.quality.furniture import measure_furniture
from asset_tools.quality.hulls import compute_volume_iou
from asset_tools.quality.measure import measure_object
from asset_tools.resting_poses import find_resting_poses
from asset_tools.sources import FurnitureSource, ObjectSource
from asset_tools.visual import make_display_mesh
from robocas_ms3.assets.annotations import Annotations, compute_footprints
from robocas_ms3.assets.hulls import read_hulls, write_hulls
from robocas_ms3.assets.manifest import FurnitureAsset, FurnitureQuality, ObjectAsset
from robocas_ms3.assets.pack import (
    ANNOTATIONS,
    FINISHES,
    HULLS,
    LINKS,
    VISUALS,
    BodyFiles,
    LoadedFurniture,
    VisualLevel,
    sha256,
)
from robocas_ms3.assets.physics import RigidBody
from robocas_ms3.core.errors import AssetError

SURFACE_POINTS = 1024
GRASPS = 800  # many, since most grasps of an object on a table are from below or blocked by neighbours
FEW_GRASPS = 50  # with fewer grasps, the manifest has the reason
FAST, FAST_ENOUGH = 1000, 1500  # triangles of `fast` after decimation, and the limit for no decimation
FULL, FULL_TEXTURE = 12_000, 1024


def build_object(source: ObjectSource, folder: Path) -> ObjectAsset:
    """Write the files of an object to a folder and return the manifest entry of the object; deterministic.

    The origin of the object's frame is moved to the centre of the mesh's bounding box.

    Args:
        source: meshes and properties of the object.
        folder: new or existing folder of the object.

    Raises:
        AssetError: the object cannot be built.
    """
    try:
        return _build_object(source, folder)
    except AssetError as error:
        raise AssetError(
            error.what, where=source.id, expected=error.expected, found=error.found, fix=error.fix
        ) from error


def _build_object(source: ObjectSource, folder: Path) -> ObjectAsset:
    folder.mkdir(parents=True, exist_ok=True)
    shift = -source.mesh.bounds.mean(axis=0)
    mesh, closed = source.mesh.copy(include_cache=True), source.closed.copy()
    mesh.apply_translation(shift)
    closed.apply_translation(shift)
    repairs = (*source.repairs, *write_visuals(mesh, folder))

    if source.pieces is None:
        parts = decompose_mesh(closed)
    else:
        pieces = [piece + shift for piece in source.pieces]
        parts = Decomposition(pieces, compute_volume_iou(closed, pieces))
    write_hulls(folder / HULLS, parts.hulls)
    # hulls as the simulator loads them: rounding of the file changes the resting poses of round objects
    hulls = [hull.vertices for hull in read_hulls(folder / HULLS)]

    # rounded as in the manifest, so that measuring the pack again gives equal values
    center = np.array(round_vector(closed.center_mass))
    moments, axes = compute_principal_inertia(closed, source.mass)
    inertia = np.array(round_moments(moments))
    solid = RigidBody(hulls, source.mass, center, inertia, np.array(axes), source.friction)
    rest = find_resting_poses(solid)
    grasps, reason = source.grasps, ""
    if grasps is None:
        grasps = sample_grasps(closed, center, np.random.default_rng(zlib.crc32(source.id.encode())), count=GRASPS)
    else:
        poses = grasps.tcp_in_object.copy()
        poses[:, :3, 3] += shift
        grasps = replace(grasps, tcp_in_object=poses)
    if len(grasps) < FEW_GRASPS:
        reason = f"only {len(grasps)} places where the gripper, open 0.08 m, fits around it and friction holds it"
    points, faces = trimesh.sample.sample_surface(closed, SURFACE_POINTS, seed=0)[:2]
    notes = Annotations(
        resting_poses=rest.poses,
        footprints=_light(compute_footprints(hulls, rest.poses)),
        resting_probabilities=rest.probabilities,
        display_pose=rest.display_pose,
        grasps_tcp_in_object=_light(grasps.tcp_in_object),
        grasp_widths=_light(grasps.widths),
        grasp_qualities=_light(grasps.qualities),
        surface_points=_light(points),
        surface_normals=_light(closed.face_normals[faces]),
    )
    notes.save(folder / ANNOTATIONS)
    notes = Annotations.load(folder / ANNOTATIONS)
    return ObjectAsset(
        id=source.id,
        name=source.name,
        category=source.category,
        source=source.source,
        licence=source.licence,
        attribution=source.attribution,
        extents=round_vector(mesh.extents),
        friction=source.friction,
        repairs=repairs,
        files=_hashes(folder),
        graspnet_id=source.graspnet_id,
        mass=source.mass,
        center_of_mass=round_vector(center),
        inertia=round_moments(inertia),
        inertia_wxyz=axes,
        grasp_count=len(grasps),
        no_grasps_because=reason,
        quality=measure_object(closed, solid, notes, hollow=source.hollow or is_hollow(closed)),
    )


def build_furniture(source: FurnitureSource, folder: Path) -> FurnitureAsset:
    """Write the files of a piece of furniture to a folder and return the manifest entry of the furniture.

    Args:
        source: meshes and properties of the furniture.
        folder: new or existing folder of the furniture.
    """
    _write_body(source.mesh, source.pieces, folder)
    for link in source.links:
        _write_body(link.mesh, link.pieces, folder / LINKS / link.name)
    for part, finishes in source.finishes.items():
        (folder / FINISHES).mkdir(exist_ok=True)
        for name, mesh in finishes.items():
            write_glb(mesh, folder / FINISHES / f"{part}_{name}.glb")
    body: dict[str, Any] = {}
    if source.mass is not None:
        center, inertia, axes = compute_piece_inertia(source.pieces, source.mass)
        body = {
            "mass": source.mass,
            "center_of_mass": round_vector(center),
            "inertia": round_moments(inertia),
            "inertia_wxyz": axes,
        }
    asset = FurnitureAsset(
        id=source.id,
        name=source.name,
        category=source.category,
        source=source.source,
        licence=source.licence,
        attribution=source.attribution,
        extents=round_vector(source.mesh.extents),
        friction=source.friction,
        repairs=source.repairs,
        files=_hashes(folder),
        origin_height=source.origin_height,
        surfaces=source.surfaces,
        inner=source.inner,
        links=tuple(link.to_link() for link in source.links),
        handles=source.handles,
        finishes={part: tuple(finishes) for part, finishes in source.finishes.items()},
        quality=FurnitureQuality(hull_count=1, hull_vertices=4, joints_open=None, surfaces_hold=None),
        **body,
    )
    # measured on the files that the simulator loads
    parts = {link.name: BodyFiles(folder / LINKS / link.name) for link in asset.links}
    return asset.model_copy(update={"quality": measure_furniture(LoadedFurniture(folder, asset=asset, links=parts))})


def write_visuals(mesh: trimesh.Trimesh, folder: Path) -> list[str]:
    """Write the visual meshes of an asset at two levels of detail, ``fast`` and ``full``.

    Args:
        mesh: textured mesh of the asset, metres.
        folder: existing folder of the asset.

    Returns:
        A note for each level whose mesh has more faces than the limit.
    """
    levels: dict[VisualLevel, tuple[int, int]] = {
        "fast": (FAST_ENOUGH if len(mesh.faces) <= FAST_ENOUGH else FAST, 512),
        "full": (FULL, FULL_TEXTURE),
    }
    notes = []
    for level, (triangles, size) in levels.items():
        shown = make_display_mesh(mesh, triangles=triangles, texture_size=size)
        write_glb(shown, folder / VISUALS[level])
        if len(shown.faces) > max(triangles, FAST_ENOUGH):
            notes.append(f"kept {len(shown.faces)} instead of {triangles} faces ({level}): many holes or pieces")
    return notes


def _write_body(mesh: trimesh.Trimesh, pieces: list[np.ndarray], folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    # the same mesh for both levels: decimation would drop some of the loose boards and sheets of furniture
    body = mesh if len(mesh.faces) <= FULL else make_display_mesh(mesh, triangles=FULL, texture_size=FULL_TEXTURE)
    for name in VISUALS.values():
        write_glb(body, folder / name)
    write_hulls(folder / HULLS, pieces)


def _light(values: Any) -> Any:
    """Convert numbers to float32, which halves the file size; lengths change by less than 1e-6 m."""
    return np.asarray(values, dtype=np.float32)


def _hashes(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): sha256(path) for path in files}
