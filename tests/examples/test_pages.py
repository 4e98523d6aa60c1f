"""Links between our pages lead somewhere, and the commands that they print are ones that there are."""

import re
import shlex
from pathlib import Path

import pytest

from robocas_ms3.cli import main as cli
from robocas_ms3.cli.spelling import misspelt

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
    text = page.read_text(encoding="utf-8")
    lines = [line for block in _SHELL.findall(text) for line in block.replace("\\\n", " ").splitlines()]
    prose = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    found = []
    for line in [*lines, *re.findall(r"`(robocas [^`]+)`", prose)]:
        match = re.search(r"(?:^|[;&] ?|\$ |\S*/|=\S+ )robocas (.+)", line)
        if match:
            told = re.split(r" (?:[;|&>]|2>| )", f"{match[1]} ")[0]  # two blanks: what it does
            found.append(shlex.split(told, comments=True))
    return [words for words in found if words]


def test_commands_are_found():
    found = [words for page in PAGES for words in commands(page)]
    assert len(found) > 100
    assert {words[0] for words in found} >= set(cli.COMMANDS)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_are_ones_that_there_are(page):
    for words in commands(page):
        wrong = mistake(words)
        assert not wrong, f"{page.name}: robocas {' '.join(words)}: {wrong}"


def mistake(words: list[str]) -> str:
    """What is wrong with the names of commands and options of a command line, and with its choices."""
    if words[0] in _NO_COMMANDS:
        return ""
    if words[0] not in cli.COMMANDS:
        return f"no such command: {words[0]}"
    prog, of_command, *rest = f"robocas {words[0]}", cli.config_type(cli.module_of(words[0]), words[0]), *words[1:]
    known = cli.subcommands(of_command)
    if known and rest and not rest[0].startswith("-"):
        if rest[0] not in known:
            return "" if rest[0] in _NO_COMMANDS else f"no such command: {rest[0]}"
        prog, of_command, rest = f"{prog} {rest[0]}", known[rest[0]], rest[1:]
    rest = [word for word in rest if word not in _OF_OTHERS]
    return misspelt(of_command, prog, [word.strip("[]") for word in rest])


@pytest.mark.parametrize(
    ("words", "wrong"),
    [
        ("convert x --out y --alll-videos", "--alll-videos: no such option"),
        ("plan rn x", "no such command: rn"),
        ("generat pick", "no such command: generat"),
        ("generate pik", "pik: no such task"),
    ],
)
def test_mistakes_are_found(words, wrong):
    assert mistake(words.split()).startswith(wrong)
