"""Draw contact sheets: one image with all assets of a pack, their hulls, poses, grasps and joints."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from asset_tools.quality.measure import select_top_grasps
from asset_tools.renderer import PAPER, Colour, RenderBody, Renderer, make_box_faces
from robocas_ms3.assets.annotations import Annotations
from robocas_ms3.assets.hulls import Hull
from robocas_ms3.assets.kinematics import link_poses
from robocas_ms3.assets.manifest import FurnitureAsset, ObjectAsset
from robocas_ms3.assets.pack import LoadedFurniture, LoadedObject, Pack
from robocas_ms3.core.errors import AssetError
from robocas_ms3.core.poses import from_wxyz

Array = NDArray[np.float64]
LabelledImage = tuple[str, Image.Image]

CELLS = 5  # images per asset in a row
LARGE, SMALL = 220, 154  # px, size of an image for packs with few and with many assets
FEW = 16
GAP, CAPTION, LABEL = 6, 33, 14  # px: gap between assets, height of the text above and below the images
POSES = 4
GROUND, GREY, RED = (0.80, 0.80, 0.78), (0.55, 0.55, 0.55), (0.9, 0.1, 0.1)
INK, FAINT = (25, 25, 25), (120, 120, 120)
FINGER = 0.003  # m, thickness of drawn grippers


def write_contact_sheet(pack: Pack, path: Path, ids: Sequence[str] | None = None) -> None:
    """Draw the assets of a pack and write the contact sheet as PNG.

    Args:
        pack: the pack.
        path: path of the PNG file.
        ids: ids of the assets to draw, in this order; None or empty: all objects, then all furniture.

    Raises:
        AssetError: an id is unknown, or no render device is available.
    """
    assets: dict[str, LoadedObject | LoadedFurniture] = {**pack.objects, **pack.furniture}
    unknown = [id_ for id_ in ids or () if id_ not in assets]
    if unknown:
        expected, fix = "ids of assets of the pack", f"Run `robocas assets info {pack.name}` for the ids."
        raise AssetError(
            "unknown asset ids", where=pack.name, expected=expected, found=", ".join(unknown), fix=fix, usage=True
        )
    chosen = [assets[id_] for id_ in ids or assets]
    size, columns = (LARGE, 2) if len(chosen) <= FEW else (SMALL, 3)
    columns = min(columns, len(chosen))
    renderer = Renderer(size)
    width, height = CELLS * size, CAPTION + size + LABEL
    rows = -(-len(chosen) // columns)
    sheet = Image.new("RGB", (columns * (width + GAP) + GAP, rows * (height + GAP) + GAP), "white")
    for i, asset in enumerate(chosen):
        strip = _strip(renderer, asset)
        sheet.paste(strip, (GAP + i % columns * (width + GAP), GAP + i // columns * (height + GAP)))
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(path)


def _strip(renderer: Renderer, asset: LoadedObject | LoadedFurniture) -> Image.Image:
    if isinstance(asset, LoadedObject):
        title, line, images = asset.asset.id, _object_line(asset.asset), _object_images(renderer, asset)
        if asset.asset.graspnet_id is not None:
            title += f"  ({asset.asset.graspnet_id})"
    else:
        title, line, images = asset.asset.id, _furniture_line(asset), _furniture_images(renderer, asset)
    size = renderer.size
    strip = Image.new("RGB", (CELLS * size, CAPTION + size + LABEL), PAPER)
    draw = ImageDraw.Draw(strip)
    draw.text((4, 0), title, INK, _font(15))
    draw.text((4, 17), line, INK, _font(12))
    for i, (label, image) in enumerate(images):
        strip.paste(image, (i * size, CAPTION))
        draw.text((i * size + 4, CAPTION + size), label, FAINT, _font(11))
    return strip


def _object_line(asset: ObjectAsset) -> str:
    quality = asset.quality
    size = " x ".join(f"{1000 * value:.0f}" for value in asset.extents)
    fit = f"IoU {quality.volume_iou:.2f}" if quality.compact else f"p95 {1000 * quality.surface_p95:.1f} mm"
    rest = f"{quality.rest_share:.0%} rest"
    held = f"{quality.grasps_held:.0%} hold" if quality.grasps_tried else "none tried"
    hulls = _count(quality.hull_count, "hull")
    return f"{size} mm, {1000 * asset.mass:.0f} g, {hulls}, {fit}, {rest}, {asset.grasp_count} grasps, {held}"


def _furniture_line(furniture: LoadedFurniture) -> str:
    asset: FurnitureAsset = furniture.asset
    size = " x ".join(f"{value:.2f}" for value in asset.extents)
    parts = [f"{size} m", "fixed" if asset.mass is None else f"{asset.mass:.2f} kg"]
    parts += [_count(asset.quality.hull_count, "hull"), _count(len(asset.surfaces), "surface")]
    parts += [_count(len(asset.links), "joint"), _count(len(asset.handles), "handle")] if asset.links else []
    parts += [f"{len(names)} {part} finishes" for part, names in asset.finishes.items()]
    return ", ".join(parts)


def _object_images(renderer: Renderer, asset: LoadedObject) -> list[LabelledImage]:
    notes = asset.annotations
    points, tried = np.concatenate(asset.hulls), select_top_grasps(notes)
    fast = RenderBody(points, file=asset.visual_path("fast"))
    grippers = [
        _solid(make_gripper_faces(float(width)), _tone(float(quality)), pose)
        for pose, width, quality in zip(
            *(values[tried] for values in (notes.grasps_tcp_in_object, notes.grasp_widths, notes.grasp_qualities)),
            strict=True,
        )
    ]
    best = _shown_poses(notes)
    chances = " ".join(f"{notes.resting_probabilities[i]:.0%}" for i in best)
    return [
        ("fast", renderer.render([fast], -60, 25)),
        ("full, from behind", renderer.render([RenderBody(points, file=asset.visual_path("full"))], 120, 25)),
        ("hulls", renderer.render(make_hull_bodies(asset.hull_meshes), -60, 25)),
        (f"rests {chances}", renderer.render(place_in_grid(fast, notes.resting_poses[best]), -60, 30)),
        (f"best {len(grippers)} of {len(notes.grasp_widths)} grasps", renderer.render([fast, *grippers], -60, 30)),
    ]


def _shown_poses(notes: Annotations) -> list[int]:
    """Return the indices of at most four resting poses: the upright pose, then the most probable poses."""
    order = [int(i) for i in np.argsort(-notes.resting_probabilities, kind="stable")]
    if notes.display_pose >= 0:
        order = [notes.display_pose, *(i for i in order if i != notes.display_pose)]
    return order[:POSES]


def _furniture_images(renderer: Renderer, furniture: LoadedFurniture) -> list[LabelledImage]:
    asset = furniture.asset
    parts = {"": furniture, **furniture.links}
    wide = {link.joint.name: max(link.joint.limits, key=abs) for link in asset.links}
    shut, open_ = ({"": np.eye(4), **link_poses(asset.links, at)} for at in ({}, wide))

    def make_bodies(poses: dict[str, Array]) -> list[RenderBody]:
        bodies = [
            RenderBody(np.concatenate(part.hulls), file=part.visual_path("fast"), pose=poses[name])
            for name, part in parts.items()
        ]
        finishes = [furniture.finish_path(part, names[0]) for part, names in asset.finishes.items()]
        return bodies + [RenderBody(np.empty((0, 3)), file=path) for path in finishes]

    hulls = [
        body
        for i, (name, part) in enumerate(parts.items())
        for body in make_hull_bodies(part.hull_meshes, pose=open_[name], first_colour=i)
    ]
    thick = 0.004 * max(asset.extents)
    marks = []
    for i, surface in enumerate(asset.surfaces.values()):
        faces = make_box_faces((*surface.min_xy, surface.z), (*surface.max_xy, surface.z + thick))
        marks.append(_solid(faces, _hue(i), open_[surface.link]))
    for handle in asset.handles.values():
        grasp = from_wxyz(np.array([*handle.position, *handle.wxyz]))
        marks.append(_solid(make_gripper_faces(handle.width, thick), RED, open_[handle.link] @ grasp))
    points = np.concatenate([body.points for body in make_bodies(shut)])
    edges = _solid(make_frame_faces(points.min(axis=0), points.max(axis=0), thick / 2), GREY)
    front, behind = ("closed", "open") if asset.links else ("front", "behind")
    return [
        (front, renderer.render(make_bodies(shut), 30, 25)),
        (behind, renderer.render(make_bodies(open_), 30 if asset.links else 210, 25)),
        ("hulls", renderer.render(hulls, 30, 25)),
        ("surfaces, handles", renderer.render([edges, *marks], 30, 25)),
        ("from above", renderer.render([*make_bodies(open_), *marks], 30, 70)),
    ]


def make_hull_bodies(hulls: Sequence[Hull], *, pose: Array | None = None, first_colour: int = 0) -> list[RenderBody]:
    """Return one body per hull in different colours, each shrunk by 3 % so that all hulls are visible.

    Args:
        hulls: convex hulls in one frame, m.
        pose: pose (4, 4) of this frame; None: identity.
        first_colour: number of the colour of the first hull.
    """
    bodies = []
    for i, hull in enumerate(hulls):
        middle = hull.vertices.mean(axis=0)
        small = middle + 0.97 * (hull.vertices - middle)
        colour = _hue(i + first_colour)
        bodies.append(
            RenderBody(hull.vertices, faces=small[hull.faces], colour=colour, pose=np.eye(4) if pose is None else pose)
        )
    return bodies


def place_in_grid(body: RenderBody, poses: Array) -> list[RenderBody]:
    """Return a slab with copies of a body on it, in a grid of two columns.

    Args:
        body: the object, whose pose is ignored.
        poses: (N, 4, 4) resting pose of each copy.
    """
    turned = [body.points @ pose[:3, :3].T + pose[:3, 3] for pose in poses]
    step = 1.12 * np.max([np.ptp(points[:, :2], axis=0) for points in turned], axis=0) + 0.01
    bodies = []
    for i, (pose, points) in enumerate(zip(poses, turned, strict=True)):
        moved = np.array(pose, dtype=float)
        moved[:2, 3] += (i % 2, i // 2) * step - (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2
        bodies.append(RenderBody(body.points, file=body.file, pose=moved))
    places = np.array([(i % 2, i // 2) for i in range(len(poses))])
    slab = make_box_faces((*(-0.5 * step), -0.004), (*((places.max(axis=0) + 0.5) * step), 0.0))
    return [*bodies, _solid(slab, GROUND)]


def make_gripper_faces(width: float, thickness: float = FINGER) -> Array:
    """Return the triangles (F, 3, 3) of a symbol of the gripper, made of thin boxes, in the TCP frame.

    Args:
        width: distance of the fingers, m.
        thickness: thickness of the boxes, m.
    """
    half, t = width / 2, thickness / 2
    fingers = [((-t, y - t, -0.04), (t, y + t, 0.0085)) for y in (-half - t, half + t)]
    palm = ((-t, -half - thickness, -0.04 - thickness), (t, half + thickness, -0.04))
    stem = ((-t, -t, -0.08), (t, t, -0.04 - thickness))
    return np.concatenate([make_box_faces(low, high) for low, high in (*fingers, palm, stem)])


def make_frame_faces(lower_corner: Array, upper_corner: Array, half_thickness: float) -> Array:
    """Return the triangles (F, 3, 3) of bars along the edges of a box.

    Args:
        lower_corner: (3,) lower corner of the box.
        upper_corner: (3,) upper corner of the box.
        half_thickness: half of the thickness of the bars.
    """
    bars = []
    for a, b in ((1, 2), (0, 2), (0, 1)):
        for i, j in np.ndindex(2, 2):
            start, end = lower_corner.copy(), upper_corner.copy()
            start[[a, b]] = end[[a, b]] = (lower_corner, upper_corner)[i][a], (lower_corner, upper_corner)[j][b]
            bars.append(make_box_faces(start - half_thickness, end + half_thickness))
    return np.concatenate(bars)


def _solid(faces: Array, colour: Colour, pose: Array | None = None) -> RenderBody:
    return RenderBody(faces.reshape(-1, 3), faces=faces, colour=colour, pose=np.eye(4) if pose is None else pose)


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"


def _hue(i: int) -> Colour:
    """Return the i-th colour of a series of distinct colours."""
    return colorsys.hsv_to_rgb(0.07 + i * 0.618034 % 1, 0.62, 0.9 - 0.25 * (i % 3 == 2))


def _tone(friction: float) -> Colour:
    """Return the colour of a grasp: green if the required friction is 0, red from 0.8 on."""
    return colorsys.hsv_to_rgb(max(0.0, 0.33 * (1 - friction / 0.8)), 0.9, 0.8)


def _font(size: int) -> ImageFont.ImageFont | ImageFont.FreeTypeFont:
    return ImageFont.load_default(size)
