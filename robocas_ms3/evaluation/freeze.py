"""Freeze a protocol from a plan: sample its scenes and write them to files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import yaml
from pydantic import Field

import robocas_ms3.tasks  # noqa: F401  (registers the environments)
from robocas_ms3.assets.pack import MANIFEST, load_pack, sha256
from robocas_ms3.core.documents import DocumentError, load_yaml
from robocas_ms3.core.errors import EvaluationError, LayoutError
from robocas_ms3.core.files import atomic_file, atomic_folder, make_folder
from robocas_ms3.core.strict_model import MAX_NAME_BYTES, StrictModel, parse
from robocas_ms3.evaluation.protocol import (
    CONFIG_NAME,
    CONFIGS,
    EPISODES,
    INVALID_RULES,
    LAYOUTS,
    RULES,
    TRAIN,
    Protocol,
    ProtocolEpisode,
)
from robocas_ms3.robots.registry import DEFAULT_ROBOT
from robocas_ms3.scenes.config import TaskConfig, bundled_configs, load_task_config
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.scenes.layout_table import write_frozen_layouts
from robocas_ms3.scenes.task_specs import TASKS
from robocas_ms3.tasks.base import RoboCASEnv

INVALID_PLAN = "invalid protocol plan"
_WRONG = 300  # random stream that draws the object of a wrong instruction


class ConfigVariant(StrictModel):
    """A task configuration with changed keys."""

    config: str = Field(description="name of a bundled configuration, or a YAML file relative to the plan")
    name: str = Field(
        default="",
        pattern=r"^[A-Za-z0-9_-]*$",
        description="name of the written file; default: name of the configuration, with the split",
    )
    change: dict[str, Any] = Field(default={}, description="changed keys, in the format of the configuration")

    def resolve(self, overrides: Sequence[str] = ()) -> TaskConfig:
        """Return the configuration of the file with ``change`` and then ``overrides`` applied."""
        return load_task_config(self.config, self.change, overrides)

    @property
    def file(self) -> str:
        """Return the name of the written file, without suffix."""
        return self.name or Path(self.config).stem


class ProtocolPart(ConfigVariant):
    """Episodes of one configuration in a protocol plan."""

    count: int = Field(ge=1, description="number of episodes")
    first_seed: int = Field(ge=0, description="first scene seed; seeds without a layout are skipped")
    split: str = "test"
    instruction: Literal["correct", "wrong", "empty"] = Field(
        default="correct",
        description="correct: names the target; wrong: names another object; empty: no text",
    )

    @property
    def file(self) -> str:
        return self.name or super().file + ("" if self.split == "test" else f"-{self.split}")


class ProtocolPlan(StrictModel):
    """Plan of a protocol: rules, episodes, and configurations for training."""

    rules: dict[str, object] = Field(description="fields of `Protocol` without pack_hash")
    parts: list[ProtocolPart]
    train: list[ConfigVariant] = Field(default=[], description="configurations for training")
    lists: dict[str, Any] = Field(default={}, description="YAML anchors that `change` refers to")


def read_plan(path: Path) -> ProtocolPlan:
    """Read a plan; paths of configurations are relative to the plan or to the working directory."""
    try:
        data = load_yaml(path)
    except (OSError, DocumentError) as error:
        raise EvaluationError(INVALID_PLAN, where=path, found=error) from error
    plan = parse(ProtocolPlan, data, EvaluationError, where=path, about=INVALID_PLAN)

    def resolve_file(scene: ConfigVariant) -> ConfigVariant:
        file = path.parent / scene.config
        own = file.is_file() and scene.config not in bundled_configs()
        return scene.model_copy(update={"config": str(file)}) if own else scene

    return plan.model_copy(update={name: list(map(resolve_file, getattr(plan, name))) for name in ("parts", "train")})


def freeze(plan: ProtocolPlan, folder: Path, overrides: Sequence[str] = ()) -> Iterator[tuple[int, int]]:
    """Write a protocol into a folder atomically; yield the number of sampled episodes and of all episodes.

    ``overrides``: keys to set in all configurations, see `load_task_config`.
    """
    pack = load_pack(str(plan.rules.get("pack", "builtin")))
    values = {**plan.rules, "pack_hash": sha256(pack.root / MANIFEST)}
    rules = parse(Protocol, values, EvaluationError, where="rules", about=INVALID_RULES)
    configs, train = _configs(plan.parts, overrides), _configs(plan.train, overrides)
    total, episodes = sum(part.count for part in plan.parts), []
    with atomic_folder(folder) as tmp:
        make_folder(tmp / LAYOUTS)
        for inside, named in ((CONFIGS, configs), (TRAIN, train)):
            for name, config in named.items():
                _write_yaml(config.model_dump(mode="json"), make_folder(tmp / inside) / f"{name}.yaml")
        scenes: dict[str, dict[int, Layout]] = {}
        for part in plan.parts:
            for seed, layout, env in _scenes(part, configs[part.file], str(rules.pack)):
                scenes.setdefault(part.file, {})[seed] = layout
                episodes.append(_episode(len(episodes), part, seed, layout, env))
                yield len(episodes), total
        for name, found in scenes.items():
            write_frozen_layouts(tmp / LAYOUTS / f"{name}.npy", pack.objects, found)
        with atomic_file(tmp / EPISODES) as file:
            file.write_text("".join(f"{episode.model_dump_json()}\n" for episode in episodes), encoding="utf-8")
        # The default robot is left out of the file.
        _write_yaml(
            rules.model_dump(mode="json", exclude={"robot"} if rules.robot == DEFAULT_ROBOT else None), tmp / RULES
        )


def _configs(parts: Sequence[ConfigVariant], overrides: Sequence[str]) -> dict[str, TaskConfig]:
    found: dict[str, TaskConfig] = {}
    for part in parts:
        config = part.resolve(overrides)
        if not re.fullmatch(CONFIG_NAME, part.file) or len(part.file) > MAX_NAME_BYTES:
            what, fix = "invalid name of a configuration", "Set `name`, and use a `split` of letters and digits."
            expected = f"letters, digits, _ and -, at most {MAX_NAME_BYTES}"
            raise EvaluationError(what, where=part.config, expected=expected, found=repr(part.file)[:80], fix=fix)
        if found.setdefault(part.file, config) != config:
            raise EvaluationError("two configurations have the same name", where=part.file, fix="Set `name` of one.")
    return found


def _write_yaml(values: dict[str, Any], path: Path) -> None:
    path.write_text(yaml.safe_dump(values, sort_keys=False, allow_unicode=True), encoding="utf-8")


def _scenes(part: ProtocolPart, config: TaskConfig, pack: str) -> Iterator[tuple[int, Layout, RoboCASEnv]]:
    env = gym.make(TASKS[config.task].env_id, config=config, pack=pack, obs_mode="none", render_backend="none")
    base: Any = env.unwrapped
    try:
        seed, found = part.first_seed, 0
        while found < part.count:
            try:
                env.reset(seed=seed)
                yield seed, base.layout(), base
                found += 1
            except LayoutError:
                if seed - part.first_seed > 2 * part.count + 20:
                    raise
            seed += 1
    finally:
        env.close()


def _episode(number: int, part: ProtocolPart, seed: int, layout: Layout, env: RoboCASEnv) -> ProtocolEpisode:
    p_vis = float(layout.visible_fractions[layout.target])
    return ProtocolEpisode(
        episode=number,
        task=env.SPEC.name,
        config=part.file,
        seed=seed,
        split=part.split,
        instruction=_instruction(part, env, seed),
        target=layout.object_ids[layout.target],
        p_vis=None if np.isnan(p_vis) else round(p_vis, 4),
    )


def _instruction(part: ProtocolPart, env: RoboCASEnv, seed: int) -> str:
    if part.instruction == "empty":
        return ""
    if part.instruction == "correct":
        return env.instruction().text
    others = sorted(env.object_names() - {env.target_asset().asset.name})
    if not others:
        what, fix = "instruction: wrong needs a second kind of object", "Increase objects.count."
        raise EvaluationError(what, where=f"{part.file}, seed {seed}", fix=fix)
    rng = np.random.default_rng([seed, _WRONG])
    return env.instruction(0, others[int(rng.integers(len(others)))]).text
