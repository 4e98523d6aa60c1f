"""RoboCAS in LeRobot: settings, names, evaluation loop and EnvHub."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("lerobot.envs", reason="needs lerobot 0.6, which needs Python 3.12: pip install '.[lerobot-env]'")

import torch
from huggingface_hub import constants
from lerobot.configs import FeatureType
from lerobot.envs import EnvConfig, HubEnvConfig, make_env, preprocess_observation
from lerobot.envs.utils import env_to_policy_features
from lerobot.processor import PolicyProcessorPipeline
from lerobot.scripts.lerobot_eval import rollout

from robocas_ms3.core.errors import EvaluationError, VectorEnvError
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.evaluation.harness.lerobot import RoboCASEnvConfig
from robocas_ms3.evaluation.results.result_files import read_result

HUB_FILE = Path(__file__).resolve().parents[3] / "examples" / "lerobot_hub" / "env.py"
COMMIT = "0123456789abcdef0123456789abcdef01234567"
SMALL = {
    "protocol": "smoke",
    "backend": "processes",
    "cameras": "base_camera",
    "observation_width": 6,
    "observation_height": 4,
}


@pytest.fixture
def hub(tmp_path, monkeypatch) -> Path:
    """An offline Hub cache with env.py."""
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    repository = tmp_path / "hub" / "models--someone--robocas"
    (repository / "snapshots" / COMMIT).mkdir(parents=True)
    shutil.copy(HUB_FILE, repository / "snapshots" / COMMIT / "env.py")
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text(COMMIT)
    return tmp_path / "hub"


class Adder(torch.nn.Module):
    """Policy that adds 2.5 in the first env and 1 in the others, and records its observations."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[dict] = []

    def reset(self) -> None:
        """Nothing to reset."""

    def select_action(self, batch: dict) -> torch.Tensor:
        self.seen.append(batch)
        actions = torch.zeros((len(batch["task"]), 7))
        actions[:, 0] = 1
        actions[0, 0] = 2.5
        return actions


@pytest.mark.parametrize("depth", [False, True])
def test_observations_have_the_names_and_shapes_of_the_policys_features(made, depth):
    config = RoboCASEnvConfig(depth=depth, **SMALL)
    features = env_to_policy_features(config)
    env = make_env(config, n_envs=2)["pick"][0]
    seen = preprocess_observation(env.reset(seed=0)[0])
    env.close()
    inputs = {name: feature.shape for name, feature in features.items() if feature.type is not FeatureType.ACTION}
    assert {name: tuple(value.shape[1:]) for name, value in seen.items()} == inputs
    states = {one.key: (one.width,) for one in schema.FEATURES if one.key.startswith("observation.")}
    images = {schema.image_key("base_camera"): (3, 4, 6)}
    depths = {schema.depth_key("base_camera"): (1, 4, 6)} if depth else {}
    calibration = {"observation.intrinsics.base_camera": (3, 3), "observation.camera_in_base.base_camera": (4, 4)}
    assert inputs == {**states, **images, **depths, **calibration}
    assert features["action"].shape == (7,)


def test_lerobots_rollout_reads_success_tasks_and_ends(made, tmp_path):
    config = RoboCASEnvConfig(task="search", results=str(tmp_path / "results"), **SMALL)
    env, policy, same = make_env(config, n_envs=2)["search"][0], Adder(), PolicyProcessorPipeline(steps=[])
    found = rollout(env, policy, same, same, same, lambda action: action, seeds=[0, 1])
    env.close()
    assert found["done"].tolist() == [[False, True, True, True, True], [False, False, False, False, True]]
    assert found["success"].tolist() == found["done"].tolist()
    assert found["reward"].sum(1).tolist() == [1.0, 1.0]
    outcomes = read_result(tmp_path / "results" / "search").outcomes
    assert {number: one.steps for number, one in outcomes.items()} == {4: 2, 5: 5}
    tasks = policy.seen[0]["task"]
    assert len(set(tasks)) == 2 and all(isinstance(task, str) for task in tasks)


def test_all_tasks_of_a_protocol_or_of_a_split(made):
    assert EnvConfig.get_choice_class("robocas") is RoboCASEnvConfig
    assert list(make_env(RoboCASEnvConfig(task="all", **SMALL))) == ["pick", "select", "search", "open_pick"]
    assert list(make_env(RoboCASEnvConfig(task=" search,pick ", **SMALL))) == ["search", "pick"]
    of_split = RoboCASEnvConfig(task="all", split="new", **{**SMALL, "protocol": "objects-v1"})
    assert list(make_env(of_split)) == ["pick", "search"]


@pytest.mark.parametrize(
    ("settings", "error"),
    [
        (dict(convention="euler"), EvaluationError),
        (dict(calibration="exact"), EvaluationError),
        (dict(cameras=","), EvaluationError),
        (dict(task=" "), EvaluationError),
        (dict(protocol="smok"), EvaluationError),
        (dict(backend="threads"), VectorEnvError),
    ],
)
def test_invalid_settings_of_the_environment_are_refused(made, settings, error):
    with pytest.raises(error):
        make_env(RoboCASEnvConfig(**{**SMALL, **settings}))


def test_hub_file_uses_its_settings_instead_of_the_defaults_of_lerobot(made, hub):
    for task, fps, plain in (
        ("pick", 5, "someone/robocas"),
        ("pick", 5, HubEnvConfig(hub_path="someone/robocas")),  # whose task is None and fps 30
        ("select", 10, HubEnvConfig(hub_path="someone/robocas", task="select", fps=10)),
    ):
        envs = make_env(plain, n_envs=2, hub_cache_dir=str(hub), trust_remote_code=True)
        assert list(envs) == [task]
        env = envs[task][0]
        assert env.metadata["render_fps"] == fps
        assert env.num_envs == 2 and env.call("_max_episode_steps")[0] > 0
        assert env.single_observation_space["pixels"]["base_camera"].shape == (480, 640, 3)
    with pytest.raises(RuntimeError, match="trust_remote_code"):
        make_env("someone/robocas", hub_cache_dir=str(hub))


def test_hub_file_uses_the_settings_of_a_configuration(made, hub):
    @dataclass
    class OfTheHub(HubEnvConfig):
        hub_path: str | None = "someone/robocas"
        task: str | None = "select,search"
        fps: int = 5
        protocol: str = "smoke"
        cameras: str = "base_camera"
        observation_width: int = 6
        observation_height: int = 4

    envs = make_env(OfTheHub(), n_envs=1, hub_cache_dir=str(hub), trust_remote_code=True)
    assert list(envs) == ["select", "search"]
    obs, _ = envs["search"][0].reset(seed=0)
    assert list(obs["pixels"]) == ["base_camera"] and isinstance(obs["agent_pos"], np.ndarray)
    for env in envs.values():
        env[0].close()
