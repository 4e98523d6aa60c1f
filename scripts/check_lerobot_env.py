"""Evaluate policies in RoboCAS with LeRobot, in one process; called by check_lerobot_env.sh."""

import contextlib
import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from huggingface_hub.constants import HF_HUB_CACHE, HF_HUB_OFFLINE
from lerobot.configs.types import FeatureType
from lerobot.envs import EnvConfig, make_env, preprocess_observation
from lerobot.envs.utils import env_to_policy_features
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.import_utils import register_third_party_plugins

from robocas_ms3.evaluation import load_protocol

HUB_FILE = Path(__file__).resolve().parents[1] / "examples" / "lerobot_hub" / "env.py"
COMMIT = "0123456789abcdef0123456789abcdef01234567"
COMMANDS = Path(sys.executable).parent
CAMERAS = {"cameras": "base_camera,gripper_camera", "observation_width": 64, "observation_height": 48}
# Module with a policy for `robocas eval`: the scripted policy, whose actions are saved by episode.
RECORDER = """
import numpy as np
from robocas_ms3.evaluation.policies.scripted import ScriptedPolicy


class Recorder(ScriptedPolicy):
    def __init__(self):
        super().__init__("robocas")
        self.episodes, self.actions = {}, {}

    def reset(self, episodes):
        super().reset(episodes)
        self.episodes.update({episode.env: episode.episode for episode in episodes})

    def act(self, observations):
        actions = super().act(observations)
        for env, action in zip(observations.envs.tolist(), actions):
            self.actions.setdefault(self.episodes[env], []).append(action)
        return actions

    def close(self):
        super().close()
        np.savez("FILE", **{str(episode): np.array(acts, np.float32) for episode, acts in self.actions.items()})
"""


def main() -> None:
    """Run all checks; a failed check raises an error."""
    names = ("robocas_ms3", "lerobot", "lerobot_env_robocas", "torch", "numpy", "gymnasium", "mani_skill", "sapien")
    say({name: version(name) for name in names})
    register_third_party_plugins()
    assert "robocas" in EnvConfig.get_known_choices()
    with tempfile.TemporaryDirectory() as folder:
        check_untrained_policy(Path(folder))
        check_recorded_actions(Path(folder))
    check_hub_file()
    say("lerobot-eval works with RoboCAS")


def check_untrained_policy(folder: Path) -> None:
    """Run lerobot-eval with random weights of ACT: two tasks, two envs, two episodes per task."""
    features = env_to_policy_features(settings())
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
        str(COMMANDS / "lerobot-eval"),
        "--env.type=robocas",
        "--env.task=select,search",
        "--env.protocol=smoke",
        *(f"--env.{name}={value}" for name, value in CAMERAS.items()),
        f"--env.results={folder / 'results'}",
        f"--policy.path={folder / 'act'}",
        "--policy.device=cpu",
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        "--seed=0",
        f"--output_dir={folder / 'out'}",
    ]
    say(" ".join(command))
    start = time.perf_counter()
    run(command)
    seconds = time.perf_counter() - start
    info = json.loads((folder / "out" / "eval_info.json").read_text())
    assert set(info["per_group"]) == {"select", "search"}
    assert info["overall"]["n_episodes"] == 4
    videos = info["overall"]["video_paths"]
    assert len(videos) == 4 and all(Path(video).stat().st_size > 1000 for video in videos), videos
    for task in info["per_task"]:
        ours = outcomes(folder / "results" / task["task_group"])
        assert len(ours) == 2
        assert [ours[episode]["success"] for episode in sorted(ours)] == task["metrics"]["successes"]
    say(f"lerobot-eval: {info['overall']['n_episodes']} episodes in {seconds:.0f} s, with 4 videos")
    run([COMMANDS / "robocas", "eval", "report", folder / "results" / "select", folder / "results" / "search"])


