"""What an episode was about: task, configuration, instruction, objects and where they stood."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.words import error_line
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.sources.protocol import SourceEpisode
from robocas_ms3.datasets.sources.provenance import task_of
from robocas_ms3.datasets.sources.records import Layout, Recorded, SceneRecord, read_scene

Array = NDArray[np.float64]
UNKNOWN = "unknown"


@dataclass(frozen=True)
class Surface:
    """The surface that objects stand on: pose of its furniture in the world (m, rad), and region there."""

    label: str
    x: float
    y: float
    yaw: float
    region: list[list[float]] | None

    def place(self, xy: Array) -> Array:
        """Return positions (N, 2) in the world in the frame of the furniture."""
        cosine, sine = np.cos(self.yaw), np.sin(self.yaw)
        return (xy - [self.x, self.y]) @ np.array([[cosine, -sine], [sine, cosine]])


@dataclass(frozen=True)
class Facts:
    """What an episode was about; empty where it is not known.

    ``positions`` are (N, 2) m in the world at the beginning, of the objects that took part.
    """

    instruction: str
    task: str = UNKNOWN
    config: str = UNKNOWN
    success: bool | None = None
    template: str = ""
    relation: str = ""
    object_ids: list[str] = field(default_factory=list)
    names: dict[str, str] = field(default_factory=dict)
    positions: Array = field(default_factory=lambda: np.zeros((0, 2)))
    target_id: str = ""
    target_index: int | None = None
    surface: Surface | None = None


def facts_of(episode: SourceEpisode) -> Facts:
    """Return the facts of an episode, as far as its ``scene.json`` has them."""
    instruction = str(episode.read(["language_goal"])["language_goal"])
    if not episode.scene:
        return Facts(instruction)
    where, fix = f"{episode.where}/{schema.SCENE_FILE}", "robocas validate says what is wrong."
    scene = read_scene(episode.scene, where)
    recorded, target = scene.recorded or Recorded(), scene.target
    try:
        layout = Layout.model_validate(episode.layout)
        slots = [n for n in range(len(layout.object_ids)) if not layout.present or layout.present[n]]
        poses = np.array(layout.poses, dtype=np.float64).reshape(-1, 7)
        names = {target.asset_id: target.name} if target else {}
        return Facts(
            instruction,
            task=scene.task or UNKNOWN,
            config=_config_name(scene),
            success=scene.success,
            template=recorded.instruction_template or "",
            relation=recorded.relation or "",
            object_ids=[layout.object_ids[slot] for slot in slots],
            names=names | {entry.id: entry.name for entry in scene.objects or []},
            positions=poses[slots, :2] if len(poses) else np.zeros((0, 2)),
            target_id=target.asset_id if target else "",
            target_index=slots.index(target.slot) if target and len(poses) and target.slot in slots else None,
            surface=_surface(scene.config or {}),
        )
    except (AttributeError, KeyError, TypeError, ValueError, IndexError) as error:
        raise DatasetError(
            "this description of a scene is damaged", where=where, found=error_line(error, 200), fix=fix
        ) from error


def _config_name(scene: SceneRecord) -> str:
    env_id, kwargs = (scene.env_info.env_id, scene.env_info.env_kwargs) if scene.env_info else (None, {})
    config = kwargs.get("config")
    if isinstance(config, str):
        return Path(config).stem
    name = scene.task or task_of(env_id) or UNKNOWN
    return f"{name} (own configuration)" if config else name


def _surface(config: dict[str, Any]) -> Surface | None:
    surface = config.get("surface")
    if not surface:
        return None
    pose = config["furniture"][surface["furniture"]]["pose"]
    region = [list(surface[key]) for key in ("min_xy", "max_xy")] if surface.get("min_xy") else None
    x, y, _ = pose["position"]
    yaw = float(np.deg2rad(pose.get("yaw_deg", 0.0)))
    return Surface(f"{surface['furniture']}, {surface['name']}", x, y, yaw, region)
