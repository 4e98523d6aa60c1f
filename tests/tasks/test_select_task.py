"""Layouts of select and of front approaches, success of select, and its scripted policy."""

from __future__ import annotations

import json
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.utils.structs import Pose

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.config.load import bundled_configs
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.relations import MARGIN
from robocas_ms3.scenes.sample import sample_layout


def load_scene(name):
    pack = load_pack("builtin")
    return SceneModel.load(load_task_config(name), pack, pack)


SELECT = sorted(name for name in bundled_configs() if name.startswith("select_"))


@pytest.mark.parametrize("name", [name for name in SELECT if load_task_config(name).target.relations])
def test_relation_identifies_the_target(name):
    model = load_scene(name)
    layout = sample_layout(model, 3, 3)
    target = layout.object_ids[layout.target]
    alike = [i for i, object_id in enumerate(layout.object_ids) if object_id == target and i != layout.target]
    assert alike
    xy = (np.linalg.inv(layout.robot_pose) @ layout.object_poses)[:, :2, 3]
    by_distance = layout.relation in {"nearest", "second_nearest", "farthest"}
    key = np.linalg.norm(xy, axis=1) if by_distance else xy[:, 1]
    assert np.abs(key[alike] - key[layout.target]).min() >= MARGIN
    side = {"nearest": -1, "farthest": 1, "leftmost": 1, "rightmost": -1}.get(layout.relation)
    if side is not None:
        assert np.all(side * (key[layout.target] - key[alike]) > 0)


@pytest.mark.parametrize("name", [name for name in SELECT if not load_task_config(name).target.relations])
def test_target_without_relation_is_the_nearest_of_its_kind(name):
    model = load_scene(name)
    count = model.config.objects.count
    for seed in range(3):
        layout = sample_layout(model, seed, seed)
        assert layout.relation == "" and len(layout.object_ids) == count
        assert 2 <= layout.present.sum() < count
        distance = np.linalg.norm((layout.object_poses[:, :2, 3] - layout.robot_pose[:2, 3]), axis=1)
        kind = np.array(layout.object_ids) == layout.object_ids[layout.target]
        assert distance[layout.target] == distance[kind & layout.present].min()
        assert (layout.object_poses[~layout.present, 2, 3] < 0).all()  # parked below the floor


def test_unused_slots_are_still_and_no_targets():
    settings = {"config": "select_upstream", "render_backend": "none", "obs_mode": "none"}
    env = gym.make("RoboCASSelect-v1", control_mode="pd_joint_pos", **settings)
    env.reset(seed=0)
    base: Any = env.unwrapped
    action = np.array([*base.agent.robot.qpos[0, 3:10].tolist(), 1.0], np.float32)
    for _ in range(20):
        info = env.step(action)[-1]
    assert (base.object_poses[~base.present][:, 2] < 0).all()
    torch.testing.assert_close(base.object_poses, base.start_poses, atol=3e-3, rtol=0)
    assert int(info["disturbed"][0]) == 0
    name = base.target_asset().asset.name
    assert base.get_language_instruction() == [f"grasp the {name} on the table and move it to the basket"]
    env.close()


def test_wrong_instance_in_the_basket_prevents_success():
    env = gym.make("RoboCASSelect-v1", render_backend="none", control_mode="pd_joint_pos", obs_mode="none")
    env.reset(seed=3)
    base: Any = env.unwrapped
    target, ids = int(base.target_slot[0]), [asset.asset.id for asset in base.object_assets[0]]
    alike = next(i for i, one in enumerate(ids) if one == ids[target] and i != target)
    other = next(i for i, one in enumerate(ids) if one != ids[target])
    inside = base.fixtures.basket.pose.p + torch.tensor([[0, 0, 0.05]])

    def put(slot: int) -> None:
        base.objects[slot].set_pose(Pose.create_from_pq(inside, base.objects[slot].pose.q))

    put(target)
    base.success_check.stages["target_lifted"][:] = True
    for actor in base.objects:
        actor.set_linear_velocity(torch.zeros(1, 3))
    assert bool(base.evaluate()["success"][0])
    put(other)  # other objects do not matter
    assert bool(base.evaluate()["success"][0])
    put(alike)
    found = base.evaluate()
    assert not bool(found["success"][0]) and bool(found["target_in_basket"][0])
    assert [name for name, holds in base.success_conditions().items() if not bool(holds[0])] == ["others_out"]
    env.close()


@pytest.mark.slow
class TestOnAShelf:
    @pytest.fixture(scope="class")
    def generator(self):
        generator = EpisodeGenerator(EpisodeSettings("select", "select_shelf_orderly", "builtin", max_attempts=6))
        yield generator
        generator.close()

    def test_episode_keeps_the_neighbours_standing(self, generator, tmp_path):
        result = generator.generate(1, tmp_path, "episode")
        assert result.success, result.failures
        episode = json.loads((tmp_path / "episode.json").read_text())["episodes"][0]
        assert episode["robocas"]["facts"]["disturbed"] == 0
