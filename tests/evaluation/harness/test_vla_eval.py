"""The benchmark, called like vla-eval's runners call it; scripts/check_others.sh runs vla-eval itself."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import numpy as np
import pytest

pytest.importorskip("websockets")
pytest.importorskip("msgpack")

from robocas_ms3.core.errors import EvaluationError, WireError
from robocas_ms3.evaluation.harness.vla_eval import RoboCAS
from robocas_ms3.evaluation.protocols.protocol import load_protocol

ACT = {"actions": np.array([1, 0, 0, 0, 0, 0, 1], np.float32)}


class Recorder:
    """Recorder that keeps images."""

    def __init__(self) -> None:
        self.frames: list[Any] = []

    def record_video(self, frame: Any) -> None:
        self.frames.append(frame)


@pytest.fixture
def benchmark(made):
    benchmark = RoboCAS(cameras={"base_camera": [6, 4]}, rate_hz=5)
    yield benchmark
    benchmark.cleanup()


async def play(benchmark, task, *, max_steps=None, recorder=None) -> dict[str, Any]:
    """Run an episode like vla-eval's runner of mode sync."""
    await benchmark.start_episode(task, recorder=recorder)
    seen = [await benchmark.get_observation()]
    for _ in range(max_steps or benchmark.get_metadata()["max_steps"]):
        await benchmark.apply_action(ACT)
        if await benchmark.is_done():
            break
        seen.append(await benchmark.get_observation())
    assert await benchmark.get_time() >= 0
    return {"seen": seen, "metrics": await benchmark.get_result()}


def test_tasks_are_configurations_with_the_episodes_of_the_protocol(benchmark, made):
    tasks = benchmark.get_tasks()
    assert [(task["name"], task["suite"], task["episodes"]) for task in tasks] == [
        ("pick_table_scattered", "pick", 2),
        ("select_table_orderly", "select", 2),
        ("search_table_small_heap", "search", 2),
        ("open_pick_drawer", "open_pick", 2),
    ]
    assert benchmark.get_metadata() == {"max_steps": 600}
    listed = load_protocol("smoke").episodes
    for number, task in ((number, task) for task in tasks for number in range(2)):
        played = asyncio.run(play(benchmark, {**task, "episode_idx": number}))
        metrics = played["metrics"]
        episode = listed[metrics["episode"]]
        assert (episode.config, metrics["seed"]) == (task["name"], made[-1].seeds[-1])
        assert {one["task_description"] for one in played["seen"]} == {episode.instruction}
        assert metrics["instruction"] == episode.instruction
        assert len(played["seen"]) == metrics["steps"] == 5
    assert [env.seeds for env in made] == [[110000, 110001]] * 4


def test_observations_and_result_of_an_episode(benchmark):
    recorder = Recorder()
    task = {**benchmark.get_tasks()[0], "episode_idx": 0}
    played = asyncio.run(play(benchmark, task, recorder=recorder))
    seen, metrics = played["seen"], played["metrics"]
    assert [one["images"]["base_camera"].max() for one in seen] == [1, 2, 3, 4, 5]
    assert seen[0]["images"]["base_camera"].shape == (4, 6, 3)
    assert seen[0]["intrinsics"]["base_camera"].tolist() == [[2, 0, 3], [0, 2, 2], [0, 0, 1]]
    assert seen[0]["camera_in_base"]["base_camera"].shape == (4, 4)
    state = seen[0]["state"]
    assert state.dtype == np.float32
    np.testing.assert_allclose(state[7:14], [13, 14, 15, 16, 17, 18, 19])  # arm joints 3 to 9
    assert state[14] == 41  # the fingers, 20 and 21
    np.testing.assert_allclose(state[15:], [0, 0, 0], atol=1e-5)  # base in the world, not its joints 10, 11, 12
    assert metrics["success"] is metrics["success_at_end"] is metrics["reached_any"] is True
    assert metrics["success_v0"] is metrics["fail"] is False
    assert (metrics["failure_stage"], metrics["seconds"], metrics["path_length"]) == ("", 1.0, 5.0)
    assert metrics["flags"]["reached_any"] == 2
    assert metrics["protocol_hash"] == load_protocol("smoke").hash
    assert set(metrics["versions"]) >= {"sapien", "numpy"}
    assert json.loads(json.dumps(metrics)) == metrics
    averaged = {name for name in benchmark.get_metric_keys() if name in metrics}
    assert averaged >= {"success", "success_at_end", "success_v0", "reached_any", "seconds", "contact_impulse"}
    assert all(isinstance(metrics[name], bool | int | float) for name in averaged)
    assert [frame is None or int(frame.max()) for frame in recorder.frames] == [1, 2, 3, 4, 5, True]


def test_shortened_or_missing_episodes_and_mode_live_are_refused(benchmark):
    task = {**benchmark.get_tasks()[0], "episode_idx": 0}
    with pytest.raises(EvaluationError, match="Remove max_steps"):
        asyncio.run(play(benchmark, task, max_steps=4))
    assert asyncio.run(play(benchmark, task, max_steps=5))["metrics"]["success"]
    with pytest.raises(EvaluationError, match="expected episodes_per_task of at most 2, found 3"):
        asyncio.run(play(benchmark, {**task, "episode_idx": 2}))
    with pytest.raises(NotImplementedError, match="Set mode: sync"):
        benchmark.get_hold_action(None)


@pytest.mark.parametrize("actions", [None, np.zeros(6), [float("nan")] * 7, [1e9] * 7])
def test_invalid_action_ends_only_its_episode(benchmark, actions, monkeypatch):
    task = {**benchmark.get_tasks()[0], "episode_idx": 0}
    with monkeypatch.context() as patched:
        patched.setitem(ACT, "actions", actions)
        with pytest.raises(WireError):
            asyncio.run(play(benchmark, task))
    assert asyncio.run(play(benchmark, task))["metrics"]["steps"] == 5


@pytest.mark.parametrize("params", [{"protocol": "smok"}, {"convention": "euler"}, {"cameras": {"wrist": [4, 4]}}])
def test_invalid_parameters_are_refused(params):
    with pytest.raises(EvaluationError):
        RoboCAS(**params)
