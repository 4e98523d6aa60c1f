import re
from pathlib import Path

import robocas_ms3
from robocas_ms3.words import called, count_of

# nouns that messages count
NOUNS = "episode|step|seed|layout|violation|asset|picture|problem|file|object"


def test_one_is_no_plural():
    assert [count_of(n, "episode") for n in (0, 1, 2)] == ["0 episodes", "1 episode", "2 episodes"]


def test_what_commands_say_counts_by_it():
    """No `{n} episodes` in what a command prints, which would say "1 episodes"."""
    for path in sorted((Path(robocas_ms3.__file__).parent / "cli").glob("*.py")):
        found = re.findall(rf"(?:say|print)\(.*?(?<!of )\{{[^{{}}:]+\}} (?:{NOUNS})s\b", path.read_text())
        assert not found, f"{path.name}: {found}"


def test_an_object_is_called_by_its_name_and_by_an_id_that_says_more():
    assert called("large_elephant", "grey toy elephant") == "grey toy elephant (large elephant)"
    assert called("jam_jar", "jam jar") == called("jam_jar") == called("", "jam jar") == "jam jar"
    assert called("") == ""
