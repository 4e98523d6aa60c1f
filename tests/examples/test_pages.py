"""Links between our pages lead somewhere, and the commands that they print are ones that there are."""

import re
import shlex
from collections.abc import Iterable
from pathlib import Path

import pytest

from robocas_ms3.cli import main as cli

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
_SHELL = re.compile(r"^```(?:bash|sh|console)?\n(.*?)^```", re.DOTALL | re.MULTILINE)
_NO_COMMANDS = ("...", "import-...", "COMMAND", "v0", "--version", "--help")
_OF_OTHERS = ("push_zone",)  # a task of the package that docs/extending.md makes


def anchors(text: str) -> set[str]:
    """Of its headings, as GitHub makes them."""
    heads = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).strip().replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    prose = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    for target in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`]*`", "", prose)):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        path = (page.parent / file).resolve() if file else page
        assert path.exists(), f"{page.name}: {target}"
        assert path.is_relative_to(ROOT), f"{page.name}: {target} leads out of the repository"
        if anchor:
            assert anchor in anchors(path.read_text(encoding="utf-8")), f"{page.name}: {target}"


def commands(page: Path) -> list[list[str]]:
    """Words of every `robocas ...` of a page's shell blocks, and of its text where options are given."""
    return [*shell_commands(page), *text_commands(page)]


def shell_commands(page: Path) -> list[list[str]]:
    blocks = _SHELL.findall(page.read_text(encoding="utf-8"))
    return split_words(line for block in blocks for line in re.sub(r"\s*\\\n\s*", " ", block).splitlines())


def text_commands(page: Path) -> list[list[str]]:
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return split_words(re.findall(r"`(robocas [^`]+)`", text))


def split_words(lines: Iterable[str]) -> list[list[str]]:
    """Words after `robocas`, without what belongs to the shell or explains the command."""
    found = []
    for line in lines:
        match = re.search(r"(?:^|[;&] ?|\$ |\S*/|=\S+ )robocas (.+)", line)
        if match:
            told = re.split(r" (?:[;|&>]|2>| )", f"{match[1]} ")[0]  # two blanks: what it does
            found.append(shlex.split(told, comments=True))
    return [words for words in found if words and words[0] not in _NO_COMMANDS and words[1:2] != ["..."]]


def test_commands_are_found():
    found = [words for page in PAGES for words in commands(page)]
    assert len(found) > 100
    assert {words[0] for words in found} >= set(cli.COMMANDS)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_are_ones_that_there_are(page, capsys):
    for words in shell_commands(page):
        cli.parse([word for word in words if word not in _OF_OTHERS])
    for words in text_commands(page):  # these may lack what is required
        shown = help_of(words, capsys)
        for flag in re.findall(r"--[a-z-]+", " ".join(words)):
            assert flag in shown, f"{page.name}: robocas {' '.join(words)}"


def help_of(words: list[str], capsys) -> str:
    """Help of the command that a command line starts with."""
    named = words[:2] if words[1:] and words[1] in getattr(cli.module_of(words[0]), "COMMANDS", ()) else words[:1]
    if named == ["eval"]:
        named = ["eval", "run"]
    with pytest.raises(SystemExit) as caught:
        cli.parse([*named, "--help"])
    assert caught.value.code == 0, words
    return capsys.readouterr().out
