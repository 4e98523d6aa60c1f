"""Scenes of bundled configurations with changes."""

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.model import SceneModel


def load_scene(name: str = "pick_table_scattered", **changes: object) -> SceneModel:
    """Load a bundled configuration with the builtin pack; keyword arguments replace its keys."""
    pack = load_pack("builtin")
    data = {**load_task_config(name).model_dump(mode="json"), **changes}
    return SceneModel.load(load_task_config(data), pack, pack)
