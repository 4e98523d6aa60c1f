"""What an episode was about: task, configuration, instruction, objects and where they stood."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.scene import valid_values
from robocas_ms3.datasets.sources.protocol import SourceEpisode
from robocas_ms3.datasets.sources.provenance import task_of

Array = NDArray[np.float64]
UNKNOWN = "unknown"


@dataclass(frozen=True)
class Surface:
    """What a layout's objects stand on.

    Attributes:
        label: furniture and name of the surface.
        x, y, yaw: the furniture in the world, m and rad.
        region: [min_xy, max_xy] in the furniture's frame, m; None: all of the surface.
    """

    label: str
    x: float
    y: float
    yaw: float
    region: list[list[float]] | None

    def place(self, xy: Array) -> Array:
        """(N, 2) in the world -> in the furniture's frame."""
        cosine, sine = np.cos(self.yaw), np.sin(self.yaw)
        return (xy - [self.x, self.y]) @ np.array([[cosine, -sine], [sine, cosine]])


@dataclass(frozen=True)
class Facts:
    """What an episode was about; empty where nothing says so.

    Attributes:
        task, config: names.
        success: whether the recording succeeded; None: not known.
        instruction, template, relation: what was said.
        object_ids: of those that took part.
        names: of objects, by id.
        positions: (N, 2) of those in the world at the beginning, m.
        target_id: asset.
        target_index: of the target in ``positions``.
        surface: see there.
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
    """Facts of an episode, as far as its scene tells them."""
    instruction = str(episode.read(["language_goal"])["language_goal"])
    scene = episode.scene
    if not scene:
        return Facts(instruction)
    _, wrong = valid_values(scene)
    if wrong:
        where, fix = f"{episode.where}/{schema.SCENE_FILE}", "robocas validate says what is wrong."
        raise DatasetError("this description of a scene is damaged", where=where, found=wrong[:200], fix=fix)
    try:
        layout, said, target = episode.layout, scene.get("recorded") or {}, scene.get("target") or {}
        ids = layout.get("object_ids", [])
        poses = np.array(layout.get("poses", []), dtype=np.float64).reshape(-1, 7)
        slots = [slot for slot, there in enumerate(layout.get("present", [True] * len(ids))) if there]
        names = {target["asset_id"]: target["name"]} if {"asset_id", "name"} <= set(target) else {}
        names |= {entry["id"]: entry["name"] for entry in scene.get("objects") or []}
        return Facts(
            instruction,
            task=scene.get("task") or UNKNOWN,
            config=_config_name(scene.get("env_info") or {}, scene.get("task")),
            success=scene.get("success"),
            template=said.get("instruction_template") or "",
            relation=said.get("relation") or "",
            object_ids=[ids[slot] for slot in slots],
            names=names,
            positions=poses[slots, :2] if len(poses) else np.zeros((0, 2)),
            target_id=target.get("asset_id") or "",
            target_index=_place(slots, target.get("slot")) if len(poses) else None,
            surface=_surface(scene.get("config") or {}),
        )
    except (AttributeError, KeyError, TypeError, ValueError, IndexError) as error:
        raise DatasetError(
            "this description of a scene is damaged",
            where=f"{episode.where}/{schema.SCENE_FILE}",
            found=f"{type(error).__name__}: {error}",
            fix="robocas validate says what is wrong.",
        ) from error


def _place(slots: list[int], slot: int | None) -> int | None:
    return slots.index(slot) if slot in slots else None


def _config_name(env_info: Mapping[str, Any], task: str | None) -> str:
    config = (env_info.get("env_kwargs") or {}).get("config")
    if isinstance(config, str):
        return Path(config).stem
    name = task or task_of(str(env_info.get("env_id"))) or UNKNOWN
    return f"{name} (own configuration)" if config else name


def _surface(config: Mapping[str, Any]) -> Surface | None:
    surface = config.get("surface")
    if not surface:
        return None
    pose = config["furniture"][surface["furniture"]]["pose"]
    region = [list(surface[key]) for key in ("min_xy", "max_xy")] if surface.get("min_xy") else None
    x, y, _ = pose["position"]
    return Surface(
        f"{surface['furniture']}, {surface['name']}", x, y, float(np.deg2rad(pose.get("yaw_deg", 0.0))), region
    )
