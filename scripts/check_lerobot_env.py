"""Evaluates policies with lerobot-eval in RoboCAS; run by check_lerobot_env.sh in LeRobot's own environment."""

import contextlib
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from lerobot.configs.types import FeatureType
from lerobot.envs import EnvConfig, make_env
from lerobot.envs.utils import env_to_policy_features
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.import_utils import register_third_party_plugins

PYTHON = os.environ["ROBOCAS_SIM_PYTHON"]
LOOKS = {"cameras": "base_camera,gripper_camera", "observation_width": 64, "observation_height": 48}
# Run by `robocas eval` in its own interpreter: the demonstrator, whose actions are kept by episode.
RECORDER = """
import numpy as np
from robocas_ms3.evaluation.policies.scripted import ScriptedPolicy


class Recorder(ScriptedPolicy):
    def __init__(self):
        super().__init__("robocas")
        self.starts, self.acts = {}, {}

    def reset(self, starts):
        super().reset(starts)
        self.starts.update({start.env: start.episode for start in starts})

    def act(self, observations):
        actions = super().act(observations)
        for env, action in zip(observations.envs.tolist(), actions):
            self.acts.setdefault(self.starts[env], []).append(action)
        return actions

    def close(self):
        super().close()
        np.savez("FILE", **{str(episode): np.array(acts, np.float32) for episode, acts in self.acts.items()})
"""


def main() -> None:
    """Do it all; whatever does not come out as it should raises."""
    say({name: version(name) for name in ("lerobot", "lerobot_env_robocas", "torch", "numpy", "gymnasium")})
    register_third_party_plugins()
    assert "robocas" in EnvConfig.get_known_choices()
    assert EnvConfig.get_choice_class("robocas")(task="all", protocol="paper-v1").tasks == ["pick", "search"]
    with tempfile.TemporaryDirectory() as folder:
        untrained(Path(folder))
        recorded(Path(folder))
    refused()
    say("lerobot-eval plays RoboCAS")


def untrained(folder: Path) -> None:
    """ACT with random weights by the command, two envs, two episodes of two tasks each."""
    config = EnvConfig.get_choice_class("robocas")(**LOOKS)
    features = env_to_policy_features(config)
    outputs = {key: feature for key, feature in features.items() if feature.type is FeatureType.ACTION}
    inputs = {key: feature for key, feature in features.items() if key not in outputs}
    act = ACTConfig(
        input_features=inputs,
        output_features=outputs,
        device="cpu",
        pretrained_backbone_weights=None,
        chunk_size=8,
        n_action_steps=8,
        dim_model=64,
        n_heads=4,
        dim_feedforward=64,
    )
    torch.manual_seed(0)
    ACTPolicy(act).save_pretrained(folder / "act")
    for processor in make_pre_post_processors(act):
        processor.save_pretrained(folder / "act")
    command = [
        str(Path(sys.executable).parent / "lerobot-eval"),
        "--env.type=robocas",
        "--env.task=select,search",
        "--env.protocol=smoke",
        *(f"--env.{name}={value}" for name, value in LOOKS.items()),
        f"--env.results={folder / 'results'}",
        f"--policy.path={folder / 'act'}",
        "--policy.device=cpu",
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        "--seed=0",
        f"--output_dir={folder / 'out'}",
    ]
    say(" ".join(command))
    begun = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    info = json.loads((folder / "out" / "eval_info.json").read_text())
    assert set(info) == {"per_task", "per_group", "overall"}, set(info)
    assert set(info["per_group"]) == {"select", "search"}
    assert info["overall"]["n_episodes"] == 4
    assert {"avg_sum_reward", "avg_max_reward", "pc_success", "eval_s", "eval_ep_s"} <= set(info["overall"])
    videos = info["overall"]["video_paths"]
    assert len(videos) == 4 and all(Path(video).stat().st_size > 1000 for video in videos), videos
    for task in info["per_task"]:
        ours = outcomes(folder / "results" / task["task_group"])
        assert [ours[episode]["success"] for episode in sorted(ours)] == task["metrics"]["successes"]
        assert len(ours) == 2
    seconds = time.perf_counter() - begun
    say(f"lerobot-eval: {info['overall']['n_episodes']} episodes in {seconds:.0f} s, with 4 videos")
    say(json.dumps({key: value for key, value in info["overall"].items() if key != "video_paths"}))
    robocas("eval", "report", str(folder / "results" / "select"), str(folder / "results" / "search"))


