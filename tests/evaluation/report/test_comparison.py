"""Paired comparisons of results."""

import shutil

import pytest
from synthetic_results import outcome, write

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.protocols.bundled_protocols import bundled_protocols
from robocas_ms3.evaluation.protocols.protocol import EPISODES, load_protocol
from robocas_ms3.evaluation.report.comparison import compare_results, compare_splits
from robocas_ms3.evaluation.report.tables import render_markdown
from robocas_ms3.evaluation.statistics import adjust_p_values, mcnemar_p_value


def rows(said: str) -> list[list[str]]:
    lines = [line for line in said.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[1:]]


def test_comparison_uses_the_common_episodes(tmp_path):
    one = write(tmp_path / "a", [outcome(number, came_to=0) for number in range(8)])
    policy = {"name": "better", "spec": {"simulation_state": True}}
    other = write(tmp_path / "b", [outcome(number) for number in range(1, 9)], policy=policy)
    said = compare_results([one, other])
    assert said.startswith(
        f"A: mine ({one.folder}), B: better ({other.folder}); 7 episodes of made_up in both results."
    )
    ((config, pair, tracks, *counts, change, p, adjusted),) = rows(said)
    assert (config, pair, counts) == ("table", "A, B", ["7", "0", "7", "0", "7"])
    assert tracks == "end-to-end, privileged" and "different tracks" in said
    assert change.startswith("+100.0 (")
    assert float(p) == float(adjusted) == pytest.approx(2 * 0.5**7, rel=0.01)


def test_comparison_names_the_task_that_is_evaluated_in_other_episodes(tmp_path):
    one = write(tmp_path / "a", [outcome(0)])
    other = write(tmp_path / "b", [outcome(0, task="select")], played_as={"select": "pick"})
    expected = f"A: mine, pick ({one.folder}), B: mine, select in the episodes of pick ({other.folder}); "
    assert compare_results([one, other]).startswith(expected)


def test_p_values_of_several_comparisons_are_adjusted(tmp_path):
    """Three results over two configurations; the rows over all configurations are a separate family."""

    def result(name: str, good: int):
        outcomes = [outcome(n, 7 if n % 20 < good else 0, config="left" if n < 20 else "right") for n in range(40)]
        return write(tmp_path / name, outcomes, policy={"name": name})

    found = rows(compare_results([result("bad", 2), result("better", 9), result("best", 18)]))
    assert [row[:2] for row in found] == [
        [where, pair] for where in ("left", "right", "all") for pair in ("A, B", "A, C", "B, C")
    ]
    of_one = [mcnemar_p_value(7, 0), mcnemar_p_value(16, 0), mcnemar_p_value(9, 0)]
    of_all = [mcnemar_p_value(14, 0), mcnemar_p_value(32, 0), mcnemar_p_value(18, 0)]
    adjusted = [*adjust_p_values([*of_one, *of_one]), *adjust_p_values(of_all)]
    for row, p, by_holm in zip(found, [*of_one, *of_one, *of_all], adjusted, strict=True):
        assert float(row[-2]) == pytest.approx(p, rel=0.01)
        assert float(row[-1]) == pytest.approx(by_holm, rel=0.01)


def test_a_difference_that_is_significant_alone_but_not_among_two_claims_gets_a_warning(tmp_path):
    """Six scenes that only one run solves: p = 1/32 is significant alone, but not after Holm's correction for two."""

    def result(name: str, came_to: int):
        return write(
            tmp_path / name, [outcome(n, came_to if n < 6 else 7, config="ab"[n % 2 * (n > 5)]) for n in range(8)]
        )

    said = compare_results([result("one", 0), result("two", 7)])
    (a, b, both) = rows(said)
    assert (a[0], a[-2], a[-1]) == ("a", "0.0312", "0.0625")
    assert (b[0], both[0], both[-1]) == ("b", "all", "0.0312")
    assert "- a: " in said
    assert "- all: " not in said


