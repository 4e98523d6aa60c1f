"""Render small images of meshes with SAPIEN; metres, z up."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import sapien
from numpy.typing import NDArray
from PIL import Image

from robocas_ms3.core.errors import AssetError

Array = NDArray[np.float64]
Colour = tuple[float, float, float]  # 0 to 1

PAPER = (244, 244, 241)  # background colour
OVERSAMPLING = 2
_SHADER = str(Path(sapien.__file__).parent / "vulkan_shader" / "default")
MARGIN = 1.06  # size of the frame over that of its content


@dataclass(frozen=True)
class RenderBody:
    """A body in an image, given by a mesh file or by triangles.

    Attributes:
        points: (N, 3) points in the body's frame; the camera is moved so that all of them are visible. May be empty.
        file: mesh file, or None.
        faces: (F, 3, 3) corners of flat-shaded triangles, or None.
        colour: colour of the triangles.
        pose: (4, 4) pose of the body in the world frame.
    """

    points: Array
    file: Path | None = None
    faces: Array | None = None
    colour: Colour = (0.6, 0.6, 0.6)
    pose: Array = field(default_factory=lambda: np.eye(4))


class Renderer:
    """A scene with lights and an orthographic camera, which renders bodies.

    Args:
        size: width and height of the images in pixels.

    Raises:
        AssetError: no render device is available.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        try:
            self._scene = sapien.Scene([sapien.render.RenderSystem()])
        except RuntimeError as error:
            fix = "Install a Vulkan driver; see `robocas doctor`."
            raise AssetError("no render device is available", found=error, fix=fix) from error
        self._scene.set_ambient_light([0.45, 0.45, 0.45])
        self._sun = self._scene.add_directional_light([0, 0, -1], [1.7, 1.7, 1.7])
        self._fill = self._scene.add_directional_light([0, 0, -1], [0.6, 0.6, 0.6])
        # the shader is given by name, since environments in this process change the default shader of all cameras
        self._camera = sapien.render.RenderCameraComponent(size * OVERSAMPLING, size * OVERSAMPLING, _SHADER)
        holder = sapien.Entity()
        holder.add_component(self._camera)
        self._scene.add_entity(holder)

    def render(self, bodies: Sequence[RenderBody], azimuth: float, elevation: float) -> Image.Image:
        """Return an image of bodies, which fill the frame.

        Args:
            bodies: the bodies.
            azimuth: direction from the bodies to the camera, degrees from +x about +z.
            elevation: angle of this direction above the horizon, degrees.
        """
        entities = [self._entity(body) for body in bodies]
        for entity in entities:
            self._scene.add_entity(entity)
        points = np.concatenate([body.points @ body.pose[:3, :3].T + body.pose[:3, 3] for body in bodies])
        self._aim(points, np.radians(azimuth), np.radians(elevation))
        self._scene.update_render()
        self._camera.take_picture()
        rgba = self._camera.get_picture("Color")
        rgba = np.clip(rgba, 0, 1) if rgba.dtype.kind == "f" else rgba / 255
        for entity in entities:
            self._scene.remove_entity(entity)
        flat = rgba[..., :3] * 255 * rgba[..., 3:] + np.array(PAPER) * (1 - rgba[..., 3:])
        return Image.fromarray(np.rint(flat).astype(np.uint8)).reduce(OVERSAMPLING)

    def _aim(self, points: Array, azimuth: float, elevation: float) -> None:
        forward = -np.array(
            [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
        )
        left = np.cross([0, 0, 1], forward)
        left /= np.linalg.norm(left)
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([forward, left, np.cross(forward, left)])
        seen = points @ pose[:3, :3]
        low, high = seen.min(axis=0), seen.max(axis=0)
        half = MARGIN * (high - low)[1:].max() / 2
        reach = float(np.linalg.norm(high - low))
        middle = (low + high) / 2
        pose[:3, 3] = pose[:3, :3] @ (middle - [reach, 0, 0])
        self._camera.set_local_pose(sapien.Pose(pose))
        self._camera.set_orthographic_parameters(reach * 0.01, reach * 3, half)
        for light, turn, down in ((self._sun, 0.9, 1.1), (self._fill, -0.8, 0.5)):
            away = forward + turn * left - down * np.array([0, 0, 1])
            light.set_entity_pose(sapien.Pose(q=_rotation_from_x(away).tolist()))

    @staticmethod
    def _entity(body: RenderBody) -> sapien.Entity:
        component = sapien.render.RenderBodyComponent()
        if body.file is not None:
            component.attach(sapien.render.RenderShapeTriangleMesh(str(body.file)))
        if body.faces is not None:
            corners = body.faces.reshape(-1, 3).astype(np.float32)
            normals = np.cross(body.faces[:, 1] - body.faces[:, 0], body.faces[:, 2] - body.faces[:, 0])
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
            material = sapien.render.RenderMaterial(base_color=[*body.colour, 1], roughness=0.7, specular=0.2)
            component.attach(
                sapien.render.RenderShapeTriangleMesh(
                    corners,
                    np.arange(len(corners), dtype=np.uint32).reshape(-1, 3),
                    np.repeat(normals, 3, axis=0).astype(np.float32),
                    np.zeros((len(corners), 2), np.float32),
                    material,
                )
            )
        entity = sapien.Entity()
        entity.add_component(component)
        entity.set_pose(sapien.Pose(body.pose))
        return entity


def make_box_faces(lower_corner: Iterable[float], upper_corner: Iterable[float]) -> Array:
    """Return the triangles (12, 3, 3) of an axis-aligned box.

    Args:
        lower_corner: (3,) lower corner.
        upper_corner: (3,) upper corner.
    """
    corners = (
        np.array(np.meshgrid(*zip(lower_corner, upper_corner, strict=True), indexing="ij"), dtype=float).reshape(3, 8).T
    )
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return np.array([[corners[a], corners[b], corners[c]] for q in quads for a, b, c in (q[:3], (q[0], q[2], q[3]))])


def _rotation_from_x(direction: Array) -> Array:
    """Return the quaternion wxyz of the shortest rotation from +x to a direction (3,)."""
    direction = direction / np.linalg.norm(direction)
    if direction[0] < -0.999999:
        return np.array([0.0, 0.0, 0.0, 1.0])
    quaternion = np.array([1 + direction[0], 0.0, -direction[2], direction[1]])
    return quaternion / np.linalg.norm(quaternion)
