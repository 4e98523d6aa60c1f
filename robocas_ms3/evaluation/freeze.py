"""Make a protocol from a plan: choose its scenes and write them to files."""

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

INVALID_PLAN = "no plan of a protocol"
_WRONG = 300  # stream of the object that a wrong instruction names


class ConfigVariant(StrictModel):
    """A configuration with changes."""

    config: str = Field(description="name of a shipped configuration, or a YAML file, from the plan's folder")
    name: str = Field(
        default="",
        pattern=r"^[A-Za-z0-9_-]*$",
        description="of the file it becomes; default: the configuration's, and the split's",
    )
    change: dict[str, Any] = Field(default={}, description="keys that have other values, in the configuration's form")

    def resolve(self, overrides: Sequence[str] = ()) -> TaskConfig:
        """Return the resolved configuration: the file, with ``change`` and then ``overrides`` merged over it."""
        return load_task_config(self.config, self.change, overrides)

    @property
    def file(self) -> str:
        return self.name or Path(self.config).stem


class ProtocolPart(ConfigVariant):
    """Episodes of one configuration."""

    count: int = Field(ge=1, description="how many episodes")
    first_seed: int = Field(ge=0, description="of which seeds; those without a layout are skipped, and more taken")
    split: str = "test"
    instruction: Literal["correct", "wrong", "empty"] = Field(
        default="correct",
        description="the target's instruction, one that names another object, or an empty text",
    )

    @property
    def file(self) -> str:
        return self.name or super().file + ("" if self.split == "test" else f"-{self.split}")


class ProtocolPlan(StrictModel):
    """What a protocol is made from."""

    rules: dict[str, object] = Field(description="of `Protocol`, but for the pack's hash")
    parts: list[ProtocolPart]
    train: list[ConfigVariant] = Field(default=[], description="configurations to train on")
    lists: dict[str, Any] = Field(default={}, description="for YAML's anchors: lists that changes refer to")


def read_plan(path: Path) -> ProtocolPlan:
    """Read a plan. Files that it names are in its folder, or where the command runs."""
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
    """Write a protocol into a folder, which appears whole; yield the number of episodes that are chosen, and of all.

    ``overrides`` are keys to set in all its configurations, see `load_task_config`.
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
        # A protocol that names no robot has the default.
        _write_yaml(
            rules.model_dump(mode="json", exclude={"robot"} if rules.robot == DEFAULT_ROBOT else None), tmp / RULES
        )


def _configs(parts: Sequence[ConfigVariant], overrides: Sequence[str]) -> dict[str, TaskConfig]:
    found: dict[str, TaskConfig] = {}
    for part in parts:
        config = part.resolve(overrides)
        if not re.fullmatch(CONFIG_NAME, part.file) or len(part.file) > MAX_NAME_BYTES:
            what, fix = "invalid name of a configuration", "Give it a `name`, and a plain `split`."
            expected = f"letters, digits, _ and -, at most {MAX_NAME_BYTES}"
            raise EvaluationError(what, where=part.config, expected=expected, found=repr(part.file)[:80], fix=fix)
        if found.setdefault(part.file, config) != config:
            raise EvaluationError("two configurations of one name", where=part.file, fix="Give one of them a `name`.")
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
        raise EvaluationError("no other object whose name would be wrong", where=f"{part.file}, seed {seed}")
    rng = np.random.default_rng([seed, _WRONG])
    return env.instruction(0, others[int(rng.integers(len(others)))]).text
