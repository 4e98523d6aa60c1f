"""Plays episodes of the protocol smoke with vla-eval itself, and with `robocas eval`; run by check_others.sh.

python check_vla_eval.py                        check all
python check_vla_eval.py serve PORT KEPT LOG    the model server of it: does what KEPT has, keeps what it hears in LOG
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
    load_protocol,
    results,
)
from robocas_ms3.evaluation.policies.scripted import ScriptedPolicy
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.robots.quantities import GRIPPER_WIDTH, STATE, columns_of

OURS = "robocas_ms3.evaluation.harness.vla_eval:RoboCAS"
TASKS, EACH, CHUNK = ["pick", "select"], 2, 4
CAMERAS = {"gripper_camera": [64, 48], "base_camera": [32, 32]}
PARAMS = {"protocol": "smoke", "convention": "robocas", "reference": "tcp", "rate_hz": 5, "cameras": CAMERAS}
OPEN_01 = DimSpec("gripper", 1, "binary_open_01", (0, 1))
PORT = 18123


class Remembering(ScriptedPolicy):
    """The demonstrator's motions; keeps what it saw and did."""

    def __init__(self) -> None:
        super().__init__("robocas")
        cameras = {name: (width, height) for name, (width, height) in CAMERAS.items()}
        self.spec = dataclasses.replace(self.spec, cameras=cameras, language="text")
        self.kept: dict[int, list[dict[str, np.ndarray]]] = {}

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        """Plan the episode."""
        super().reset(episodes)
        self.now = self.kept[episodes[0].episode] = []

    def act(self, observations: Observations) -> np.ndarray:
        """(1, 7)."""
        actions = super().act(observations)
        images = {name: images[0] for name, images in observations.images.items()}
        parts = (observations.tcp_in_base[0, :3], observations.qpos[0, RobotDescription.arm_slice])
        state = np.concatenate([*parts, observations.robot[GRIPPER_WIDTH][0]])
        self.now.append({"actions": actions[0], "state": state, **images})
        return actions


class RememberingServer(PredictModelServer):
    """A model server of vla-eval that does the same, in chunks, and looks whether it sees the same."""

    def __init__(self, kept: Path, log: Path) -> None:
        super().__init__(chunk_size=CHUNK)
        self.log, self.memory = log, np.load(kept)

    async def on_episode_start(self, config: dict, ctx: Any) -> None:
        """Look which episode it is."""
        self.task = config["task"]
        await super().on_episode_start(config, ctx)

    def predict(self, obs: dict, ctx: Any) -> dict:
        """The next few actions."""
        name, number = self.task["name"], self.task["episode_idx"]
        if ctx.is_first:
            with self.log.open("a") as file:
                file.write(json.dumps([name, number, obs["task_description"]]) + "\n")
        then = {key: self.memory[f"{name} {number} {key}"] for key in ("actions", "state", *CAMERAS)}
        # without quaternion, whose sign is free, and base, which a policy does not see
        columns = [columns_of(STATE)[key] for key in ("ee_pos", "robot_joints", GRIPPER_WIDTH)]
        state = np.concatenate([obs["state"][part] for part in columns])
        assert np.allclose(state, then["state"][ctx.step], atol=1e-4)
        assert list(obs["images"]) == list(CAMERAS)
        for camera, image in obs["images"].items():
            assert image.shape == then[camera][ctx.step].shape
            assert np.abs(image - then[camera][ctx.step].astype(float)).mean() < 0.5  # a GPU may round otherwise
        return {"actions": then["actions"][ctx.step : ctx.step + CHUNK]}

    def get_action_spec(self) -> dict:
        """RoboCAS' numbers."""
        return {"position": POSITION_DELTA, "rotation": ROTATION_EULER, "gripper": OPEN_01}

    def get_observation_spec(self) -> dict:
        """What it looks at."""
        return {"image": IMAGE_RGB, "language": LANGUAGE}


def main() -> None:
    """Do it all; whatever differs raises."""
    say(f"versions: { ({name: version(name) for name in ('vla-eval', 'robocas-ms3', 'numpy', 'websockets')}) }")
    check_interface()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        kept, log = folder / "kept.npz", folder / "heard.jsonl"
        ours = remember(folder / "ours", kept)
        with served(kept, log):
            run(folder / "theirs", tasks=TASKS, episodes_per_task=EACH)
            heard = [json.loads(line) for line in log.read_text().splitlines()]
            run(folder / "cut", tasks=["pick"], episodes_per_task=EACH + 1, max_steps=3)
        compare(folder / "theirs", ours, heard)
        check_cut(folder / "cut")
    say("vla-eval plays our episodes")


def remember(out: Path, kept: Path) -> results.Result:
    """What comes of the episodes in an evaluation of ours; what was seen and done there is kept in a file."""
    policy, protocol, arrays = Remembering(), load_protocol("smoke"), {}
    settings = EvaluationSettings(tuple(TASKS), "scripted-ee-delta", "smoke", out, envs=1, backend="processes")
    for outcome in EvaluationSession(policy, settings).run():
        steps, episode = policy.kept[outcome.episode], protocol.episodes[outcome.episode]
        number = sum(one.config == episode.config for one in protocol.episodes[: episode.episode])
        for key in steps[0]:
            arrays[f"{episode.config} {number} {key}"] = np.stack([step[key] for step in steps])
    policy.close()
    np.savez(kept, **arrays)
    return results.read_result(out)


