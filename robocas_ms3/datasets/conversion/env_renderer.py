"""Render recorded states with the cameras of ManiSkill in the scene of the seed, without physics."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
import sapien
import torch
from mani_skill.render.shaders import ShaderConfig
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import robocas_ms3.tasks  # noqa: F401  (registers the environments)
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import Array
from robocas_ms3.datasets.images.image_files import Box, ImageOptions, compute_bounding_box
from robocas_ms3.datasets.sources.episode_source import BASKET, FIRST_SLOT, ROBOT, StepImages
from robocas_ms3.demos.recordings.environment import RecordedEnv
from robocas_ms3.demos.recordings.trajectory_file import Recording
from robocas_ms3.robots.camera_models import CameraModel

_SAME_PLACE = 1e-3  # m


class EnvRenderer:
    """Renders the images of recorded states in the environment that recorded them, without physics."""

    def __init__(self, env: RecordedEnv, control_mode: str, image_options: ImageOptions | None = None) -> None:
        sensors = dict(env.kwargs.get("sensor_configs") or {})
        self._image_options = (image_options or ImageOptions()).select_cameras(
            [camera.name for camera in env.cameras()], env.env_id
        )
        if self._image_options.size is not None:
            sensors["width"], sensors["height"] = self._image_options.size
        require_renderer()
        options = self._image_options
        self.env = env.make(
            obs_mode="+".join(
                [*self._image_options.kinds, *(["segmentation"] if options.boxes or options.segmentation else [])]
            ),
            control_mode=control_mode,
            num_envs=1,
            sim_backend="physx_cpu",
            sensor_configs=sensors,
        )
        self._base: Any = self.env.unwrapped

    def close(self) -> None:
        self.env.close()

    def load_scene(self, recording: Recording) -> None:
        """Build the scene of a recording; raise DatasetError if it differs from the recorded scene."""
        self.load_seed(recording.seed, recording.reset_options)
        self._check_scene(recording)

    def load_seed(self, seed: int, reset_options: Mapping[str, Any] = MappingProxyType({})) -> None:
        """Build the scene of a seed."""
        self.env.reset(seed=seed, options=dict(reset_options))
        for name in set(self._base._sensors) - set(self._image_options.cameras):
            del self._base._sensors[name]  # made again at each reset; all remaining sensors are rendered

    def _check_scene(self, recording: Recording) -> None:

        def raise_difference(name: str, expected: object, found: object) -> None:
            where = f"episode {recording.episode_id}, seed {recording.seed}{f', {name}' if name else ''}"
            what, fix = "the rebuilt scene differs", "Use the pack, configuration and versions of the recording."
            raise DatasetError(what, where=where, expected=expected, found=found, fix=fix)

        built = self._base.get_state_dict()
        for kind in ("actors", "articulations"):
            rebuilt, recorded = set(built.get(kind, {})), set(recording.states.get(kind, {}))
            if rebuilt != recorded:
                raise_difference("", sorted(recorded), sorted(rebuilt))
        for name, states in () if recording.is_intervention else recording.states.get("actors", {}).items():
            distance = float(np.linalg.norm(built["actors"][name][0, :3].cpu().numpy() - states[0, :3]))
            if distance > _SAME_PLACE:
                raise_difference(name, "the recorded position", f"{distance * 1000:.1f} mm off")
        instruction = self._base.get_language_instruction()[0]
        if instruction != recording.instruction:
            raise_difference("", recording.instruction, instruction)

    def frames(self, recording: Recording, samples: NDArray[np.int64]) -> Iterator[StepImages]:
        """Render the states ``samples`` (indices) of the loaded recording; yield the images of each."""
        for index in samples:
            yield self._render_state(recording.state(int(index)))

    @contextmanager
    def select_cameras(self, names: Collection[str]) -> Iterator[None]:
        """Open a context in which only some of the cameras are rendered."""
        base, sensors = self._base, self._base._sensors
        base._sensors = base.scene.sensors = {name: sensor for name, sensor in sensors.items() if name in names}
        try:
            yield
        finally:
            base._sensors = base.scene.sensors = sensors

    def _render_state(self, state: dict[str, dict[str, NDArray[np.float32]]]) -> StepImages:
        tensors = {kind: {k: torch.from_numpy(v) for k, v in arrays.items()} for kind, arrays in state.items()}
        self._base.set_state_dict(tensors)
        return self.render()

    def render(self) -> StepImages:
        """Render the present state of the scene."""
        textures, options = self._base._get_obs_sensor_data(apply_texture_transforms=False), self._image_options
        shaders = {name: sensor.config.shader_config for name, sensor in self._base._sensors.items()}
        ids = {}
        if options.boxes or options.segmentation:
            ids = {name: _convert_segmentation(textures[name], shader) for name, shader in shaders.items()}
        values = self._find_segmentation_values() if options.segmentation else None
        return StepImages(
            rgb={name: _convert_rgb(textures[name], shader) for name, shader in shaders.items()},
            depth={name: _convert_depth(textures[name], shader) for name, shader in shaders.items() if options.depth},
            boxes=self._find_boxes(ids) if options.boxes else {},
            segmentation={} if values is None else {name: values[of] for name, of in ids.items()},
        )

    def _find_segmentation_values(self) -> NDArray[np.uint8]:
        """Return the value of a segmentation image by the id of an actor or link."""
        base = self._base
        bodies = {FIRST_SLOT + slot: actor for slot, actor in enumerate(base.objects)}
        if base.fixtures.basket is not None:
            bodies[BASKET] = base.fixtures.basket
        links = [int(link.per_scene_id[0]) for link in base.agent.robot.links]
        numbers = {int(body.per_scene_id[0]): value for value, body in bodies.items()} | dict.fromkeys(links, ROBOT)
        values = np.zeros(max(np.iinfo(np.int16).max + 1, *numbers), np.uint8)
        values[list(numbers)] = list(numbers.values())
        return values

    def _find_boxes(self, ids: dict[str, NDArray[np.int16]]) -> dict[str, Box]:
        """Return the bounding box of the target's visible pixels, by camera; only cameras that see it.

        ids: (H, W) id of the actor or link per pixel, by camera.
        """
        slot = int(self._base.target_slot[0])
        number = int(self._base.scene.actors[f"object_{slot}"].per_scene_id[0])
        return {name: box for name, of in ids.items() if (box := compute_bounding_box(of == number)) is not None}

    def move_camera(self, name: str, pose_in_mount: Array) -> None:
        """Move a camera in the loaded scene.

        Args:
            name: name of the camera.
            pose_in_mount: (4, 4) pose of the camera in the frame of its mount; the camera looks along x, z is up.
        """
        self._base._sensors[name].camera.set_local_pose(sapien.Pose(pose_in_mount))

    def cameras(self) -> dict[str, CameraModel]:
        """Return intrinsics and poses of each rendered camera in the loaded scene, by name."""
        return self._base.camera_models()[0]

    def scene(self) -> dict[str, Any]:
        """Return task, configuration, layout and objects of the scene, as in ``scene.json``."""
        env = self._base
        layout = env.layout()
        return {
            "task": env.SPEC.name,
            "config": env.task_config.model_dump(mode="json"),
            "layout": {
                "object_ids": list(layout.object_ids),
                "poses": [_pose_values(pose) for pose in layout.object_poses],
                "present": layout.present.tolist(),
                "robot_pose": _pose_values(layout.robot_pose),
                "basket_pose": None if layout.basket_pose is None else _pose_values(layout.basket_pose),
                "relation": layout.relation,
            },
            "objects": [
                {"slot": slot, "id": asset.asset.id, "name": asset.asset.name}
                for slot, asset in enumerate(env.object_assets[0])
                if layout.present[slot]
            ],
        }


def _pose_values(pose: NDArray[np.float64]) -> list[float]:
    """Return x, y, z, qw, qx, qy, qz of a pose (4, 4)."""
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
    return [round(float(value), 9) for value in (*pose[:3, 3], quaternion[3], *quaternion[:3])]


def require_renderer() -> None:
    """Raise DatasetError if there is no render device."""
    try:
        sapien.render.RenderMaterial()  # cheapest call that needs the device
    except RuntimeError as error:
        fix = "Run scripts/setup.sh or install a Vulkan driver; robocas doctor shows details."
        raise DatasetError("no render device", fix=fix) from error


def _convert_rgb(textures: dict[str, torch.Tensor], shader: ShaderConfig) -> NDArray[np.uint8]:
    """Convert the textures of a camera to an RGB image (H, W, 3)."""
    colour = textures["Color"]
    if colour.dtype == torch.uint8:  # OpenCV takes 0.03 ms to drop alpha at 640 x 480, copying a slice 2
        return cv2.cvtColor(colour[0].cpu().numpy(), cv2.COLOR_RGBA2RGB).astype(np.uint8, copy=False)
    return np.ascontiguousarray(shader.texture_transforms["Color"](colour)["rgb"][0].cpu().numpy())


def _convert_depth(textures: dict[str, torch.Tensor], shader: ShaderConfig) -> NDArray[np.uint16]:
    """Convert the textures of a camera to depth (H, W) in mm; 0 = no surface in front of the camera."""
    name = next(name for name, kinds in shader.texture_names.items() if "depth" in kinds)
    depth = shader.texture_transforms[name](textures[name])["depth"][0, ..., 0]  # int16
    return depth.clamp(min=0).cpu().numpy().astype(np.uint16)


def _convert_segmentation(textures: dict[str, torch.Tensor], shader: ShaderConfig) -> NDArray[np.int16]:
    """Convert the textures of a camera to the id of the actor or link per pixel (H, W), 0 = none."""
    name = next(name for name, kinds in shader.texture_names.items() if "segmentation" in kinds)
    return shader.texture_transforms[name](textures[name])["segmentation"][0, ..., 0].cpu().numpy()
