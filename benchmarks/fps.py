"""Measure the steps per second of batched envs, of ManiSkill's PickCube-v1, and of a bare scene; print JSON.

python benchmarks/fps.py [--envs 1 16 256 1024 4096] [--modes state rgb] [--size 128 128] [--steps 100]

The bare scene has the bodies of a task configuration and no task. Without PhysX on a GPU only one env is measured;
`benchmarks/vector.py` measures several envs in processes. Actions are random. Time is wall-clock time after a warm-up,
without resets. JSON keys:
  device             name of the GPU, or cpu
  size               width and height of the images in pixels
  steps_per_second   observation mode -> case -> number of envs -> steps per second of all envs together, or an error
  over_bare          observation mode -> configuration -> number of envs -> rate as a factor of the bare scene
  skipped            reason why only one env was measured
Exit status: 1 if a case could not be measured.
"""

from __future__ import annotations

import json
import sys
import time
from contextlib import redirect_stdout
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium as gym
import torch
import tyro
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.tasks import PickCubeEnv  # noqa: F401  (registers it)
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose
from mani_skill.utils.structs.types import SceneConfig, SimConfig
from sapien import physx

import robocas_ms3.tasks  # noqa: F401
from robocas_ms3.assets.pack import load_pack
from robocas_ms3.assets.physics import CONTACT_OFFSET
from robocas_ms3.core.text import format_error
from robocas_ms3.scenes import build
from robocas_ms3.scenes.cache import make_layout_source
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.task_specs import TASKS
from robocas_ms3.tasks.engine import gpu_memory_limits


@register_env("RoboCASBare-v1", max_episode_steps=10_000)
class BareEnv(BaseEnv):
    """Env with ManiSkill's Panda and the furniture and objects of a configuration, without evaluation.

    Args:
        scene_config: name of a task configuration; every env has the layout of seed 0.
        kwargs: arguments of ``BaseEnv``.
    """

    SUPPORTED_ROBOTS = ["panda"]  # noqa: RUF012  (ManiSkill's form)
    SUPPORTED_REWARD_MODES = ["none"]  # noqa: RUF012

    def __init__(self, *args: Any, scene_config: str, **kwargs: Any) -> None:
        pack = load_pack("builtin")
        self.model = SceneModel.load(load_task_config(scene_config), pack, pack)
        super().__init__(*args, robot_uids="panda", **kwargs)

    @property
    def _default_sim_config(self) -> SimConfig:
        return SimConfig(
            sim_freq=100,
            control_freq=20,
            spacing=10,
            scene_config=SceneConfig(contact_offset=CONTACT_OFFSET),
            gpu_memory_config=gpu_memory_limits(self.num_envs, self.model.config.objects.count),
        )

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at([0.6, 0, 1.6], [-0.5, 0, 0.6])
        return [
            CameraConfig(f"camera_{i}", pose, 128, 128, fov=1.5, near=0.01, far=10, shader_pack="minimal")
            for i in range(3)
        ]

    def _load_scene(self, options: dict) -> None:
        self.layout = make_layout_source(self.model)(0, 0)
        build.build_fixtures(self.scene, self.model, "fast", [0] * self.num_envs)
        assets = [self.model.object_pack.objects[i] for i in self.layout.object_ids]
        self.things = [build.build_object_slot(self.scene, k, [a] * self.num_envs) for k, a in enumerate(assets)]

    def _load_lighting(self, options: dict) -> None:
        build.build_lights(self.scene, self.model.config, [0] * self.num_envs, shadow=False)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self.agent.reset(torch.as_tensor(self.agent.keyframes["rest"].qpos).float())
        self.agent.robot.set_pose(Pose.create_from_pq(torch.tensor([[0.2, 0.0, 1.2]])))
        for thing, pose in zip(self.things, self.layout.object_poses, strict=True):
            position, turn = torch.as_tensor(pose[:3, 3]), sapien_utils.sapien.Pose(pose).q
            thing.set_pose(Pose.create_from_pq(position[None].float(), torch.as_tensor(turn)[None]))

    def evaluate(self) -> dict:
        """Evaluate nothing."""
        return {}


