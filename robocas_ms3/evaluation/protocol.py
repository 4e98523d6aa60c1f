"""A protocol: episodes and rules of an evaluation, frozen in a folder.

::

    protocol.yaml            the rules, see `Protocol`
    episodes.jsonl           an episode per line, see `ProtocolEpisode`
    configs/NAME.yaml        the configurations that episodes name, whole
    layouts/NAME.npy         the scenes of a configuration's episodes (`scenes.layout_table.FrozenLayouts`)
    train/NAME.yaml          of a suite that holds something out: configurations without it, to train on

Results of one hash were measured by the same files.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from robocas_ms3.core.checks import MAX_SEED, parse_shard
from robocas_ms3.core.documents import ARRAYS_LIMIT, JSON_LIMIT, DocumentError, load_yaml, read_bytes, read_text
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.paths import protocols_dir
from robocas_ms3.core.strict_model import MAX_NAME_BYTES, FileName, StrictModel, did_you_mean, parse, parse_json
from robocas_ms3.evaluation.policy import CONVENTIONS, PolicySpec
from robocas_ms3.evaluation.settings import EvaluationSettings
from robocas_ms3.robots.registry import DEFAULT_ROBOT, find_robot
from robocas_ms3.scenes.config.load import check_no_extends, load_task_config
from robocas_ms3.scenes.task_specs import TASKS

INVALID_RULES = "no rules of a protocol"
DEFAULT_HZ = 20  # if neither protocol nor policy names a rate
CONFIG_NAME = r"^[A-Za-z0-9_-]+$"
RULES, EPISODES, CONFIGS, LAYOUTS, TRAIN = "protocol.yaml", "episodes.jsonl", "configs", "layouts", "train"


class Protocol(StrictModel):
    """Rules of all episodes of a protocol."""

    name: FileName = Field(description="its results are written below a folder of this name")
    description: str = Field(description="what a score by it says")
    rate_hz: Annotated[int, Field(ge=1, le=100)] | None = Field(
        default=None, description="actions per second; null: what the policy wants, else 20"
    )
    stepping: Literal["timed", "upstream"] = Field(
        default="timed", description="a step is one action of 1 / rate_hz s; or gripper, then motion, as upstream's"
    )
    max_steps: Annotated[int, Field(ge=1, le=10**7)] | None = Field(default=None, description="actions per episode")
    max_seconds: dict[str, Annotated[float, Field(gt=0, le=10**6)]] = Field(
        default={}, description="by task, simulated s per episode; max_steps, if given, ends it earlier"
    )
    conventions: list[str] = Field(default=sorted(CONVENTIONS), description="of actions that a policy may have")
    references: list[Literal["tcp", "target"]] = Field(
        default=["tcp", "target"], description="that its motions may be relative to"
    )
    ends_on: list[Literal["success", "fail", "success_v0"]] = Field(
        default=["success", "fail"], description="flags at which an episode ends"
    )
    max_v0_steps: Annotated[int, Field(ge=1, le=10**7)] | None = Field(
        default=None, description="it also ends when upstream's success has held after so many actions"
    )
    robot: str = Field(default=DEFAULT_ROBOT, description="that acts")
    pack: str = Field(default="builtin", description="object pack")
    pack_hash: str = Field(description="sha256 of its manifest")

    @model_validator(mode="after")
    def _check_names(self) -> Protocol:
        named = (("conventions", self.conventions, CONVENTIONS), ("max_seconds", self.max_seconds, TASKS))
        for key, found, known in named:
            unknown = sorted(set(found) - set(known))
            if unknown:
                raise ValueError(f"{key}: expected some of {', '.join(known)}, found {', '.join(unknown)}")
        if self.stepping == "upstream" and self.max_steps is None:
            raise ValueError("stepping upstream needs max_steps: its steps take any time")
        return self

    def step_limit(self, task: str, rate: int) -> int | None:
        """Return the maximum number of actions per episode of a task at a rate; None: no maximum."""
        seconds = self.max_seconds.get(task) if self.stepping == "timed" else None
        ends = [self.max_steps, None if seconds is None else round(seconds * rate)]
        return min((steps for steps in ends if steps is not None), default=None)

    def check_policy(self, spec: PolicySpec) -> None:
        """Check that a policy can be evaluated by this protocol."""
        for what, found, allowed in (
            ("convention", spec.convention, self.conventions),
            ("reference", spec.reference, self.references),
        ):
            if found not in allowed:
                message, expected = f"the policy's {what} is none of this protocol's", " or ".join(allowed)
                raise EvaluationError(message, where=self.name, expected=expected, found=found)
        if self.rate_hz is not None and spec.rate_hz not in (None, self.rate_hz):
            expected, found = f"{self.rate_hz} Hz", f"{spec.rate_hz:g} Hz"
            raise EvaluationError("the policy acts at another rate", where=self.name, expected=expected, found=found)

    def action_rate(self, spec: PolicySpec) -> int:
        """Return the number of actions per second."""
        rate = self.rate_hz or spec.rate_hz or DEFAULT_HZ
        if rate < 1 or rate != int(rate) or 100 % int(rate):
            raise EvaluationError("no such rate", where="rate_hz", expected="a divisor of 100", found=f"{rate:g}")
        return int(rate)


class ProtocolEpisode(StrictModel):
    """One episode of a protocol's list."""

    episode: Annotated[int, Field(ge=0, le=10**7)] = Field(description="its number, from 0 on")
    task: str
    config: Annotated[str, Field(pattern=CONFIG_NAME, max_length=MAX_NAME_BYTES)] = Field(
        description="name of a file in configs/"
    )
    seed: Annotated[int, Field(ge=0, le=MAX_SEED)]
    split: str = Field(default="test", description="what it belongs to, such as a suite's")
    instruction: str = Field(description="what the policy is told")
    target: str = Field(description="id of the object that is meant")
    p_vis: Annotated[float, Field(ge=0, le=1)] | None = Field(
        default=None, description="share of it that is visible from above; search"
    )


