"""Render the scenes of a protocol, and number the visible objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from mani_skill.utils import sapien_utils
from numpy.typing import NDArray

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.poses import Array, from_wxyz, transform_points
from robocas_ms3.datasets.conversion.env_renderer import EnvRenderer
from robocas_ms3.datasets.images.image_files import ImageOptions, compute_bounding_box
from robocas_ms3.datasets.sources.episode_source import FIRST_SLOT
from robocas_ms3.demos.difficulty.records import SceneDifficulty
from robocas_ms3.demos.recordings.environment import RecordedEnv
from robocas_ms3.evaluation.protocols.protocol import LoadedProtocol, ProtocolEpisode
from robocas_ms3.evaluation.removal_questions.marks import draw_numbers
from robocas_ms3.evaluation.removal_questions.records import (
    NumberedObject,
    RemovalQuestion,
    make_question_text,
    name_image,
)
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.config.cameras import CameraConfig
from robocas_ms3.scenes.task_specs import TASKS

SIZE = (960, 720)  # width and height, pixels
MIN_PIXELS = 600  # visible pixels from which an object gets a number
_CAMERA, _FOV_DEG, _ELEVATION_DEG = "question_camera", 40.0, 55.0
_RADII = (0.14, 0.26)  # m, smallest and largest radius around the objects that the image shows
_OBJECT_RADIUS = 0.06  # m that an object extends beyond its centre
_SPACING = 0.005  # m between the surface points of objects
_STREAM = 421  # random stream of the numbers


class QuestionRenderer:
    """Renderer of the scenes of one configuration of a protocol.

    The camera looks at the objects from the side that is opposite to the robot, 55 degrees above the horizon.

    Args:
        protocol: protocol of the scenes.
        config: name of the configuration.
    """

    def __init__(self, protocol: LoadedProtocol, config: str) -> None:
        task_config = load_task_config(protocol.config_file(config))
        camera = CameraConfig(position=(0, 0, 1), rotation_deg=(0, 90, 0), fov_deg=_FOV_DEG)
        task_config = task_config.model_copy(update={"cameras": {**task_config.cameras, _CAMERA: camera}})
        scene = {
            "config": task_config.model_dump(mode="json"),
            "pack": protocol.rules.pack,
            "robot_uids": protocol.rules.robot,
            "layouts": str(protocol.layouts_file(config)),
        }
        env = RecordedEnv(TASKS[task_config.task].env_id, None, scene)
        options = ImageOptions((_CAMERA,), SIZE, depth=False, segmentation=True)
        self._renderer = EnvRenderer(env, "pd_joint_pos", options)
        self._env: Any = self._renderer.env.unwrapped

    def make_question(
        self, episode: ProtocolEpisode, scene: SceneDifficulty
    ) -> tuple[RemovalQuestion, NDArray[np.uint8]] | None:
        """Return the question about the scene of an episode and its image (H, W, 3); None: there is no question.

        There is no question if nothing has to be removed, if the search for removals was not complete, if no correct
        object gets a number, or if all numbers are correct.

        Args:
            episode: episode of the protocol.
            scene: difficulty of its scene.

        Raises:
            EvaluationError: the scene differs from the episode.
        """
        if not (scene.removals and scene.first_removals and scene.complete):
            return None
        rgb, segmentation, points = self._render(episode)
        target = int(self._env.target_slot[0])
        sizes = np.bincount(segmentation.ravel(), minlength=FIRST_SLOT + len(self._env.objects))
        visible = [slot for slot in points if slot != target and sizes[FIRST_SLOT + slot] >= MIN_PIXELS]
        numbers = number_slots(visible, scene.seed)
        answers = sorted(numbers[slot] for slot in scene.first_removals if slot in numbers)
        if not answers or len(answers) == len(numbers):
            return None
        assets = self._env.object_assets[0]
        objects = []
        for slot, number in sorted(numbers.items(), key=lambda item: item[1]):
            box = compute_bounding_box(segmentation == FIRST_SLOT + slot)
            assert box is not None  # it has MIN_PIXELS visible pixels
            objects.append(NumberedObject(number, slot, assets[slot].asset.id, assets[slot].asset.name, box))
        question = RemovalQuestion(
            episode=episode.episode,
            image=name_image(episode.episode),
            instruction=episode.instruction,
            question=make_question_text(episode.instruction, assets[target].asset.name),
            objects=objects,
            answers=answers,
            removals=scene.removals,
            target_box=compute_bounding_box(segmentation == FIRST_SLOT + target),
            highest=numbers[max(numbers, key=lambda slot: points[slot][:, 2].max())],
            scripted=None if scene.scripted_removal is None else numbers.get(scene.scripted_removal),
        )
        return question, _draw_slots(rgb, segmentation, numbers)

    def render_question(self, episode: ProtocolEpisode, question: RemovalQuestion) -> NDArray[np.uint8]:
        """Return the image (H, W, 3) of a question.

        Raises:
            EvaluationError: the scene differs from the episode or from the question.
        """
        rgb, segmentation, points = self._render(episode)
        for numbered in question.objects:
            asset = self._env.object_assets[0][numbered.slot].asset.id if numbered.slot in points else None
            if asset != numbered.asset or not (segmentation == FIRST_SLOT + numbered.slot).any():
                what, where = "the scene differs from the question", f"episode {episode.episode}, slot {numbered.slot}"
                found = "no object" if asset is None else f"{asset}, which is not visible"
                found = found if asset in (None, numbered.asset) else asset
                raise EvaluationError(what, where=where, expected=numbered.asset, found=found)
        return _draw_slots(rgb, segmentation, {numbered.slot: numbered.number for numbered in question.objects})

    def close(self) -> None:
        """Close the environment."""
        self._renderer.close()

    def _render(self, episode: ProtocolEpisode) -> tuple[NDArray[np.uint8], NDArray[np.uint8], dict[int, Array]]:
        """Return image (H, W, 3), segmentation (H, W) and the surface points of each object by slot."""
        self._renderer.load_seed(episode.seed)
        found = self._env.target_asset().asset.id
        if found != episode.target:
            what, fix = "the scene has another target", "Use the object pack of the protocol."
            where = f"episode {episode.episode}, seed {episode.seed}"
            raise EvaluationError(what, where=where, expected=episode.target, found=found, fix=fix)
        points = self._list_surface_points()
        self._renderer.move_camera(_CAMERA, self._find_camera_pose(list(points.values())))
        images = self._renderer.render()
        return images.rgb[_CAMERA], images.segmentation[_CAMERA], points

    def _list_surface_points(self) -> dict[int, Array]:
        """Return surface points (P, 3) of each object in the world frame in m, by slot."""
        poses = from_wxyz(self._env.object_states[0, :, :7])
        return {
            slot: transform_points(poses[slot], self._env.object_assets[0][slot].surface_points(_SPACING))
            for slot in np.flatnonzero(self._env.present[0].cpu().numpy()).tolist()
        }

    def _find_camera_pose(self, points: Sequence[Array]) -> Array:
        """Return the pose (4, 4) in the world frame from which the camera sees the objects."""
        centers = np.stack([surface.mean(axis=0) for surface in points])
        middle = np.median(centers, axis=0)
        radius = float(np.clip(np.linalg.norm(centers - middle, axis=1).max() + _OBJECT_RADIUS, *_RADII))
        away = middle - self._env.agent.arm_base_link.pose.raw_pose[0, :3].cpu().numpy()
        away[2] = 0
        elevation = np.deg2rad(_ELEVATION_DEG)
        direction = np.cos(elevation) * away / np.linalg.norm(away) + np.sin(elevation) * np.array([0.0, 0.0, 1.0])
        eye = middle + radius / np.sin(np.deg2rad(_FOV_DEG / 2)) * direction
        return from_wxyz(sapien_utils.look_at(eye.tolist(), middle.tolist()).raw_pose[0])


def number_slots(slots: Sequence[int], seed: int) -> dict[int, int]:
    """Return the number of each slot, from 1 on, in a random order that depends on the seed and the number of slots."""
    order = np.random.default_rng([seed, _STREAM]).permutation(len(slots))
    return {slot: int(place) + 1 for slot, place in zip(slots, order, strict=True)}


def _draw_slots(
    rgb: NDArray[np.uint8], segmentation: NDArray[np.uint8], numbers: Mapping[int, int]
) -> NDArray[np.uint8]:
    return draw_numbers(rgb, {number: segmentation == FIRST_SLOT + slot for slot, number in numbers.items()})
