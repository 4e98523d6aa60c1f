import gymnasium as gym
import numpy as np
import pytest
import torch
import yaml
from mani_skill.utils.structs import Articulation

import robocas_ms3  # noqa: F401
from robocas_ms3.assets.pack import load_pack
from robocas_ms3.assets.spawn import spawn
from robocas_ms3.core.errors import ConfigError
from robocas_ms3.core.paths import task_configs_dir
from robocas_ms3.scenes import build
from robocas_ms3.scenes.config import TaskConfig
from robocas_ms3.scenes.lookup import find_objects, furniture_pose


def pick_config(**changes):
    data = yaml.safe_load((task_configs_dir() / "pick_table_scattered.yaml").read_text(encoding="utf-8"))
    return {**data, **changes}


CABINET = {"asset": "cabinet", "pose": {"position": [-1.5, -1.0, 0.0], "yaw_deg": 0.0}}


def test_articulated_furniture_is_closed_again_after_a_reset():
    data = pick_config()
    data["furniture"]["cabinet"] = CABINET
    env = gym.make("RoboCASPick-v1", config=data, render_backend="none", reconfiguration_freq=0)
    try:
        env.reset(seed=0)
        cabinet = env.unwrapped.fixtures.furniture["cabinet"]
        assert isinstance(cabinet, Articulation)
        cabinet.set_qpos(torch.full((1, cabinet.max_dof), 0.2))
        for _ in range(3):
            env.step(env.action_space.sample() * 0)
        assert (cabinet.qpos > 0.1).all()
        env.reset(seed=1)
        assert cabinet.qpos.abs().max() < 1e-6
        for _ in range(20):
            env.step(env.action_space.sample() * 0)
        assert cabinet.qpos.abs().max() < 1e-3
    finally:
        env.close()


@pytest.mark.slow
def test_finishes_and_levels_of_detail_are_visible(needs_renderer):
    """The floor has the colour of its finish; both levels of detail render nearly the same image."""
    rendered = {}
    for name, floor, level in (("oak", "oak_parquet", "fast"), ("blue", "carpet", "fast"), ("full", "carpet", "full")):
        data = pick_config(room={"asset": "room", "finishes": {"floor": floor}})
        env = gym.make("RoboCASPick-v1", config=data, visual_level=level, render_mode="rgb_array")
        env.reset(seed=0)
        rendered[name] = env.render()[0].cpu().numpy().astype(float)
        env.close()
    corner = np.s_[380:, :120]  # floor next to the robot
    oak, blue = rendered["oak"][corner].mean(axis=(0, 1)), rendered["blue"][corner].mean(axis=(0, 1))
    assert oak[0] > oak[2] + 20 and blue[2] > blue[0] + 10
    assert 0 < np.abs(rendered["full"] - rendered["blue"]).mean() < 3


def test_an_unknown_level_of_detail_is_an_error():
    with pytest.raises(ConfigError, match=r"no such visual_level \(expected one of fast, full, found fulll\)"):
        gym.make("RoboCASPick-v1", visual_level="fulll", render_backend="none")


def test_asset_is_built_once_for_all_its_envs_in_their_order(monkeypatch):
    import sapien
    from mani_skill.envs.scene import ManiSkillScene
    from mani_skill.envs.utils.system.backend import parse_sim_and_render_backend

    scenes = [sapien.Scene([sapien.physx.PhysxCpuSystem()]) for _ in range(5)]
    backend = parse_sim_and_render_backend("cpu", "none")
    scene = ManiSkillScene(scenes, device=torch.device("cpu"), backend=backend)
    objects, spawned = load_pack("builtin").objects, []
    monkeypatch.setattr(build, "spawn", lambda *args, **kw: spawned.append(kw["name"]) or spawn(*args, **kw))
    ids = ["apple", "banana", "apple", "mug", "banana"]
    actor = build.build_object_slot(scene, 2, [objects[i] for i in ids])
    assert spawned == ["object_2-apple", "object_2-banana", "object_2-mug"]
    assert actor._scene_idxs.tolist() == [0, 1, 2, 3, 4]
    assert [entity.name for entity in actor._objs] == [f"scene-{i}_object_2-{asset}" for i, asset in enumerate(ids)]
    assert [body.entity for body in actor._bodies] == actor._objs
    masses = [objects[i].asset.mass for i in ids]
    np.testing.assert_allclose([body.mass for body in actor._bodies], masses, rtol=1e-5)
    assert list(scene.state_dict_registry.actors) == ["object_2"]
    for i, entity in enumerate(actor._objs):
        assert entity.scene == scenes[i]
    alike = build.build_object_slot(scene, 3, [objects["apple"]] * 5)
    assert alike.name == "object_3"
    assert len(alike._objs) == 5
    assert list(scene.state_dict_registry.actors) == ["object_2", "object_3"]


@pytest.mark.slow
def test_objects_cast_shadows_and_the_room_does_not(needs_renderer):
    images = []
    for shadow in (False, True):
        data = pick_config(lights={"shadow": shadow})
        env = gym.make("RoboCASPick-v1", config=data, obs_mode="rgb", sim_backend="physx_cpu", reward_mode="none")
        observed, _ = env.reset(seed=0)
        images.append(observed["sensor_data"]["static_camera"]["rgb"][0].float().mean(-1))
        env.close()
    ratio = images[1] / images[0].clamp(min=1)
    assert ratio.median() > 0.98
    assert 0.002 < (ratio < 0.85).float().mean() < 0.2


def objects_of(ids):
    return find_objects(load_pack("builtin"), TaskConfig.model_validate(pick_config(objects={"ids": ids, "count": 2})))


def test_objects_by_id_or_graspnet_number():
    assert objects_of([5, "apple", 31]) == ["banana", "apple", "toy_airplane_k"]
    assert len(objects_of("all")) == 46


def test_furniture_stands_on_its_lowest_point():
    pack = load_pack("builtin")
    config = TaskConfig.model_validate(pick_config())
    pose = furniture_pose(config.basket, pack.furniture["basket"])
    np.testing.assert_allclose(pose[:3, 3], [1.3, 0.9, 0.61 + 0.096])
