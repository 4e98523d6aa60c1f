"""Read the instructions and synonyms that lie beside this file."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from string import Formatter
from typing import Annotated, Literal, TypeVar

from pydantic import Field, model_validator

from robocas_ms3.core.documents import load_yaml
from robocas_ms3.core.errors import ConfigError
from robocas_ms3.core.strict import StrictModel, parse
from robocas_ms3.scenes.config.relations import Relation
from robocas_ms3.scenes.task_specs import TASKS, TaskSpec

Split = Literal["upstream", "train", "held_out"]

INSTRUCTIONS_FILE = Path(__file__).with_name("instructions.yaml")
SYNONYMS_FILE = Path(__file__).with_name("synonyms.yaml")

Words = tuple[Annotated[str, Field(min_length=1)], ...]
_Model = TypeVar("_Model", bound=StrictModel)
_REPEATABLE = {"it", "on"}


class Templates(StrictModel):
    """The templates of a task; ``upstream`` is the default."""

    upstream: Annotated[Words, Field(min_length=1)]
    train: Words
    held_out: Words

    @classmethod
    def for_task(cls, spec: TaskSpec) -> Templates:
        """The templates of a task: those of its row, or of ``instructions.yaml``.

        Raises:
            ConfigError: they are not what templates have to be.
        """
        if not spec.instructions:
            return instruction_texts().tasks[spec.name]
        try:
            templates = cls.model_validate({"train": (), "held_out": (), **spec.instructions})
            templates.check(spec)
        except ValueError as error:  # pydantic's as well
            raise ConfigError(
                "wrong instructions", where=f"task {spec.name}", found=" ".join(str(error).split())
            ) from error
        return templates

    def check(self, spec: TaskSpec) -> None:
        """See that each has the fields that the task's templates have to have.

        Raises:
            ValueError: one hasn't.
        """
        needed = {"object", *({"part"} & set(spec.slots))}
        for template in (*self.upstream, *self.train, *self.held_out):
            _check_fields(template, needed=needed, allowed=needed | {"support"} | _REPEATABLE)

    def of(self, split: Split) -> Words:
        """Templates of one split."""
        return {"upstream": self.upstream, "train": self.train, "held_out": self.held_out}[split]


class Synonyms(StrictModel):
    """Other words for a thing."""

    train: Words = ()
    held_out: Words = ()

    def of(self, split: Split) -> Words:
        """Words of one split; upstream has none."""
        return {"upstream": (), "train": self.train, "held_out": self.held_out}[split]


class SupportWords(Synonyms):
    """Other words for a support, and whether things are in it (cabinet) or on it (table)."""

    inside: bool = False


class RelationPhrases(Synonyms):
    """How a relation is said; a phrase has one ``{object}``."""

    plain: str

    @model_validator(mode="after")
    def _fields(self) -> RelationPhrases:
        for phrase in (self.plain, *self.train, *self.held_out):
            _check_fields(phrase, needed={"object"}, allowed={"object"})
        return self


class InstructionTexts(StrictModel):
    """What ``instructions.yaml`` says."""

    tasks: dict[str, Templates]
    relations: dict[Relation, RelationPhrases]

    @model_validator(mode="after")
    def _fields(self) -> InstructionTexts:
        for task, templates in self.tasks.items():
            if task not in TASKS.builtin:
                raise ValueError(f"no such task: {task}")
            templates.check(TASKS.builtin[task])
        return self


class SynonymTexts(StrictModel):
    """What ``synonyms.yaml`` says."""

    plurals: Words
    objects: dict[str, Synonyms]
    supports: dict[str, SupportWords]


@lru_cache
def instruction_texts() -> InstructionTexts:
    """Templates of all tasks and phrases of all relations."""
    return read_texts(INSTRUCTIONS_FILE, InstructionTexts)


@lru_cache
def synonym_texts() -> SynonymTexts:
    """Synonyms of objects and supports."""
    return read_texts(SYNONYMS_FILE, SynonymTexts)


def read_texts(path: Path, model: type[_Model]) -> _Model:
    """Read a file of texts.

    Raises:
        ConfigError: unknown keys, wrong types, a template with wrong fields: the first mistake.
    """
    return parse(model, load_yaml(path), ConfigError, where=path)


def _check_fields(template: str, *, needed: set[str], allowed: set[str]) -> None:
    """Each needed field once, others allowed at most once; only {it} and {on} may come again."""
    fields = [field for _, field, _, _ in Formatter().parse(template) if field is not None]
    wrong = (set(fields) - allowed) | (needed - set(fields))
    wrong |= {field for field in fields if fields.count(field) > 1} - _REPEATABLE
    if wrong:
        raise ValueError(f"{template!r}: unknown, missing or repeated fields {sorted(wrong)}")
