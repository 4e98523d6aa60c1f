"""Scenes of training data: read from episodes, and compared with the episodes of a protocol."""

from types import SimpleNamespace

from robocas_ms3.baselines.training.scenes import (
    TrainingScenes,
    name_config,
    read_training_scenes,
    select_scene_settings,
)
from robocas_ms3.scenes.config import load_task_config

CAMERAS = ("base_camera", "gripper_camera")


def scene(config="pick_table_scattered", ids=("apple",), task="pick"):
    return {
        "task": task,
        "env_info": {"env_id": "RoboCASPick-v1", "env_kwargs": {"config": config}},
        "config": load_task_config(config).model_dump(mode="json"),
        "objects": [{"slot": slot, "id": name, "name": name} for slot, name in enumerate(ids)],
    }


def read(*scenes):
    source = SimpleNamespace(episode=lambda number: SimpleNamespace(scene=scenes[number]))
    return read_training_scenes(source, range(len(scenes)))


def test_scenes_of_episodes():
    found = read(scene(), scene(ids=("pear", "apple")), scene("pick_upstream_eval"))
    assert (found.tasks, found.objects) == (["pick"], ["apple", "pear"])
    assert list(found.configs) == ["pick_table_scattered", "pick_upstream_eval"]
    assert found.summarize() == "pick, in pick_table_scattered, pick_upstream_eval, objects apple, pear"


def test_episodes_without_scenes_give_no_differences():
    """Episodes of other packages, and configurations with unknown keys."""
    found = read({}, {"task": None, "objects": None, "config": {"no_such_key": 1}})
    assert found == TrainingScenes()
    assert found.list_differences({"pick": load_task_config("pick_table_scattered")}, CAMERAS) == []


def test_names_of_configurations():
    assert name_config("mine/shelf.yaml", ()) == "shelf" and name_config("shelf", ["shelf"]) == "shelf-2"
    assert name_config({"task": "pick"}, ()) == name_config(None, ()) == "configuration"


def test_differences_from_other_configurations():
    config = load_task_config("pick_table_scattered")
    trained = TrainingScenes(tasks=["pick"], configs={"a": select_scene_settings(config)})
    assert trained.list_differences({"a": config}, CAMERAS) == []
    search = load_task_config("search_upstream_eval")
    task, settings = trained.list_differences({"a": config, "b": search}, CAMERAS)
    assert task == "task search" and settings.startswith("scene settings ")
    few = trained.model_copy(update={"objects": ["apple"]})
    (objects,) = few.list_differences({"a": config}, CAMERAS)
    assert objects.startswith("objects ") and "apple" not in objects


def test_only_the_cameras_of_the_policy_count():
    config = load_task_config("pick_table_scattered")
    moved = {"static_camera": "elsewhere", "cameras.base_camera": {"fov_deg": 30}}
    trained = TrainingScenes(configs={"moved": select_scene_settings(config) | moved})
    assert trained.list_differences({"a": config}, ["gripper_camera"]) == []
    assert trained.list_differences({"a": config}, CAMERAS) == ["cameras base_camera"]
    assert trained.list_differences({"a": config}, ["static_camera"]) == ["cameras static_camera"]
