"""The environment that a file says an episode was recorded in: read strictly, and made.

A file is somebody's data. It names a registered task, a shipped configuration or the whole of one, and installed packs;
never a module, a file or a folder.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from robocas_ms3.assets.pack import find_packs
from robocas_ms3.core.errors import DatasetError, ExtensionError
from robocas_ms3.core.strict_model import StrictModel, list_invalid_values
from robocas_ms3.robots.cameras import CameraSpec
from robocas_ms3.robots.registry import RobotSpec, find_robot
from robocas_ms3.scenes.config.load import bundled_configs, load_config_for
from robocas_ms3.scenes.task_specs import TASKS, TaskSpec

_PREFIX = "robocas_ms3:"  # lets gymnasium import this package by itself: ManiSkill's own tools then work
_DEEP = 3  # dicts in dicts that settings of simulation and cameras may have

_NAME = re.compile(r"\w[\w.+-]*")
_Name = Annotated[str, Field(pattern=f"^{_NAME.pattern}$")]
_Settings = dict[str, Any]


class _Kwargs(StrictModel):
    """Arguments of ``gym.make`` that are read of a file: those of the scene, and its actions' control mode."""

    model_config = ConfigDict(strict=True)

    config: _Name | dict[str, Any] | None = None
    pack: _Name = "builtin"
    furniture_pack: _Name = "builtin"
    visual_level: _Name = "fast"
    robot_uids: _Name | None = None
    sim_config: _Settings = {}
    sensor_configs: _Settings = {}
    control_mode: _Name | None = None


# Arguments that a recording may hold, and that its reader chooses
_READERS = {
    *("obs_mode", "reward_mode", "render_mode", "num_envs", "seeds", "reconfiguration_freq", "max_episode_steps"),
    *("enable_shadow", "enhanced_determinism", "parallel_in_single_scene", "sim_backend", "render_backend"),
    *("shader_dir", "human_render_camera_configs", "viewer_camera_configs", "layouts"),
}


class _Info(BaseModel):
    model_config = ConfigDict(extra="allow", strict=True)

    env_id: str
    env_kwargs: _Kwargs


@dataclass(frozen=True)
class RecordedEnv:
    """The environment that a file names.

    Attributes:
        env_id: gymnasium's, of a registered task.
        control_mode: of the actions, if the file names it.
        kwargs: for ``gym.make``, those of the scene; layouts follow from the seed.
    """

    env_id: str
    control_mode: str | None
    kwargs: dict[str, Any]

    def with_pack(self, pack: str | Path | None) -> RecordedEnv:
        """Return the same with the objects of another pack, by name or folder, where one is given."""
        if pack is None:
            return self
        named = str(pack) if str(pack) in find_packs() else str(Path(pack).absolute())
        return replace(self, kwargs={**self.kwargs, "pack": named})

    def robot(self, where: object = "robot_uids") -> RobotSpec:
        try:
            return find_robot(self.kwargs.get("robot_uids"), where=where)
        except ExtensionError as error:
            fix = error.fix or "Install the package that has it."
            raise DatasetError(error.what, where=where, expected=error.expected, found=error.found, fix=fix) from error

    def cameras(self) -> tuple[CameraSpec, ...]:
        """Return the cameras of its task and robot; raises ``DatasetError`` if what it names is not installed."""
        return load_config_for(self._task(), self.kwargs.get("config")).cameras_of(self.robot().description)

    def _task(self) -> TaskSpec:
        known, config = {spec.env_id: spec for spec in TASKS.values()}, self.kwargs.get("config")
        if self.env_id not in known:
            raise DatasetError("no such task", where="env_id", expected=f"one of {sorted(known)}", found=self.env_id)
        if isinstance(config, str) and config not in bundled_configs():
            raise DatasetError("no such configuration", where="config", expected="a shipped one", found=config)
        return known[self.env_id]

    def make(self, **kwargs: Any) -> Any:
        """Make it with further arguments of ``gym.make``; raises ``DatasetError`` if what it names is not installed."""
        import gymnasium as gym

        self._task()
        self.robot()
        for key in ("pack", "furniture_pack"):
            name = self.kwargs.get(key, "builtin")
            if not Path(name).is_absolute() and name not in find_packs():
                expected = f"one of {', '.join(find_packs())}"
                fix = "Install it, or pass its folder with --pack." if key == "pack" else "Install it."
                raise DatasetError("no such pack is installed", where=key, expected=expected, found=name, fix=fix)
        return gym.make(self.env_id, **{**self.kwargs, **kwargs})


def read_env(info: Any, where: object, *, pack: str | Path | None = None) -> RecordedEnv:
    """Read ``env_info`` of a file, ``{"env_id": ..., "env_kwargs": {...}}``; ``pack`` replaces the named one."""
    if isinstance(info, Mapping) and isinstance(info.get("env_kwargs"), Mapping):
        kwargs = {name: value for name, value in info["env_kwargs"].items() if name not in _READERS}
        info = {**info, "env_kwargs": kwargs if pack is None else {**kwargs, "pack": "builtin"}}
    try:
        found = _Info.model_validate(info)
    except ValidationError as error:
        raise _refusal(error, where) from error
    env_id = found.env_id.removeprefix(_PREFIX)
    if not re.fullmatch(r"\w+-v\d+", env_id):
        raise DatasetError(
            "a file can't choose this", where=f"{where}, env_id", expected="id of a task", found=found.env_id
        )
    kwargs = found.env_kwargs.model_dump(exclude_unset=True, exclude={"control_mode"})
    for name in ("sim_config", "sensor_configs"):
        _check_settings(kwargs.get(name, {}), f"{where}, env_kwargs.{name}", _DEEP)
    return RecordedEnv(env_id, found.env_kwargs.control_mode, kwargs).with_pack(pack)


def recorded_id(env_id: str) -> str:
    return f"{_PREFIX}{env_id}"


def _refusal(error: ValidationError, where: object) -> DatasetError:
    first = list_invalid_values(error, _Info)[0]
    name, fix, expected = first.key.rpartition(".")[2], first.fix, first.expected
    if first.kind == "string_pattern_mismatch":
        expected = "a name, no path"
        if name in ("pack", "furniture_pack"):
            fix = "Pass the pack with --pack, if you trust it." if name == "pack" else "Install that pack by name."
    what = first.what if first.kind == "value_error" else "the recorded environment can't be read"
    where = f"{where}, {first.key}" if first.key else where
    return DatasetError(what, where=where, expected=expected, found=first.found, fix=fix)


def _check_settings(settings: Any, where: str, deep: int) -> None:
    if isinstance(settings, dict) and deep:
        for key, value in settings.items():
            _check_settings(value, f"{where}.{key}", deep - 1)
    elif isinstance(settings, list) and len(settings) <= 16 and deep:
        for value in settings:
            _check_settings(value, where, 0)
    elif not _is_setting(settings):
        raise DatasetError("no such setting", where=where, expected="a number or a name", found=str(settings)[:80])


def _is_setting(value: Any) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    return value is None or isinstance(value, int) or (isinstance(value, str) and bool(_NAME.fullmatch(value)))