@dataclass(frozen=True)
class LoadedProtocol:
    """A protocol that was read: its folder, rules and episodes in the order of their numbers."""

    folder: Path
    rules: Protocol
    episodes: tuple[ProtocolEpisode, ...]

    @cached_property
    def hash(self) -> str:
        """Hex sha256 of its files, by their names."""
        digest = hashlib.sha256()
        for path in protocol_files(self.folder):
            try:
                content = hashlib.sha256(read_bytes(path, ARRAYS_LIMIT)).hexdigest()
            except (OSError, DocumentError) as error:
                raise EvaluationError("can't read a file of the protocol", where=path, found=error) from error
            digest.update(f"{path.relative_to(self.folder).as_posix()} {content}\n".encode())
        return digest.hexdigest()

    def select_episodes(self, settings: EvaluationSettings) -> list[ProtocolEpisode]:
        """Return the episodes that settings choose, at least one."""
        splits = (settings.split,) if settings.split else ()
        for kind, names in (("task", settings.tasks), ("split", splits)):
            known = dict.fromkeys(str(getattr(episode, kind)) for episode in self.episodes)
            for name in names:
                if name not in known:
                    other = "Name a protocol that has it, or make one: robocas eval freeze."
                    expected, fix = ", ".join(known), did_you_mean(name, known) or other
                    raise EvaluationError(f"the protocol has no such {kind}", expected=expected, found=name, fix=fix)
        (index, count), of_config, chosen = parse_shard(settings.shard, EvaluationError), Counter[str](), []
        for episode in self.episodes:
            if (settings.tasks and episode.task not in settings.tasks) or settings.split not in ("", episode.split):
                continue
            of_config[episode.config] += 1
            first = settings.episodes is None or of_config[episode.config] <= settings.episodes
            if first and episode.episode % count == index:
                chosen.append(episode)
        if not chosen:
            raise EvaluationError("no episodes in this shard", where=self.rules.name, found=settings.shard)
        return chosen

    def check_cameras(self, spec: PolicySpec, episodes: Sequence[ProtocolEpisode]) -> None:
        """Check that episodes have the cameras that a policy uses."""
        robot = find_robot(self.rules.robot).description
        for config in dict.fromkeys(episode.config for episode in episodes):
            known = [camera.name for camera in load_task_config(self.config_file(config)).cameras_of(robot)]
            for name in spec.cameras:
                if name not in known:
                    where, expected = f"{self.rules.name}, {config}", f"some of {', '.join(known)}"
                    fix = did_you_mean(name, known)
                    raise EvaluationError("no such camera", where=where, expected=expected, found=name, fix=fix)

    def check_same_configuration(self, episodes: Sequence[ProtocolEpisode], fix: str = "") -> None:
        """Check that episodes can run in one batch."""
        configs = list(dict.fromkeys(episode.config for episode in episodes))
        if len(configs) > 1:
            what, found = "episodes of several configurations in one batch", ", ".join(configs)
            raise EvaluationError(what, where=self.rules.name, expected="one", found=found, fix=fix)

    def config_file(self, config: str) -> Path:
        return self.folder / CONFIGS / f"{config}.yaml"

    def layouts_file(self, config: str) -> Path:
        return self.folder / LAYOUTS / f"{config}.npy"

    def training_configs(self) -> list[Path]:
        """Return the configurations to train on; none if nothing is held out."""
        return sorted(self.folder.glob(f"{TRAIN}/*.yaml"))


