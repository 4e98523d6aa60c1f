"""Make a protocol: draw its episodes, keep their scenes, write them down once and for all."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import yaml
from pydantic import Field, ValidationError

import robocas_ms3.tasks  # noqa: F401  (registers the environments)
from robocas_ms3.assets.pack import MANIFEST, load_pack, sha256
from robocas_ms3.config import load_task_config
from robocas_ms3.config.task import StrictModel
from robocas_ms3.errors import EvaluationError, LayoutError
from robocas_ms3.evaluation.protocol import CONFIGS, EPISODES, LAYOUTS, RULES, Episode, Protocol
from robocas_ms3.files import make_folder, replacing, replacing_folder
from robocas_ms3.scenes.frozen import write_frozen
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.tasks.spec import TASKS
from robocas_ms3.tasks.transfer import TransferEnv


class Part(StrictModel):
    """Episodes of one configuration."""

    config: str = Field(description="name of a shipped configuration, or a YAML file")
    count: int = Field(ge=1, description="how many episodes")
    first_seed: int = Field(ge=0, description="of which seeds; those without a layout are left out, and more taken")
    split: str = "test"


class Plan(StrictModel):
    """What a protocol is made from."""

    rules: dict[str, object] = Field(description="of `Protocol`, but for the pack's hash")
    parts: list[Part]


def freeze(plan: Plan, folder: Path, layouts: str | Path | None = "auto") -> Iterator[tuple[int, int]]:
    """Write a protocol into a folder, which appears whole.

    Args:
        plan: what it is made from.
        folder: that it becomes.
        layouts: bank to take scenes from.

    Yields:
        How many episodes are drawn, of how many.

    Raises:
        EvaluationError: the rules are none of a protocol.
    """
    pack = load_pack(str(plan.rules.get("pack", "builtin")))
    try:
        rules = Protocol.model_validate({**plan.rules, "pack_hash": sha256(pack.root / MANIFEST)})
    except ValidationError as error:
        found = " ".join(str(error).split())
        raise EvaluationError("no rules of a protocol", where="rules", found=found) from error
    total, episodes = sum(part.count for part in plan.parts), []
    with replacing_folder(folder) as tmp:
        for inside in (CONFIGS, LAYOUTS):
            make_folder(tmp / inside)
        scenes: dict[str, dict[int, Layout]] = {}
        for part in plan.parts:
            config = load_task_config(part.config)
            name = Path(part.config).stem
            for seed, layout, env in _scenes(part, str(rules.pack), layouts):
                scenes.setdefault(name, {})[seed] = layout
                episodes.append(_episode(len(episodes), name, part, seed, layout, env))
                yield len(episodes), total
            text = yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
            (tmp / CONFIGS / f"{name}.yaml").write_text(text, encoding="utf-8")
        for name, found in scenes.items():
            write_frozen(tmp / LAYOUTS / f"{name}.npy", pack.objects, found)
        with replacing(tmp / EPISODES) as file:
            file.write_text("".join(f"{episode.model_dump_json()}\n" for episode in episodes), encoding="utf-8")
        said = yaml.safe_dump(rules.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
        (tmp / RULES).write_text(said, encoding="utf-8")


def _scenes(part: Part, pack: str, layouts: str | Path | None) -> Iterator[tuple[int, Layout, TransferEnv]]:
    config = load_task_config(part.config)
    env = gym.make(
        TASKS[config.task].env_id,
        config=config,
        pack=pack,
        layouts=layouts,
        obs_mode="none",
        render_backend="none",
    )
    try:
        base = env.unwrapped
        assert isinstance(base, TransferEnv)
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


def _episode(number: int, name: str, part: Part, seed: int, layout: Layout, env: TransferEnv) -> Episode:
    share = float(layout.visible_shares[layout.target])
    return Episode(
        episode=number,
        task=env.SPEC.name,
        config=name,
        seed=seed,
        split=part.split,
        instruction=env.instruction().text,
        target=layout.object_ids[layout.target],
        p_vis=None if share != share else round(share, 4),  # noqa: PLR0124  (NaN: it was not asked for)
    )
