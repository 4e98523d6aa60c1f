"""Perception of `keyframe` with a network that predicts given classes and vectors."""

import numpy as np
import pytest
import torch

from robocas_ms3.baselines.keyframe.config import DecisionSettings
from robocas_ms3.baselines.keyframe.network import (
    BACKGROUND,
    BASKET,
    FIRST_NAME,
    HANDLE,
    OFFSET_UNIT,
    PULL_UNIT,
    STRIDE,
)
from robocas_ms3.baselines.keyframe.observed_scene import sample_pixels, unproject
from robocas_ms3.baselines.keyframe.perception import CameraFrame, Perception, Request

SIZE = 256
INTRINSICS = np.array([[200.0, 0, SIZE / 2], [0, 200.0, SIZE / 2], [0, 0, 1]])
DOWN = np.array([[0, -1, 0, 0.6], [-1, 0, 0, 0.0], [0, 0, -1, 0.7], [0, 0, 0, 1.0]])  # image top is forward
TABLE = 0.1


class FixedNetwork(torch.nn.Module):
    """Network whose segmentation is given: classes (h, w), offsets (h, w, 3) and pulls (h, w, 9)."""

    def __init__(self, labels, offsets, pulls):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.values = labels, offsets, pulls

    def segmentation(self, images):
        labels, offsets, pulls = (torch.from_numpy(np.ascontiguousarray(value)) for value in self.values)
        logits = 20 * torch.nn.functional.one_hot(labels, FIRST_NAME + 2).permute(2, 0, 1).float()
        return logits[None], offsets.permute(2, 0, 1)[None].float(), pulls.permute(2, 0, 1)[None].float()


