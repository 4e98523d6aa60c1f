"""Names of modules and public classes are nouns: no participle and no pronoun."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PRONOUNS = re.compile("it|its|itself|ones?|others?|own|that|them|they|this|those|what|which|who|whose")
PARTICIPLES = re.compile(
    r"\w+(ing|ed)s?|begun|done|driven|fallen|found|given|gone|grown|held|kept|known|left|lost|made|met|put|said|seen|sent"
    "|shown|stood|stuck|taken|thrown|told|worn|written"
)
NOUNS = {  # words that end like a participle, or are one, and are the field's term
    "backtracking": "a search method",
    "embed": "a verb: embed texts",
    "finding": "what a check reports",
    "mapping": "texture mapping",
    "planning": "motion planning",
    "recording": "a recorded episode",
    "recordings": "recorded episodes",
    "scripted": "ManiSkill's and LeRobot's word for a policy that follows a script",
    "seeds": "a noun",
    "settings": "configuration values",
    "supervised": "supervised training",
    "surroundings": "the obstacles around a robot",
    "training": "the training of a network",
}
FILES = [path for package in ("robocas_ms3", "asset_tools") for path in sorted((ROOT / package).rglob("*.py"))]


def words_of(name: str) -> list[str]:
    """Return the words of a CamelCase or snake_case name in lower case."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)]


def is_noun(name: str) -> bool:
    """Return whether a name has no pronoun, and its last word is no participle."""
    words = words_of(name)
    if any(PRONOUNS.fullmatch(word) for word in words):
        return False
    return words[-1] in NOUNS or not PARTICIPLES.fullmatch(words[-1])


def module_name(path: Path) -> str:
    return path.parent.name if path.stem == "__init__" else path.stem


def public_classes(path: Path) -> list[str]:
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    return [node.name for node in nodes if isinstance(node, ast.ClassDef) and not node.name.startswith("_")]


@pytest.mark.parametrize("name", ["Recorded", "begun", "EpisodeDrawing", "OtherSide", "its_values", "stepping"])
def test_participles_and_pronouns_are_recognised(name):
    assert not is_noun(name)


@pytest.mark.parametrize("name", ["EpisodeSpec", "RenderedSource", "TrainSettings", "seeds", "RT1Model"])
def test_nouns_are_recognised(name):
    assert is_noun(name)


def test_modules_and_public_classes_are_named_by_nouns():
    found = [
        (str(path.relative_to(ROOT)), name) for path in FILES for name in [module_name(path), *public_classes(path)]
    ]
    wrong = [(path, name) for path, name in found if not is_noun(name)]
    assert wrong == []


def test_every_exception_is_used():
    names = {name for path in FILES for name in [module_name(path), *public_classes(path)]}
    assert NOUNS.keys() <= {words_of(name)[-1] for name in names}