@dataclass
class Args:
    envs: tuple[int, ...] = (1, 16, 64, 256, 1024, 4096)
    """Numbers of envs."""
    modes: tuple[Literal["state", "rgb"], ...] = ("state", "rgb")
    """Observation modes: states, or three cameras (one for PickCube-v1)."""
    configs: tuple[str, ...] = ("pick_table_scattered", "search_table_stacked")
    """Task configurations."""
    size: tuple[int, int] = (128, 128)
    """Width and height of the images in pixels."""
    steps: int = 100
    """Number of control steps to measure."""
    seconds: float = 60.0
    """Seconds after which a case stops early."""


def main(args: Args) -> None:
    torch.set_num_threads(1)
    problem = start_physx()  # must happen before the first env on the CPU
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu"
    report: dict[str, Any] = {"device": device, "size": args.size, "steps_per_second": {}}
    failed = 0
    for mode in args.modes:
        cases = {"pick_cube": ("PickCube-v1", {})}
        for config in args.configs:
            cases[config] = TASKS[load_task_config(config).task].env_id, {"config": config}
            cases[f"{config} bare"] = "RoboCASBare-v1", {"scene_config": config}
        rates: dict[str, dict[int, float | str]] = {name: {} for name in cases}
        for name, (env_id, kwargs) in cases.items():
            for count in args.envs:
                if count == 1 or not problem:
                    try:
                        rates[name][count] = round(measure_rate(env_id, count, mode, args, kwargs), 1)
                    except Exception as error:  # for example too little memory; the other cases still run
                        rates[name][count] = f"{type(error).__name__}: {error}"
                        failed += 1
        report["steps_per_second"][mode] = rates
        report.setdefault("over_bare", {})[mode] = {
            config: {
                count: round(own / bare, 2)
                for count, own in rates[config].items()
                if isinstance(own, float) and isinstance(bare := rates[f"{config} bare"].get(count), float)
            }
            for config in args.configs
        }
    if problem:
        report["skipped"] = f"more than one env: {problem}"
    print(json.dumps(report, indent=2))
    if failed:
        raise SystemExit(f"{failed} cases could not be measured")


def start_physx() -> str:
    """Start PhysX on the GPU; return the reason if that fails, else ""."""
    if not torch.cuda.is_available():
        return "no CUDA device"
    try:
        with redirect_stdout(sys.stderr):  # SAPIEN prints there that it downloads the library
            physx.enable_gpu()
    except Exception as error:  # for example of requests, if the library cannot be downloaded
        return f"PhysX does not start on the GPU: {format_error(error)}"
    return ""


def measure_rate(env_id: str, count: int, mode: str, args: Args, kwargs: dict[str, Any]) -> float:
    """Return the steps per second of all envs together."""
    kwargs = kwargs if mode == "rgb" else {**kwargs, "render_backend": "none"}
    sensors = dict(zip(("width", "height"), args.size, strict=True))
    kwargs = {**kwargs, "obs_mode": mode, "control_mode": "pd_joint_delta_pos", "sensor_configs": sensors}
    env = gym.make(env_id, num_envs=count, **kwargs)
    try:
        env.reset(seed=0)
        shape = env.action_space.shape
        assert shape is not None
        device = env.unwrapped.device  # type: ignore[attr-defined]
        generator = torch.Generator(device).manual_seed(0)
        steps, start = 0, 0.0
        for step in range(-10, args.steps):
            if step == 0:
                _wait(device)
                start = time.perf_counter()
            env.step(0.2 * (2 * torch.rand(shape, generator=generator, device=device) - 1))
            steps = step + 1
            if step >= 0 and time.perf_counter() - start > args.seconds:
                break
        _wait(device)
        return count * steps / (time.perf_counter() - start)
    finally:
        env.close()


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize()


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