class Scene:
    """Boxes on a table, seen from above: each has a class, bounds in x and y, and a height of its top."""

    def __init__(self):
        self.depth = np.full((SIZE, SIZE), 1000 * (DOWN[2, 3] - TABLE), np.uint16)
        self.pixels = sample_pixels(self.depth.shape, STRIDE, STRIDE // 2)
        count = SIZE // STRIDE
        self.labels = np.full((count, count), BACKGROUND, np.int64)
        self.ends, self.pulls = np.full((count, count, 3), np.nan), np.zeros((count, count, 9))

    def add(self, label, x, y, top, end=None):
        points, _ = unproject(np.full_like(self.depth, 1000 * (DOWN[2, 3] - top)), INTRINSICS, DOWN)
        inside = (points[..., 0] > x[0]) & (points[..., 0] < x[1]) & (points[..., 1] > y[0]) & (points[..., 1] < y[1])
        self.depth[inside] = 1000 * (DOWN[2, 3] - top)
        cells = inside[np.ix_(*self.pixels)]
        self.labels[cells] = label
        self.ends[cells] = [np.mean(x), np.mean(y), (TABLE + top) / 2] if end is None else end
        return cells

    def perceive(self):
        points, _ = unproject(self.depth, INTRINSICS, DOWN, self.pixels)
        offsets = np.nan_to_num(self.ends - points) @ DOWN[:3, :3] / OFFSET_UNIT
        frame = CameraFrame(np.zeros((SIZE, SIZE, 3), np.uint8), self.depth, INTRINSICS, DOWN)
        return Perception(FixedNetwork(self.labels, offsets, self.pulls), DecisionSettings()), frame


def make_scene():
    scene = Scene()
    scene.add(FIRST_NAME, (0.6, 0.66), (0.0, 0.06), TABLE + 0.08)
    scene.add(FIRST_NAME, (0.66, 0.72), (0.0, 0.06), TABLE + 0.08)  # a copy that touches the first one
    scene.add(FIRST_NAME + 1, (0.55, 0.6), (-0.2, -0.12), TABLE + 0.05)
    scene.add(BASKET, (0.45, 0.75), (0.15, 0.25), TABLE + 0.12)
    return scene


def test_survey_of_a_table():
    perception, frame = make_scene().perceive()
    survey = perception.survey([frame], 0.3)
    assert survey.table == pytest.approx(TABLE, abs=0.005)
    assert np.allclose(survey.basket, [0.6, 0.2, TABLE + 0.12], atol=0.012)
    assert 0.58 < survey.focus[0] < 0.7 and -0.1 < survey.focus[1] < 0.06
    assert survey.handle is None and not survey.has_roof


def test_cells_behind_the_outline_of_the_basket_do_not_move_it():
    scene = make_scene()
    scene.add(BASKET, (0.2, 0.23), (-0.65, -0.45), -0.3, end=[0, 0, 0])  # the floor, 6 % of the basket's cells
    perception, frame = scene.perceive()
    strays = (scene.labels == BASKET) & (scene.ends[..., 2] == 0)
    assert 0.04 < strays.sum() / (scene.labels == BASKET).sum() < 0.2
    assert np.allclose(perception.survey([frame], 0.3).basket, [0.6, 0.2, TABLE + 0.12], atol=0.012)


def test_two_distant_groups_of_basket_cells_are_no_basket():
    scene = Scene()
    groups = [(0.23, 0.31), (-0.37, -0.29)], [(0.885, 0.97), (0.285, 0.37)]
    counts = [scene.add(BASKET, x, y, TABLE + 0.01).sum() for x, y in groups]
    assert counts[0] == counts[1] > 10
    perception, frame = scene.perceive()
    assert perception.survey([frame], 0.3).basket is None


def test_survey_before_a_door():
    scene = make_scene()
    add_handle(scene, (-0.3, -0.25), [0.48, -0.28, 0.13], [0.0, 0.5, 0.0])
    perception, frame = scene.perceive()
    handle = perception.survey([frame], 0.3).handle
    assert np.allclose(handle.position, [0.48, -0.28, 0.13], atol=1e-6) and np.allclose(handle.motion, [0, 0.5, 0])
    assert np.allclose(handle.approach, [1, 0, 0]) and np.allclose(handle.bar, [0, 0, 1])


def test_a_handle_that_can_be_pulled_comes_before_a_larger_one():
    scene = make_scene()
    add_handle(scene, (-0.3, -0.25), [0.48, -0.28, 0.13], [0.0, 0.5, 0.0])
    add_handle(scene, (-0.2, -0.1), [0.48, -0.15, 0.13], [0.0, 0.0, 0.5])  # an edge that seems to move upwards
    perception, frame = scene.perceive()
    assert np.allclose(perception.survey([frame], 0.3).handle.position, [0.48, -0.28, 0.13], atol=1e-6)


def add_handle(scene, y, grasp, motion):
    """Add a vertical bar with bounds in y; the gripper approaches it forwards and moves it by a motion."""
    cells = scene.add(HANDLE, (0.45, 0.5), y, TABLE + 0.05, end=grasp)
    vectors = np.array([motion, [1.0, 0, 0], [0, 0, 1.0]]) / [[PULL_UNIT], [1], [1]]
    scene.pulls[cells] = (vectors @ DOWN[:3, :3]).ravel()


def test_a_board_above_the_objects_is_a_roof():
    scene = make_scene()
    scene.add(BACKGROUND, (0.7, 0.85), (-0.2, 0.2), TABLE + 0.3)
    perception, frame = scene.perceive()
    assert perception.survey([frame], 0.3).has_roof


def test_copies_are_told_apart_for_a_relation():
    perception, frame = make_scene().perceive()
    names = np.array([1.0, 0.0], np.float32)
    scene = perception.observe(frame, Request(names, "farthest"), TABLE)
    assert sorted(np.round(one.center[0], 2) for one in scene.targets) == [0.63, 0.69]
    for one in scene.targets:
        middle = scene.points[one.mask].mean(axis=0)
        assert np.allclose(middle[:2], one.center[:2], atol=0.01) and middle[2] > TABLE + 0.06
    assert len(scene.objects) >= 2 and {one.label for one in scene.objects} == {0, 1}


def test_cells_of_no_object_have_no_targets():
    perception, frame = make_scene().perceive()
    scene = perception.observe(frame, Request(np.array([0.0, 1.0], np.float32), None), TABLE)
    assert len(scene.targets) == 1 and scene.targets[0].center[0] == pytest.approx(0.575, abs=0.01)
    empty, frame = Scene().perceive()
    assert not empty.observe(frame, Request(np.array([1.0, 0.0], np.float32), None), TABLE).targets
    assert not empty.survey([frame], 0.3).has_roof