def recorded(folder: Path) -> None:
    """The demonstrator's motions by LeRobot's loop: the outcomes of `robocas eval`, and each env's own instruction."""
    (folder / "recorder.py").write_text(RECORDER.replace("FILE", str(folder / "acts.npz")))
    command = ("eval", "pick", "search", "--protocol", "smoke", "--policy", "recorder:Recorder")
    robocas(*command, "--out", str(folder / "ours"), path=folder)
    ours, acts = outcomes(folder / "ours"), np.load(folder / "acts.npz")
    config = EnvConfig.get_choice_class("robocas")(
        task="pick,search", protocol="smoke", results=str(folder / "theirs"), **LOOKS
    )
    envs = make_env(config, n_envs=2)
    for task, numbers in (("pick", [1, 0]), ("search", [0, 1])):  # of episodes, in the task's list
        env = envs[task][0]
        policy = Replayed(env, acts)
        nothing = PolicyProcessorPipeline(steps=[])
        with contextlib.redirect_stderr(io.StringIO()):  # its bar
            said = rollout(env, policy, nothing, nothing, nothing, lambda action: action, seeds=numbers)
        theirs = outcomes(folder / "theirs" / task)
        assert policy.instructions == [instruction(episode) for episode in env.episodes], policy.instructions
        for row, episode in enumerate(env.episodes.tolist()):
            assert ours[episode] == theirs[episode], (ours[episode], theirs[episode])
            assert bool(said["success"][row].any()) == ours[episode]["success"]
            last = int(said["done"][row].to(int).argmax())
            assert last + 1 == ours[episode]["steps"]
            say(f"{task}, episode {episode}, as robocas eval: {last + 1} steps, success {ours[episode]['success']}")
        env.close()
    assert any(one["success"] for one in ours.values())


class Replayed(torch.nn.Module):
    """Actions that were recorded, by episode; keeps what it is told at first."""

    def __init__(self, env, acts) -> None:
        super().__init__()
        self.env, self.acts, self.step, self.instructions = env, acts, 0, []

    def reset(self) -> None:
        """An episode begins."""
        self.step = 0

    def select_action(self, batch: dict) -> torch.Tensor:
        """(E, 7)."""
        self.instructions = self.instructions or list(batch["task"])
        assert batch["observation.state"].shape == (2, 18)
        assert batch["observation.images.base_camera"].shape == (2, 3, 48, 64)
        rows = [self.acts[str(episode)] for episode in self.env.episodes]
        self.step += 1
        return torch.from_numpy(np.stack([row[min(self.step, len(row)) - 1] for row in rows]))


def refused() -> None:
    """What can't be played is one clear line, before any policy is loaded."""
    known = EnvConfig.get_choice_class("robocas")
    for config, expected in (
        (known(task="juggle", protocol="smoke", **LOOKS), "no such task"),
        (known(protocol="paper-v1", fps=10, **LOOKS), "another rate"),
        (known(python=sys.executable, **LOOKS), "No module named"),
        (known(python="/nowhere/python", **LOOKS), "no interpreter at /nowhere/python"),
    ):
        try:
            make_env(config)
        except RuntimeError as error:
            assert expected in str(error), error
            say(f"refused: {error}")
        else:
            raise AssertionError(expected)


def outcomes(folder: Path) -> dict[int, dict]:
    """What came of episodes, by number, without what a clock said."""
    lines = [json.loads(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]
    return {one["episode"]: {key: value for key, value in one.items() if key != "inference_ms"} for one in lines}


def instruction(episode: int) -> str:
    """Of an episode of the protocol."""
    path = Path(__file__).resolve().parents[1] / "robocas_ms3" / "data" / "protocols" / "smoke" / "episodes.jsonl"
    return json.loads(path.read_text().splitlines()[episode])["instruction"]


def robocas(*words: str, path: Path | None = None) -> None:
    """Run a command of ours in its own interpreter."""
    env = {**os.environ, **({} if path is None else {"PYTHONPATH": f"{path}:{os.environ.get('PYTHONPATH', '')}"})}
    done = subprocess.run([PYTHON, "-m", "robocas_cli", *words], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    say(done.stdout.strip())


def say(text: object) -> None:
    """A line of the log."""
    print(text, flush=True)


if __name__ == "__main__":
    main()
