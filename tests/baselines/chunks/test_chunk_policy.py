"""How chunks become motions: relative to where the TCP is, and agreed on by the last predictions."""

import numpy as np
import pytest

from robocas_ms3.baselines.chunks.policy import ChunkPolicy
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec

STAY = [0, 0, 0, 1, 0, 0, 0, 1, 0, 1.0]


def seen(tcps, envs=(0,), width=0.0):
    count = len(envs)
    return Observations(
        envs=np.array(envs),
        instructions=[""] * count,
        embeddings=None,
        images={},
        depths={},
        qpos=np.zeros((count, 12), np.float32),
        tcp_in_base=np.array(tcps, np.float32),
        gripper_width=np.full((count, 1), width, np.float32),
        state=None,
    )


def start(env):
    return EpisodeSpec(env, 0, "pick", "", "", "builtin", 0, "")


def policy(chunks, fade=0.0):
    said = (chunk for asked in chunks for chunk in asked)
    made = ChunkPolicy(PolicySpec(), lambda observations, place: np.array(next(said), float), 1, fade, {})
    made.reset([start(0), start(1)])
    return made


def row(x=0.0, opened=1.0):
    return [x, *STAY[1:9], opened]


HERE = [0.5, 0, 0.3, 1, 0, 0, 0]


def test_a_first_chunk_is_followed():
    acting = policy([[[row(0.1), row(0.2)]]])
    assert acting.act(seen([HERE])) == pytest.approx(np.array([[0.1, 0, 0, 0, 0, 0, 1]]), abs=1e-6)


def test_older_predictions_are_of_the_same_step_and_frame():
    """Told 0.1 then 0.2, it stays where it was; then told 0.4: the mean of 0.2, what was said before, and 0.4."""
    acting = policy([[[row(0.1), row(0.2)]], [[row(0.4), row(0.5)]]])
    acting.act(seen([HERE]))
    assert acting.act(seen([HERE]))[0, 0] == pytest.approx(0.3)


def test_a_motion_makes_up_for_what_the_last_one_missed():
    acting = policy([[[row(0.1), row(0.2)]], [[row(0.1), row(0.2)]]])
    acting.act(seen([HERE]))
    late = [0.56, *HERE[1:]]  # 0.04 short of where it was to be: before 0.7 was wanted now, and now 0.66
    assert acting.act(seen([late]))[0, 0] == pytest.approx((0.7 + 0.66) / 2 - 0.56)


def test_newer_predictions_weigh_more():
    acting = policy([[[row(), row(0.0, 0.0)]], [[row(0.4, 1.0), row()]]], fade=np.log(3))  # 3 to 1
    acting.act(seen([HERE]))
    action = acting.act(seen([HERE]))[0]
    assert action[0] == pytest.approx(0.3)
    assert action[6] == 1.0


def test_a_chunk_is_followed_before_the_next():
    """For two of three steps; then the mean of what it said of the third one, and what the next says of it."""
    asked = iter([[[row(0.1), row(0.2), row(0.3)]], [[row(0.5), row(), row()]]])
    acting = ChunkPolicy(PolicySpec(), lambda observations, place: np.array(next(asked), float)[place], 2, 0.0, {})
    acting.reset([start(0)])
    assert [acting.act(seen([HERE]))[0, 0] for _ in range(3)] == pytest.approx([0.1, 0.2, 0.4])


def test_envs_are_asked_when_they_are_due():
    asked = []

    def predict(observations, place):
        asked.append(int(observations.envs[place]))
        return np.array([row(0.1), row(0.2)])

    acting = ChunkPolicy(PolicySpec(), predict, 2, 0.0, {})
    acting.reset([start(0), start(1)])
    moved = [acting.act(seen([HERE] * 2, (0, 1)))[:, 0].tolist() for _ in range(2)]
    acting.reset([start(1)])
    moved.append(acting.act(seen([HERE] * 2, (0, 1)))[:, 0].tolist())
    moved.append(acting.act(seen([HERE] * 2, (0, 1)))[:, 0].tolist())
    assert np.array(moved) == pytest.approx(np.array([[0.1, 0.1], [0.2, 0.2], [0.1, 0.1], [0.2, 0.2]]))
    assert asked == [0, 1, 0, 1]


def test_a_reset_forgets_one_env():
    acting = policy([[[row(0.2), row(0.2)]] * 2, [[row(0.4), row()]] * 2])
    acting.act(seen([HERE] * 2, (0, 1)))
    acting.reset([start(1)])
    moved = acting.act(seen([HERE] * 2, (0, 1)))[:, 0]
    assert moved.tolist() == pytest.approx([0.3, 0.4])


CLOSED = [[row(0.0, 0.0), row(0.0, 0.0)]]


@pytest.mark.parametrize(
    ("reopen", "width", "moved", "opened"),
    [
        (0.02, 0.001, 0.015, 1.0),  # an empty fist that waits
        (0.0, 0.001, 0.0, 0.0),  # not asked for
        (0.02, 0.03, 0.0, 0.0),  # it holds something
        (0.02, 0.001, 0.025, 0.0),  # it pushes
    ],
)
def test_an_empty_fist_that_waits_opens(reopen, width, moved, opened):
    """At the look after the one that closed it, which was a step before; where to go is as predicted."""
    asked = iter(CLOSED * 2)
    acting = ChunkPolicy(PolicySpec(), lambda observations, place: np.array(next(asked)), 1, 2.0, {}, reopen)
    acting.reset([start(0)])
    assert acting.act(seen([HERE], width=width))[0, 6] == 0.0
    there = [HERE[0] + moved, *HERE[1:]]
    assert acting.act(seen([there], width=width))[0, 6] == opened


def test_older_plans_do_not_keep_it_closed():
    """All predictions weigh alike, and five of six want it closed."""
    asked = iter([[row(0.0, 0.0)] * 8] * 6)
    acting = ChunkPolicy(PolicySpec(), lambda observations, place: np.array(next(asked)), 1, 0.0, {}, 0.02)
    acting.reset([start(0)])
    away = [[HERE[0] + 0.1 * place, *HERE[1:]] for place in range(5)]  # it moves, then stays
    assert [acting.act(seen([here]))[0, 6] for here in [*away, away[-1]]] == [0, 0, 0, 0, 0, 1]


def test_where_another_episode_ended_is_forgotten():
    asked = iter(CLOSED * 2)
    acting = ChunkPolicy(PolicySpec(), lambda observations, place: np.array(next(asked)), 1, 2.0, {}, 0.02)
    for _ in range(2):
        acting.reset([start(0)])
        assert acting.act(seen([HERE]))[0, 6] == 0.0


def test_motions_are_in_the_tcps_frame():
    turned = [0.5, 0, 0.3, np.sqrt(0.5), 0, 0, np.sqrt(0.5)]  # a quarter about z
    quarter = [0.1, 0, 0, 0, 1, 0, -1, 0, 0, 0.2]  # on by 0.1 along its x, and turned by a quarter about its z
    action = policy([[[quarter]]]).act(seen([turned]))[0]
    assert action == pytest.approx([0.1, 0, 0, 0, 0, np.pi / 2, 0], abs=1e-6)
