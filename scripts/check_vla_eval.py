"""Run episodes of the protocol `smoke` with vla-eval and with `robocas eval`, and compare; called by check_others.sh.

python check_vla_eval.py                             run all checks
python check_vla_eval.py serve PORT RECORDING LOG    serve the actions of RECORDING to vla-eval; log instructions to LOG
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from vla_eval.benchmarks.base import Benchmark
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.model_servers.serve import serve
from vla_eval.registry import resolve_import_string
from vla_eval.specs import (
    GRIPPER_CLOSE_NEG,
    IMAGE_RGB,
    LANGUAGE,
    POSITION_DELTA,
    ROTATION_AA,
    ROTATION_EULER,
    DimSpec,
    check_specs,
)

from robocas_ms3.evaluation import (
    EpisodeSpec,
    EvaluationSession,
    EvaluationSettings,
    Observations,
    Result,
    load_protocol,
    read_result,
)
from robocas_ms3.evaluation.policies.scripted import ScriptedPolicy
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.robots.quantities import GRIPPER_WIDTH, STATE, feature_columns

BENCHMARK = "robocas_ms3.evaluation.harness.vla_eval:RoboCAS"
TASKS, EPISODES_PER_TASK, CHUNK = ["pick", "select"], 2, 4
CAMERAS = {"gripper_camera": [64, 48], "base_camera": [32, 32]}
PARAMS = {"protocol": "smoke", "convention": "robocas", "reference": "tcp", "rate_hz": 5, "cameras": CAMERAS}
OPEN_01 = DimSpec("gripper", 1, "binary_open_01", (0, 1))
PORT = 18123


class RecordingPolicy(ScriptedPolicy):
    """Scripted policy that records its observations and actions by episode."""

    def __init__(self) -> None:
        super().__init__("robocas")
        cameras = {name: (width, height) for name, (width, height) in CAMERAS.items()}
        self.spec = dataclasses.replace(self.spec, cameras=cameras, language="text")
        self.recording: dict[int, list[dict[str, np.ndarray]]] = {}

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        """Plan the episode and start its recording."""
        super().reset(episodes)
        self.steps = self.recording[episodes[0].episode] = []

    def act(self, observations: Observations) -> np.ndarray:
        """Return actions (1, 7) and record the step."""
        actions = super().act(observations)
        images = {name: images[0] for name, images in observations.images.items()}
        parts = (observations.tcp_in_base[0, :3], observations.qpos[0, RobotDescription.arm_slice])
        state = np.concatenate([*parts, observations.robot[GRIPPER_WIDTH][0]])
        self.steps.append({"actions": actions[0], "state": state, **images})
        return actions


class ReplayServer(PredictModelServer):
    """Model server of vla-eval that replays recorded actions in chunks and compares the observations."""

    def __init__(self, recording: Path, log: Path) -> None:
        super().__init__(chunk_size=CHUNK)
        self.log, self.recording = log, np.load(recording)

    async def on_episode_start(self, config: dict, ctx: Any) -> None:
        """Read the task and number of the episode."""
        self.task = config["task"]
        await super().on_episode_start(config, ctx)

    def predict(self, obs: dict, ctx: Any) -> dict:
        """Compare the observation with the recorded observation; return the next actions (CHUNK, 7)."""
        name, number = self.task["name"], self.task["episode_idx"]
        if ctx.is_first:
            with self.log.open("a") as file:
                file.write(json.dumps([name, number, obs["task_description"]]) + "\n")
        recorded = {key: self.recording[f"{name} {number} {key}"] for key in ("actions", "state", *CAMERAS)}
        # without the quaternion, whose sign is arbitrary, and the base, which policies do not observe
        columns = [feature_columns(STATE)[key] for key in ("ee_pos", "robot_joints", GRIPPER_WIDTH)]
        state = np.concatenate([obs["state"][part] for part in columns])
        assert np.allclose(state, recorded["state"][ctx.step], atol=1e-4)
        assert list(obs["images"]) == list(CAMERAS)
        for camera, image in obs["images"].items():
            assert image.shape == recorded[camera][ctx.step].shape
            assert np.abs(image - recorded[camera][ctx.step].astype(float)).mean() < 0.5  # GPUs may round differently
        return {"actions": recorded["actions"][ctx.step : ctx.step + CHUNK]}

    def get_action_spec(self) -> dict:
        """Return the format of the actions."""
        return {"position": POSITION_DELTA, "rotation": ROTATION_EULER, "gripper": OPEN_01}

    def get_observation_spec(self) -> dict:
        """Return the format of the observations."""
        return {"image": IMAGE_RGB, "language": LANGUAGE}


def main() -> None:
    """Run all checks; a difference raises an error."""
    say(f"versions: { ({name: version(name) for name in ('vla-eval', 'robocas-ms3', 'numpy', 'websockets')}) }")
    check_interface()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recording, log = folder / "recording.npz", folder / "instructions.jsonl"
        ours = record_episodes(folder / "ours", recording)
        with open_server(recording, log):
            run(folder / "theirs", tasks=TASKS, episodes_per_task=EPISODES_PER_TASK)
            instructions = [json.loads(line) for line in log.read_text().splitlines()]
            run(folder / "cut", tasks=["pick"], episodes_per_task=EPISODES_PER_TASK + 1, max_steps=3)
        compare(folder / "theirs", ours, instructions)
        check_errors(folder / "cut")
    say("vla-eval reports the same outcomes as robocas eval")


def record_episodes(out: Path, recording: Path) -> Result:
    """Evaluate the scripted policy, save its observations and actions, and return the result."""
    policy, protocol, arrays = RecordingPolicy(), load_protocol("smoke"), {}
    settings = EvaluationSettings(tuple(TASKS), "scripted-ee-delta", "smoke", out, envs=1, backend="processes")
    for outcome in EvaluationSession(policy, settings).run():
        steps, episode = policy.recording[outcome.episode], protocol.episodes[outcome.episode]
        number = sum(one.config == episode.config for one in protocol.episodes[: episode.episode])
        for key in steps[0]:
            arrays[f"{episode.config} {number} {key}"] = np.stack([step[key] for step in steps])
    policy.close()
    np.savez(recording, **arrays)
    return read_result(out)


def check_interface() -> None:
    """Check that the benchmark class has the interface of vla-eval, and that mismatched conventions give warnings."""
    benchmark = resolve_import_string(BENCHMARK)
    assert issubclass(benchmark, Benchmark)
    methods = {name: value for name, value in vars(Benchmark).items() if inspect.isfunction(value)}
    for name, method in methods.items():
        implementation = getattr(benchmark, name)
        assert list(inspect.signature(implementation).parameters) == list(inspect.signature(method).parameters), name
        assert inspect.iscoroutinefunction(implementation) == inspect.iscoroutinefunction(method), name
    warnings = {}
    for convention in ("delta_axis_angle", "robocas", "joint_positions"):
        instance = benchmark(convention=convention)
        server = {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": GRIPPER_CLOSE_NEG}
        specs = (instance.get_action_spec(), {"language": LANGUAGE}, instance.get_observation_spec())
        warnings[convention] = check_specs(server, *specs)
    assert warnings["delta_axis_angle"] == []
    assert [text.split(":")[0] for text in sorted(warnings["robocas"])] == ["action [gripper]", "action [rotation]"]
    assert any("joints" in text for text in warnings["joint_positions"])
    say(f"interface: {len(methods)} methods; a mismatch gives the warning {sorted(warnings['robocas'])[1]!r}")


@contextmanager
def open_server(*files: Path) -> Iterator[None]:
    """Start the model server in another process, and stop it."""
    command = [sys.executable, "-W", "ignore", __file__, "serve", str(PORT), *map(str, files)]
    process = subprocess.Popen(command)
    try:
        for _ in range(120):
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{PORT}/health", timeout=1)
                break
            except OSError:
                assert process.poll() is None, "the model server ended"
                time.sleep(0.5)
        yield
    finally:
        process.kill()
        process.wait()


def run(out: Path, **entry: Any) -> None:
    """Run the benchmark with `vla-eval run`."""
    config = {
        "server": {"url": f"ws://127.0.0.1:{PORT}"},
        "benchmarks": [{"benchmark": BENCHMARK, "params": PARAMS, **entry}],
    }
    path = out.with_suffix(".yaml")
    path.write_text(yaml.safe_dump(config, sort_keys=False))  # keep the order of the cameras
    tool = [sys.executable, "-W", "ignore", str(Path(sys.executable).parent / "vla-eval")]
    subprocess.run([*tool, "run", "--config", str(path), "--output-dir", str(out)], check=True)


def compare(theirs: Path, ours: Result, instructions: list) -> None:
    """Compare the outcome and the instruction of every episode."""
    protocol = load_protocol("smoke")
    aggregate = json.loads((theirs / "RoboCAS_aggregate.json").read_text())
    assert aggregate["num_errors"] == 0
    found = {}
    for task in aggregate["tasks"]:
        for episode in task["episodes"]:
            metrics = episode["metrics"]
            found[metrics["episode"]] = metrics
            assert episode["steps"] == metrics["steps"]
            assert [task["task"], episode["episode_id"], metrics["instruction"]] in instructions
            assert metrics["instruction"] == protocol.episodes[metrics["episode"]].instruction
            assert (metrics["protocol"], metrics["protocol_hash"]) == ("smoke", protocol.hash)
    assert found.keys() == ours.outcomes.keys()
    assert len(instructions) == len(found) == EPISODES_PER_TASK * len(TASKS)
    for number, outcome in ours.outcomes.items():
        for name, value in outcome.reproducible_values().items():
            assert found[number][name] == value, (number, name, found[number][name], value)
        measures = ", ".join(f"{name} {value:g}" for name, value in outcome.measures.items())
        say(f"  episode {number}: {outcome.steps} steps, {outcome.failure_stage or 'success'}; {measures}")
    assert any(outcome.success for outcome in ours.outcomes.values())
    means = {name: value for name, value in aggregate.items() if name.startswith("mean_")}
    say(f"outcomes are equal; means of vla-eval: {means}")


def check_errors(folder: Path) -> None:
    """Check that other step limits and too many episodes are errors."""
    aggregate = json.loads((folder / "RoboCAS_aggregate.json").read_text())
    episodes = aggregate["tasks"][0]["episodes"]
    assert aggregate["num_errors"] == EPISODES_PER_TASK + 1
    assert [episode["failure_reason"] for episode in episodes] == ["env_step"] * EPISODES_PER_TASK + ["env_start"]
    assert "max_steps" in episodes[0]["failure_detail"]
    assert "the protocol has fewer episodes of this task" in episodes[-1]["failure_detail"]
    say(f"refused: {episodes[0]['failure_detail'].splitlines()[-1]}")


def say(text: str) -> None:
    """Print a line without buffering."""
    print(text, flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["serve"]:
        serve(ReplayServer(*map(Path, sys.argv[3:])), "127.0.0.1", int(sys.argv[2]))
    else:
        main()