def check_recorded_actions(folder: Path) -> None:
    """Replay the actions of the scripted policy with LeRobot; compare the outcomes with `robocas eval`."""
    (folder / "recorder.py").write_text(RECORDER.replace("FILE", str(folder / "actions.npz")))
    command = [COMMANDS / "robocas", "eval", "pick", "search", "--protocol", "smoke", "--policy", "recorder:Recorder"]
    run([*command, "--out", folder / "ours"], path=folder)
    ours, actions = outcomes(folder / "ours"), np.load(folder / "actions.npz")
    envs = make_env(settings(task="pick,search", results=str(folder / "theirs")), n_envs=2)
    instructions = [episode.instruction for episode in load_protocol("smoke").episodes]
    for task, seeds in (("pick", [1, 0]), ("search", [0, 1])):
        env = envs[task][0]
        policy, identity = ReplayModule(env, actions), PolicyProcessorPipeline(steps=[])
        with contextlib.redirect_stderr(io.StringIO()):  # a progress bar
            found = rollout(env, policy, identity, identity, identity, lambda action: action, seeds=seeds)
        theirs = outcomes(folder / "theirs" / task)
        assert policy.instructions == [instructions[episode] for episode in env.episodes], policy.instructions
        for row, episode in enumerate(env.episodes.tolist()):
            assert ours[episode] == theirs[episode], (ours[episode], theirs[episode])
            assert bool(found["success"][row].any()) == ours[episode]["success"]
            steps = int(found["done"][row].to(int).argmax()) + 1
            assert steps == ours[episode]["steps"]
            say(f"{task}, episode {episode}: equal to robocas eval, {steps} steps, success {ours[episode]['success']}")
        env.close()
    assert any(outcome["success"] for outcome in ours.values())


class ReplayModule(torch.nn.Module):
    """Policy module that returns the recorded actions of each episode of an environment."""

    def __init__(self, env, actions) -> None:
        super().__init__()
        self.env, self.actions, self.step, self.instructions = env, actions, 0, []

    def reset(self) -> None:
        """Start at the first action."""
        self.step = 0

    def select_action(self, batch: dict) -> torch.Tensor:
        """Return the next recorded actions (E, 7)."""
        self.instructions = self.instructions or list(batch["task"])
        assert batch["observation.state"].shape == (2, 18)
        assert batch["observation.images.base_camera"].shape == (2, 3, 48, 64)
        rows = [self.actions[str(episode)] for episode in self.env.episodes]
        self.step += 1
        return torch.from_numpy(np.stack([row[min(self.step, len(row)) - 1] for row in rows]))


def check_hub_file() -> None:
    """Load examples/lerobot_hub/env.py from a cache of the Hub, without internet, and step the environment."""
    assert HF_HUB_OFFLINE, "set HF_HUB_OFFLINE=1"
    repository = Path(HF_HUB_CACHE) / "models--someone--robocas"
    shutil.rmtree(repository, ignore_errors=True)
    (repository / "snapshots" / COMMIT).mkdir(parents=True)
    shutil.copy(HUB_FILE, repository / "snapshots" / COMMIT / "env.py")
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text(COMMIT)
    env = make_env("someone/robocas", n_envs=2, trust_remote_code=True)["pick"][0]
    env.reset(seed=[0, 1])
    obs, reward, terminated, truncated, info = env.step(np.zeros((2, 7), np.float32))
    names = sorted(preprocess_observation(obs))
    assert {"observation.images.base_camera", "observation.state"} <= set(names)
    assert obs["pixels"]["base_camera"].shape == (2, 480, 640, 3) and obs["pixels"]["base_camera"].std() > 10
    assert not (reward.any() or terminated.any() or truncated.any() or info["is_success"].any())
    say(f"EnvHub: {list(env.call('task_description'))}, {names}")
    env.close()


def settings(**others) -> EnvConfig:
    """Return a configuration with small images and the protocol `smoke`."""
    return EnvConfig.get_choice_class("robocas")(protocol="smoke", **CAMERAS, **others)


def outcomes(folder: Path) -> dict[int, dict]:
    """Return the outcomes of a result by episode, without measured times."""
    lines = [json.loads(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]
    return {line["episode"]: {key: line[key] for key in line if key != "inference_ms"} for line in lines}


def run(command: list, path: Path | None = None) -> None:
    """Run a command, with `path` as PYTHONPATH, and print the last lines of its output."""
    env = {**os.environ, **({} if path is None else {"PYTHONPATH": str(path)})}
    done = subprocess.run([str(word) for word in command], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    say("\n".join(done.stdout.strip().splitlines()[-12:]))


def say(text: object) -> None:
    """Print a line without buffering."""
    print(text, flush=True)


if __name__ == "__main__":
    main()