def check_interface() -> None:
    """Our class has what theirs declares, and is taken for one of them; conventions are said in their words."""
    ours = resolve_import_string(OURS)
    assert issubclass(ours, Benchmark)
    methods = {name: value for name, value in vars(Benchmark).items() if inspect.isfunction(value)}
    for name, theirs in methods.items():
        mine = getattr(ours, name)
        assert list(inspect.signature(mine).parameters) == list(inspect.signature(theirs).parameters), name
        assert inspect.iscoroutinefunction(mine) == inspect.iscoroutinefunction(theirs), name
    warned = {}
    for convention in ("delta_axis_angle", "robocas", "joint_positions"):
        made = ours(convention=convention)
        server = {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": GRIPPER_CLOSE_NEG}
        specs = (made.get_action_spec(), {"language": LANGUAGE}, made.get_observation_spec())
        warned[convention] = check_specs(server, *specs)
    assert warned["delta_axis_angle"] == []
    assert [text.split(":")[0] for text in sorted(warned["robocas"])] == ["action [gripper]", "action [rotation]"]
    assert any("joints" in text for text in warned["joint_positions"])
    say(f"interface: {len(methods)} methods; mismatches are warned of, as {sorted(warned['robocas'])[1]!r}")


@contextmanager
def served(*files: Path) -> Iterator[None]:
    """Our model server in a process of its own."""
    command = [sys.executable, "-W", "ignore", __file__, "serve", str(PORT), *map(str, files)]
    process = subprocess.Popen(command)
    try:
        for _ in range(120):
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{PORT}/health", timeout=1)
                break
            except OSError:
                assert process.poll() is None, "the model server is gone"
                time.sleep(0.5)
        yield
    finally:
        process.kill()
        process.wait()


def run(out: Path, **entry: Any) -> None:
    """`vla-eval run` of one benchmark."""
    config = {
        "server": {"url": f"ws://127.0.0.1:{PORT}"},
        "benchmarks": [{"benchmark": OURS, "params": PARAMS, **entry}],
    }
    path = out.with_suffix(".yaml")
    path.write_text(yaml.safe_dump(config, sort_keys=False))  # the order of cameras says something
    tool = [sys.executable, "-W", "ignore", str(Path(sys.executable).parent / "vla-eval")]
    subprocess.run([*tool, "run", "--config", str(path), "--output-dir", str(out)], check=True)


def compare(theirs: Path, ours: results.Result, heard: list) -> None:
    """The same came of every episode, and each was played by its own instruction."""
    protocol = load_protocol("smoke")
    said = json.loads((theirs / "RoboCAS_aggregate.json").read_text())
    assert said["num_errors"] == 0
    found = {}
    for task in said["tasks"]:
        for episode in task["episodes"]:
            one = episode["metrics"]
            found[one["episode"]] = one
            assert episode["steps"] == one["steps"]
            assert [task["task"], episode["episode_id"], one["instruction"]] in heard
            assert one["instruction"] == protocol.episodes[one["episode"]].instruction
            assert (one["protocol"], one["protocol_hash"]) == ("smoke", protocol.hash)
    assert found.keys() == ours.outcomes.keys()
    assert len(heard) == len(found) == EACH * len(TASKS)
    for number, outcome in ours.outcomes.items():
        for name, value in outcome.reproducible_values().items():
            assert found[number][name] == value, (number, name, found[number][name], value)
        measures = ", ".join(f"{name} {value:g}" for name, value in outcome.measures.items())
        say(f"  episode {number}: {outcome.steps} steps, {outcome.failure_stage or 'success'}; {measures}")
    assert any(outcome.success for outcome in ours.outcomes.values())
    means = {name: value for name, value in said.items() if name.startswith("mean_")}
    say(f"the same from both; vla-eval's means: {means}")


def check_cut(folder: Path) -> None:
    """What is not the protocol's is an error of the episode, not a score."""
    said = json.loads((folder / "RoboCAS_aggregate.json").read_text())
    episodes = said["tasks"][0]["episodes"]
    assert said["num_errors"] == EACH + 1
    assert [one["failure_reason"] for one in episodes] == ["env_step"] * EACH + ["env_start"]
    assert "Leave max_steps out" in episodes[0]["failure_detail"]
    assert "the protocol has no more episodes of this task" in episodes[-1]["failure_detail"]
    say(f"refused: {episodes[0]['failure_detail'].splitlines()[-1]}")


def say(text: str) -> None:
    """A line of the log."""
    print(text, flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["serve"]:
        serve(RememberingServer(*map(Path, sys.argv[3:])), "127.0.0.1", int(sys.argv[2]))
    else:
        main()
