"""End-to-end tests of `generate --record-candidates` with the builtin pack."""

from dataclasses import replace

import numpy as np
import pytest

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.datasets.checks.candidates import validate_candidates
from robocas_ms3.demos.candidates.candidates_file import FILE_NAME, CandidateFile
from robocas_ms3.demos.generation import generate
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.demos.settings import EpisodeSettings, GenerateSettings

pytestmark = pytest.mark.slow
COUNT, SEED = 5, 3
PLAIN = EpisodeSettings("search", "search_table_small_heap")
RECORDED = replace(PLAIN, record_candidates=True, candidates=COUNT, candidate_depth=1)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Return the output folders of a run with candidates and of a run without them."""
    out = tmp_path_factory.mktemp("demos")
    for name, settings in (("recorded", RECORDED), ("plain", PLAIN)):
        generate(GenerateSettings(settings, out / name, episodes=1, seed=SEED, jobs=0))
    return out / "recorded", out / "plain"


@pytest.fixture(scope="module")
def file(folders):
    return CandidateFile(folders[0] / FILE_NAME)


def in_episode(file):
    return [file.decision(row) for row in np.flatnonzero(file.decisions["in_episode"])]


def test_demonstrations_do_not_change(folders):
    recorded, plain = ((folder / "trajectory.h5").read_bytes() for folder in folders)
    assert recorded == plain
    assert not (folders[1] / FILE_NAME).exists()
    assert not list(folders[0].glob("episodes/*"))


def test_file_has_no_violation(folders):
    assert validate_candidates(folders[0] / FILE_NAME).violations == []


def test_every_decision_has_random_candidates(file):
    assert set(file.decisions["seed"]) == {SEED}
    assert {decision.values["kind"] for decision in in_episode(file)} >= {"grasp", "release"}
    for row in range(len(file)):
        sources = file.decision(row).candidates["source"]
        assert len(sources) == COUNT
        assert set(sources) & {"random", "near_miss"}


def test_episode_continues_with_one_scripted_candidate(file):
    for decision in in_episode(file):
        chosen = decision.candidates["chosen"]
        assert chosen.sum() == 1
        assert decision.candidates["source"][chosen] == ["expert"]
        assert decision.candidates["success"][chosen] == [True]
    left = [decision.values["moves_left"] for decision in in_episode(file)]
    kinds = [decision.values["kind"] for decision in in_episode(file)]
    assert left == [kinds[number + 1 :].count("move") for number in range(len(kinds))]


def test_outcome_of_the_chosen_candidate_is_the_next_state_of_the_episode(file):
    decisions = in_episode(file)
    grasp, release = (next(one for one in decisions if one.values["kind"] == kind) for kind in ("grasp", "release"))
    target = grasp.values["target_slot"]
    chosen = int(np.flatnonzero(grasp.candidates["chosen"])[0])
    assert grasp.candidates["primitive"][chosen] == "grasp"
    assert grasp.candidates["slot"][chosen] == target
    assert grasp.candidates["held"][chosen]
    assert release.values["held_slot"] == target
    after, next_before = grasp.candidates["object_after_in_base"][chosen], release.values["object_in_base"]
    np.testing.assert_allclose(after[target, :3], next_before[target, :3], atol=0.02)
    dropped = np.flatnonzero(release.candidates["chosen"])[0]
    assert release.candidates["in_basket"][dropped, target]


def test_infeasible_candidates_leave_the_scene_unchanged(file):
    moved = np.nanmax(file.candidates["displacement"], axis=1)
    untried = ~file.candidates["feasible"] & (file.candidates["seconds"] == 0)
    assert untried.any()
    assert not file.candidates["success"][untried].any()
    assert (moved[untried] == 0).all()
    assert np.isfinite(file.candidates["start_in_base"]).all()


def test_parameters_do_not_tell_whether_a_candidate_was_feasible(file):
    is_push = file.candidates["primitive"] == "push"
    assert (np.isfinite(file.candidates["end_in_base"]).all(axis=1) == is_push).all()


def test_candidates_need_forked_processes():
    with pytest.raises(RobocasError) as caught:
        EpisodeGenerator(RECORDED, fork=False)
    assert caught.value.where == "--record-candidates"
