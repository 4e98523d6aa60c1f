"""Render the scene of a question, and number the visible objects."""

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
from robocas_ms3.demos.difficulty.difficulty_file import DifficultySettings
from robocas_ms3.demos.difficulty.records import SceneDifficulty
from robocas_ms3.demos.recordings.environment import RecordedEnv
from robocas_ms3.evaluation.removal_questions.marks import draw_numbers
from robocas_ms3.evaluation.removal_questions.records import NumberedObject, RemovalQuestion, make_question_text
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.config.cameras import CameraConfig
from robocas_ms3.scenes.task_specs import TASKS

SIZE = (960, 720)  # width and height, pixels
MIN_PIXELS = 250  # visible pixels from which an object gets a number
_CAMERA, _FOV_DEG, _ELEVATION_DEG = "question_camera", 40.0, 55.0
_RADII = (0.14, 0.26)  # m, smallest and largest radius around the objects that the image shows
_OBJECT_RADIUS = 0.06  # m that an object extends beyond its centre
_SPACING = 0.005  # m between the surface points of objects
_STREAM = 421  # random stream of the numbers


class QuestionRenderer:
    """Renderer of the scenes of one configuration.

    The camera looks at the objects from the side that is opposite to the robot, 55 degrees above the horizon.

    Args:
        settings: settings of the scenes.
        name: name of the scenes, for the ids of the questions.
    """

    def __init__(self, settings: DifficultySettings, name: str) -> None:
        config, self._name = load_task_config(settings.config), name
        camera = CameraConfig(position=(0, 0, 1), rotation_deg=(0, 90, 0), fov_deg=_FOV_DEG)
        config = config.model_copy(update={"cameras": {**config.cameras, _CAMERA: camera}})
        scene = {"config": config.model_dump(mode="json"), "pack": settings.pack}
        env = RecordedEnv(TASKS[settings.task].env_id, None, scene)
        options = ImageOptions((_CAMERA,), SIZE, depth=False, segmentation=True)
        self._renderer = EnvRenderer(env, "pd_joint_pos", options)
        self._env: Any = self._renderer.env.unwrapped

    def make_question(self, scene: SceneDifficulty) -> tuple[RemovalQuestion, NDArray[np.uint8]] | None:
        """Return the question about a scene and its image (H, W, 3); None: there is no question.

        There is no question if nothing has to be removed, no right answer is visible, or all numbers are right.

        Args:
            scene: difficulty of the scene.
        """
        if not scene.removals or not scene.first_removals:
            return None
        rgb, segmentation, points = self._render(scene.seed)
        target = int(self._env.target_slot[0])
        sizes = np.bincount(segmentation.ravel(), minlength=FIRST_SLOT + len(self._env.objects))
        visible = [slot for slot in points if slot != target and sizes[FIRST_SLOT + slot] >= MIN_PIXELS]
        numbers = number_slots(visible, scene.seed)
        answers = sorted(numbers[slot] for slot in scene.first_removals if slot in numbers)
        if not answers or len(answers) == len(numbers):
            return None
        instruction, identifier = self._env.get_language_instruction()[0], f"{self._name}-{scene.seed}"
        question = RemovalQuestion(
            id=identifier,
            image=f"images/{identifier}.png",
            instruction=instruction,
            question=make_question_text(instruction, self._env.target_asset().asset.name),
            objects=self._list_objects(numbers, segmentation),
            answers=answers,
            removals=scene.removals,
            highest=numbers[max(numbers, key=lambda slot: points[slot][:, 2].max())],
            scripted=None if scene.scripted_removal is None else numbers.get(scene.scripted_removal),
            seed=scene.seed,
        )
        return question, _draw_slots(rgb, segmentation, numbers)

    def render_question(self, question: RemovalQuestion) -> NDArray[np.uint8]:
        """Return the image (H, W, 3) of a question; raise EvaluationError if the scene differs from the question."""
        rgb, segmentation, _ = self._render(question.seed)
        present, assets = self._env.present[0].tolist(), self._env.object_assets[0]
        objects = {slot: asset.asset.id for slot, asset in enumerate(assets) if present[slot]}
        found = (self._env.get_language_instruction()[0], [objects.get(one.slot) for one in question.objects])
        if found != (question.instruction, [one.asset for one in question.objects]):
            what, fix = "the rebuilt scene differs from the question", "Use the pack and versions of the questions."
            raise EvaluationError(what, where=question.id, expected=question.instruction, found=found[0], fix=fix)
        return _draw_slots(rgb, segmentation, {one.slot: one.number for one in question.objects})

    def close(self) -> None:
        """Close the environment."""
        self._renderer.close()

    def _render(self, seed: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8], dict[int, Array]]:
        """Return image (H, W, 3), segmentation (H, W) and the surface points of each object of the scene of a seed."""
        self._renderer.load_seed(seed)
        points = self._list_surface_points()
        self._renderer.move_camera(_CAMERA, self._find_camera_pose(list(points.values())))
        images = self._renderer.render()
        return images.rgb[_CAMERA], images.segmentation[_CAMERA], points

    def _list_objects(self, numbers: Mapping[int, int], segmentation: NDArray[np.uint8]) -> list[NumberedObject]:
        boxes = {slot: compute_bounding_box(segmentation == FIRST_SLOT + slot) for slot in numbers}
        return [
            NumberedObject(number, slot, asset.id, asset.name, box)
            for slot, number in sorted(numbers.items(), key=lambda pair: pair[1])
            if (box := boxes[slot]) is not None and (asset := self._env.object_assets[0][slot].asset)
        ]

    def _list_surface_points(self) -> dict[int, Array]:
        """Return surface points (P, 3) of each object in the world frame in m, by slot."""
        poses = from_wxyz(self._env.object_states[0, :, :7])
        return {
            slot: transform_points(poses[slot], self._env.object_assets[0][slot].surface_points(_SPACING))
            for slot in np.flatnonzero(self._env.present[0].cpu().numpy()).tolist()
        }

    def _find_camera_pose(self, points: Sequence[Array]) -> Array:
        """Return the pose (4, 4) in the world frame from which the camera sees the objects."""
        centers = np.stack([one.mean(axis=0) for one in points])
        middle = np.median(centers, axis=0)
        radius = float(np.clip(np.linalg.norm(centers - middle, axis=1).max() + _OBJECT_RADIUS, *_RADII))
        away = middle - self._env.agent.arm_base_link.pose.raw_pose[0, :3].cpu().numpy()
        away[2] = 0
        elevation = np.deg2rad(_ELEVATION_DEG)
        direction = np.cos(elevation) * away / np.linalg.norm(away) + np.sin(elevation) * np.array([0.0, 0.0, 1.0])
        eye = middle + radius / np.sin(np.deg2rad(_FOV_DEG / 2)) * direction
        return from_wxyz(sapien_utils.look_at(eye.tolist(), middle.tolist()).raw_pose[0])


def number_slots(slots: Sequence[int], seed: int) -> dict[int, int]:
    """Return the number of each slot, from 1 on, in a random order that depends on the seed."""
    order = np.random.default_rng([seed, _STREAM]).permutation(len(slots))
    return {slot: int(place) + 1 for slot, place in zip(slots, order, strict=True)}


def _draw_slots(
    rgb: NDArray[np.uint8], segmentation: NDArray[np.uint8], numbers: Mapping[int, int]
) -> NDArray[np.uint8]:
    masks = {number: segmentation == FIRST_SLOT + slot for slot, number in numbers.items()}
    return draw_numbers(rgb, {number: mask for number, mask in masks.items() if mask.any()})