def protocol_files(folder: Path) -> list[Path]:
    """Return the files that a protocol is made of, sorted."""
    patterns = (f"{CONFIGS}/*.yaml", f"{LAYOUTS}/*.npy", f"{TRAIN}/*.yaml")
    return sorted([folder / RULES, folder / EPISODES, *(path for name in patterns for path in folder.glob(name))])


def shipped_protocols() -> dict[str, Path]:
    return {path.parent.name: path.parent for path in sorted(protocols_dir().glob(f"*/{RULES}"))}


def load_protocol(name: str | Path) -> LoadedProtocol:
    """Read a bundled protocol by name, or the protocol in a folder.

    Raises:
        EvaluationError: there is none, or a file of it is missing or invalid.
        ConfigError: one of its configurations extends another file, or cannot be read.
    """
    shipped = shipped_protocols()
    folder = shipped.get(str(name), Path(name)).absolute()
    if not (folder / RULES).is_file():
        expected, fix = (
            f"a folder with {RULES}, or one of {', '.join(sorted(shipped))}",
            did_you_mean(str(name), shipped),
        )
        raise EvaluationError("no such protocol", where=name, expected=expected, fix=fix)
    try:
        data = load_yaml(folder / RULES)
    except (OSError, DocumentError) as error:
        raise EvaluationError(INVALID_RULES, where=folder / RULES, found=error) from error
    rules = parse(Protocol, data, EvaluationError, where=folder / RULES, about=INVALID_RULES)
    loaded = LoadedProtocol(folder, rules, tuple(_episodes(folder / EPISODES)))
    for task in {episode.task for episode in loaded.episodes}:
        if task not in TASKS:
            raise EvaluationError("no such task", where=folder / EPISODES, expected=", ".join(TASKS), found=task)
        if rules.step_limit(task, 1) is None:
            fix = f"Give max_seconds.{task}, or max_steps."
            raise EvaluationError("episodes of this task would never end", where=folder / RULES, found=task, fix=fix)
    for config in {episode.config for episode in loaded.episodes}:
        for path in (loaded.config_file(config), loaded.layouts_file(config)):
            if not path.is_file():
                raise EvaluationError("a protocol's file is not there", where=path)
    for path in sorted((folder / CONFIGS).glob("*.yaml")) + loaded.training_configs():
        check_no_extends(path)
    return loaded


def _episodes(path: Path) -> Iterator[ProtocolEpisode]:
    try:
        lines = read_text(path, JSON_LIMIT).splitlines()
    except (OSError, DocumentError) as error:
        raise EvaluationError("can't read the episodes", where=path, found=error) from error
    for number, line in enumerate(lines):
        where = f"{path}:{number + 1}"
        episode = parse_json(ProtocolEpisode, line, EvaluationError, where=where, about="no episode")
        if episode.episode != number:
            raise EvaluationError("episodes are not in order", where=where, expected=number, found=episode.episode)
        yield episode
