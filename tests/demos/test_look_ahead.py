"""Scripted policy with limited look-ahead: one attempt, and a fixed number of simulated candidates per decision."""

from __future__ import annotations

import pytest

from robocas_ms3.demos import branches
from robocas_ms3.demos.generator import EpisodeGenerator, EpisodeLimits
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.evaluation.policies import LOOK_AHEADS, make_policy
from robocas_ms3.planning.decisions import SearchLimits

SEED = 3


@pytest.fixture(scope="module")
def generator():
    generator = EpisodeGenerator(EpisodeSettings("search", "search_table_small_heap", check_rate=0))
    yield generator
    generator.close()


def generate(generator, folder, look_ahead):
    return generator.generate(SEED, folder, "episode", None, EpisodeLimits(generator.horizon, 1, 0, look_ahead))


def test_without_look_ahead_nothing_is_simulated_in_advance(generator, tmp_path, monkeypatch):
    monkeypatch.setattr(branches, "fork", lambda: pytest.fail("forked"))
    result = generate(generator, tmp_path, 0)
    assert result.attempts == 1
    assert (tmp_path / "episode.h5").exists() == result.success


def test_each_decision_compares_as_many_candidates(generator, tmp_path, monkeypatch):
    seen = []
    choose = branches.ForkedDecisions.choose

    def record(self, candidates, run_candidate, limits):
        seen.append(limits)
        return choose(self, candidates, run_candidate, limits)

    monkeypatch.setattr(branches.ForkedDecisions, "choose", record)
    assert generate(generator, tmp_path, 2).attempts == 1
    assert seen, "the heap needs a decision"
    assert set(seen) == {SearchLimits(2, 1)}


@pytest.mark.parametrize("count", LOOK_AHEADS)
def test_variants_are_privileged_policies(count):
    assert make_policy(f"scripted-lookahead-{count}").spec.track == "privileged"