def test_scenes_that_occur_several_times_are_not_pooled_and_other_backends_are_named(tmp_path):
    outcomes = [outcome(n, seed=n % 4, config="ab"[n // 4], split="ab"[n // 4]) for n in range(8)]
    said = compare_results([write(tmp_path / name, outcomes, backend=name) for name in ("gpu", "processes")])
    assert [row[0] for row in rows(said)] == ["a", "b"]
    assert "**Measured with different backend.**" in said


def test_results_that_cannot_be_compared_are_refused(tmp_path):
    one, other = write(tmp_path / "a", [outcome(0)]), write(tmp_path / "b", [outcome(0)], protocol_hash="ef" * 32)
    with pytest.raises(EvaluationError, match="different protocols"):
        compare_results([one, one, other])
    with pytest.raises(EvaluationError, match="no common episodes"):
        compare_results([one, write(tmp_path / "c", [outcome(1)])])
    welded = write(tmp_path / "d", [outcome(0)], weld=True)
    assert "1 episode of made_up with RoboCAS-v0's weld in both results" in compare_results([welded, welded])
    for pair in ([one, welded], [welded, one]):
        with pytest.raises(EvaluationError, match=r"/d: cannot compare results with and without RoboCAS-v0's weld"):
            compare_results(pair)


def test_true_camera_calibration_is_named(tmp_path):
    spec = {"rate_hz": None, "calibration": "true"}
    policy = {"name": "mine", "class": "mine:Policy", "spec": spec}
    results = [write(tmp_path / "a", [outcome(0)]), write(tmp_path / "b", [outcome(0)], policy=policy)]
    table = compare_results(results)
    assert "A: mine (" in table and "B: mine with true camera calibration (" in table
    assert render_markdown(results[1]).startswith("# mine with true camera calibration on made_up")
    assert "true poses of the cameras" in render_markdown(results[1])
    assert "true poses" not in render_markdown(results[0])


def test_action_noise_is_named_and_never_compared_with_other_noise(tmp_path):
    plain, weak, strong = (
        write(tmp_path / name, [outcome(0)], **noise)
        for name, noise in (("a", {}), ("b", {"action_noise": [0.5, 0.2]}), ("c", {"action_noise": [1.0, 0.2]}))
    )
    assert "made_up with action noise of 0.5 mm and 0.2 degrees in both results" in compare_results([weak, weak])
    for pair in ([plain, weak], [weak, plain], [weak, strong]):
        with pytest.raises(EvaluationError, match="different action noise"):
            compare_results(pair)


def of_suite(folder, name, succeeds):
    """A result of a protocol; ``succeeds`` chooses the outcome of each episode."""
    protocol = load_protocol(name)
    outcomes = [
        outcome(
            one.episode, 7 if succeeds(one) else 0, task=one.task, config=one.config, seed=one.seed, split=one.split
        )
        for one in protocol.episodes
    ]
    return write(folder, outcomes, protocol_hash=protocol.hash), protocol


def test_splits_with_the_same_scenes_are_compared(tmp_path):
    found = rows(
        compare_splits(*of_suite(tmp_path / "a", "instructions-v1", lambda one: one.split in {"seen", "paraphrase"}))
    )
    assert [row[:2] for row in found] == [
        [task, f"seen, {split}"] for task in ("pick", "select", "search") for split in ("paraphrase", "wrong", "empty")
    ]
    assert [row[4:6] for row in found[:3]] == [["50", "50"], ["50", "0"], ["50", "0"]]


def test_a_split_may_have_several_configurations(tmp_path):
    """Configurations with the same scenes are compared."""
    folder = shutil.copytree(bundled_protocols()["cameras-v1"], tmp_path / "mine")
    lines = (folder / EPISODES).read_text()
    (folder / EPISODES).write_text(lines.replace('"task":"select"', '"task":"pick"'))
    protocol = load_protocol(folder)
    outcomes = []
    for one in protocol.episodes:
        same = {name: getattr(one, name) for name in ("task", "config", "seed", "split")}
        succeeds = one.split == "seen" or one.config == "select_table_orderly-far"
        outcomes.append(outcome(one.episode, 7 if succeeds else 0, **same))
    found = rows(compare_splits(write(tmp_path / "r", outcomes, protocol_hash=protocol.hash), protocol))
    assert [row[1:6] for row in found] == [
        [f"seen, {split}", "end-to-end", "50", "50", second]
        for split, second in (("near", "0"), ("far", "0"), ("near", "0"), ("far", "50"))
    ]


def test_splits_with_different_scenes_are_refused(tmp_path):
    result, _ = of_suite(tmp_path / "b", "instructions-v1", lambda one: True)
    with pytest.raises(EvaluationError, match="other files of the protocol"):
        compare_splits(result, load_protocol("cameras-v1"))
    with pytest.raises(EvaluationError, match="no two splits of the result have the same scenes"):
        compare_splits(*of_suite(tmp_path / "a", "objects-v1", lambda one: True))
