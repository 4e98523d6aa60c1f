"""Templates, relations and synonyms of instructions, read from two YAML files of this package."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from string import Formatter
from typing import Annotated, Literal, TypeVar

from pydantic import Field, model_validator

from robocas_ms3.core.documents import load_yaml
from robocas_ms3.core.errors import ConfigError
from robocas_ms3.core.strict_model import StrictModel, parse
from robocas_ms3.core.text import one_line
from robocas_ms3.scenes.relations import Relation
from robocas_ms3.scenes.task_specs import TASKS, TaskSpec

Split = Literal["upstream", "train", "held_out"]

INSTRUCTIONS_FILE = Path(__file__).with_name("instructions.yaml")
SYNONYMS_FILE = Path(__file__).with_name("synonyms.yaml")

Words = tuple[Annotated[str, Field(min_length=1)], ...]
_Model = TypeVar("_Model", bound=StrictModel)
_REPEATABLE = {"it", "on"}


class Synonyms(StrictModel):
    """Synonyms of one name, by split. The split ``upstream`` has none."""

    train: Words = ()
    held_out: Words = ()

    def for_split(self, split: Split) -> Words:
        """Return the texts of a split; empty if it has none."""
        return getattr(self, split, ())


class Templates(Synonyms):
    """Instruction templates of one task, by split. ``upstream`` is the default split."""

    upstream: Annotated[Words, Field(min_length=1)]

    @classmethod
    def for_task(cls, spec: TaskSpec) -> Templates:
        """Return the instruction templates of a task.

        They are those of the `TaskSpec` if it has any, and otherwise those of ``instructions.yaml``.

        Raises:
            ConfigError: a template is invalid.
        """
        if not spec.instructions:
            return load_instruction_texts().tasks[spec.name]
        try:
            templates = cls.model_validate(spec.instructions)
            templates.check(spec)
        except ValueError as error:  # also pydantic's ValidationError
            what = "invalid instruction templates"
            raise ConfigError(what, where=f"task {spec.name}", found=one_line(error)) from error
        return templates

    def check(self, spec: TaskSpec) -> None:
        """Raise ValueError if a template has a missing, unknown or repeated field."""
        needed = {"object", *({"part"} & set(spec.slots))}
        for template in (*self.upstream, *self.train, *self.held_out):
            _check_fields(template, needed=needed, allowed=needed | {"support"} | _REPEATABLE)


class SupportWords(Synonyms):
    """Synonyms of a support, and whether objects are inside of it.

    Objects are inside of a cabinet, but on a table.
    """

    inside: bool = False


class RelationPhrases(Synonyms):
    """Phrases of one relation, by split. Each phrase contains ``{object}`` once."""

    plain: str

    @model_validator(mode="after")
    def _check_texts(self) -> RelationPhrases:
        for phrase in (self.plain, *self.train, *self.held_out):
            _check_fields(phrase, needed={"object"}, allowed={"object"})
        return self


class InstructionTexts(StrictModel):
    """The content of ``instructions.yaml``."""

    tasks: dict[str, Templates]
    relations: dict[Relation, RelationPhrases]

    @model_validator(mode="after")
    def _check_texts(self) -> InstructionTexts:
        for task, templates in self.tasks.items():
            templates.check(TASKS.builtin[task])
        return self


class SynonymTexts(StrictModel):
    """The content of ``synonyms.yaml``."""

    plurals: Words
    objects: dict[str, Synonyms]
    supports: dict[str, SupportWords]


@lru_cache
def load_instruction_texts() -> InstructionTexts:
    return read_texts(INSTRUCTIONS_FILE, InstructionTexts)


@lru_cache
def load_synonym_texts() -> SynonymTexts:
    return read_texts(SYNONYMS_FILE, SynonymTexts)


def read_texts(path: Path, model: type[_Model]) -> _Model:
    return parse(model, load_yaml(path), ConfigError, where=path)


def _check_fields(template: str, *, needed: set[str], allowed: set[str]) -> None:
    """Raise ValueError if a field is missing, unknown or repeated.

    Only {it} and {on} may occur several times.
    """
    fields = [field for _, field, _, _ in Formatter().parse(template) if field is not None]
    wrong = {
        "unknown": set(fields) - allowed,
        "missing": needed - set(fields),
        "repeated": {field for field in fields if fields.count(field) > 1} - _REPEATABLE,
    }
    for fault, names in wrong.items():
        if names:
            expected = f"each of {sorted(needed)} once, and other fields only of {sorted(allowed - needed)}"
            raise ValueError(f"{template!r}: {fault} fields {sorted(names)}, expected {expected}")
