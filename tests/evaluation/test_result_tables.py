"""Tables of results, with numbers worked out by hand."""

import pytest
from made_up_results import outcome, write

from robocas_ms3.errors import EvaluationError
from robocas_ms3.evaluation.tables import comparison, markdown


@pytest.fixture
def result(tmp_path):
    """Of table: 2 of 4 succeeded, and 3 lifted; of heap, 1 of 2."""
    table = [outcome(0), outcome(1), outcome(2, came_to=5), outcome(3, came_to=0)]
    heap = [outcome(4, config="heap", p_vis=0.2), outcome(5, came_to=0, config="heap", p_vis=1.0)]
    return write(tmp_path / "a", [*table, *heap])


def row(text: str, first: str) -> list[str]:
    line = next(line for line in text.splitlines() if line.startswith(f"| {first} |"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_a_configuration_is_a_row(result):
    # 2 of 4: Clopper and Pearson 6.8 to 93.2; steps (70 + 70 + 800 + 800) / 4; RA 3 of 4; no obstacles
    expected = ["table", "4", "50 % (7 to 93)", "50 %", "50 %", "75 %", "75 %", "75 %", "", "435", "21.8"]
    assert row(markdown(result), "table") == expected


def test_failure_stages_are_counted(result):
    assert "| table | placed 1, reached_any 1 |" in markdown(result)


def test_bins_of_occlusion(result):
    # of one episode 2.5 or 97.5 %, rounded up
    assert row(markdown(result), "0.2 to 0.4") == ["0.2 to 0.4", "1", "100 % (3 to 100)"]
    assert row(markdown(result), "0.8 to 1") == ["0.8 to 1", "1", "0 % (0 to 98)"]
    assert row(markdown(result), "0 to 0.2") == ["0 to 0.2", "0", ""]


def test_without_occlusion_there_is_no_such_table(tmp_path):
    assert "p_vis" not in markdown(write(tmp_path / "a", [outcome(0)]))


def test_a_comparison_takes_the_episodes_that_both_have(tmp_path):
    one = write(tmp_path / "a", [outcome(number, came_to=0) for number in range(8)])
    other = write(tmp_path / "b", [outcome(number) for number in range(1, 9)], policy={"name": "better"})
    found = row(comparison(one, other), "table")
    assert found[:6] == ["table", "7", "0", "7", "0", "7"]
    assert found[6].startswith("+100.0 (")
    assert float(found[7]) == pytest.approx(2 * 0.5**7, rel=0.01)


def test_a_comparison_that_shows_nothing_says_so(tmp_path):
    one, other = (write(tmp_path / name, [outcome(0, came_to=came)]) for name, came in (("a", 0), ("b", 7)))
    assert "differ by less than 1 episodes can tell" in comparison(one, other)


def test_comparisons_of_different_protocols_or_of_nothing_are_refused(tmp_path):
    one = write(tmp_path / "a", [outcome(0)])
    with pytest.raises(EvaluationError, match="different protocols"):
        comparison(one, write(tmp_path / "b", [outcome(0)], protocol_hash="ef" * 32))
    with pytest.raises(EvaluationError, match="no episodes in common"):
        comparison(one, write(tmp_path / "c", [outcome(1)]))


def test_the_weld_is_named_and_compared_with_its_like_alone(tmp_path):
    without = write(tmp_path / "a", [outcome(0)])
    one, other = (write(tmp_path / name, [outcome(0)], weld=True) for name in "bc")
    assert markdown(one).startswith("# mine by made_up with upstream's weld\n\n**With upstream's weld: ")
    assert "weld" not in markdown(without)
    assert "1 episodes of made_up with upstream's weld that both have" in comparison(one, other)
    for pair in ((one, without), (without, one)):
        with pytest.raises(EvaluationError, match=r"/b: a result with upstream's weld can't be compared"):
            comparison(*pair)
