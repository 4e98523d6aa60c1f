"""What all RoboCAS environments share: the scene from a configuration, layouts from a seed, observations, contacts."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs import Actor, Articulation, Pose
from mani_skill.utils.structs.types import SimConfig
from scipy.spatial.transform import Rotation

from robocas_ms3.assets.pack import VISUALS, LoadedObject, VisualLevel, load_pack
from robocas_ms3.config import TaskConfig, load_task_config
from robocas_ms3.errors import ConfigError, LayoutError
from robocas_ms3.robots.constants import HAND_LINK
from robocas_ms3.robots.mobile_panda import RoboCASMobilePanda
from robocas_ms3.scenes import build
from robocas_ms3.scenes.grasping import count_free_grasps
from robocas_ms3.scenes.placement import choose_objects, choose_target, sample_scattered, transform
from robocas_ms3.tasks import terms
from robocas_ms3.tasks.contacts import contact_forces
from robocas_ms3.tasks.spec import TaskSpec

# Every random decision of a scene has a stream of its own, so that a new one never shifts the others.
_OBJECTS, _LAYOUT, _TARGET = range(3)
_LAYOUT_TRIES = 50


class RoboCASEnv(BaseEnv):
    """Base of the RoboCAS environments.

    Every env has its own objects and target. On a CPU (one env a process) the scene is built anew at each reset, so
    that each seed has its own objects; with several envs on a GPU the objects are drawn once, from the seeds the envs
    were made with, and each reset draws a new layout and target (``reconfiguration_freq`` changes either).

    Args:
        config: name, path or content of a task configuration; default: the task's own.
        pack: name or folder of the pack that objects come from.
        furniture_pack: the same for room, furniture and basket.
        visual_level: ``fast`` or ``full`` meshes to render.
        robot_uids: the robot; only RoboCAS's mobile Panda is supported.
        reconfiguration_freq: see ``BaseEnv``; default 1 for one env, 0 for several.
        kwargs: passed to ``BaseEnv``.
    """

    SPEC: ClassVar[TaskSpec]
    SUPPORTED_ROBOTS = ["robocas_mobile_panda"]  # noqa: RUF012  (ManiSkill's form)
    SUPPORTED_REWARD_MODES = ("sparse", "none")

    agent: RoboCASMobilePanda

    def __init__(
        self,
        *args: Any,
        config: str | Path | dict | TaskConfig | None = None,
        pack: str | Path = "builtin",
        furniture_pack: str | Path = "builtin",
        visual_level: VisualLevel = "fast",
        robot_uids: str = "robocas_mobile_panda",
        num_envs: int = 1,
        reconfiguration_freq: int | None = None,
        **kwargs: Any,
    ) -> None:
        self.task_config = load_task_config(self.SPEC.default_config if config is None else config)
        if self.task_config.task != self.SPEC.name:
            raise ConfigError(
                f"{self.SPEC.env_id} can't run this configuration",
                expected=f"task: {self.SPEC.name}",
                found=f"task: {self.task_config.task}",
            )
        if visual_level not in VISUALS:
            raise ConfigError("no such visual_level", expected=f"one of {list(VISUALS)}", found=visual_level)
        self.object_pack = load_pack(pack)
        self.furniture_pack = load_pack(furniture_pack)
        self._object_ids = build.find_objects(self.object_pack, self.task_config)
        surface = self.task_config.surface
        support = self.task_config.furniture[surface.furniture]
        furniture = build.find_furniture(self.furniture_pack, support.asset, key=f"furniture.{surface.furniture}.asset")
        self._support_in_world = build.furniture_pose(support, furniture)
        self._region = build.find_region(surface, furniture)
        self._visual_level: VisualLevel = visual_level
        self._fixture_points = build.fixture_points(self.task_config, self.furniture_pack)
        self._basket_asset = build.find_container(self.furniture_pack, self.task_config.basket)
        if reconfiguration_freq is None:
            reconfiguration_freq = 1 if num_envs == 1 else 0
        super().__init__(
            *args, robot_uids=robot_uids, num_envs=num_envs, reconfiguration_freq=reconfiguration_freq, **kwargs
        )

    @property
    def _default_sim_config(self) -> SimConfig:
        return SimConfig(sim_freq=100, control_freq=20, spacing=10)

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        eye = sapien_utils.look_at([2.2, -0.1, 1.7], [0.85, 0.75, 0.6])
        return CameraConfig("render_camera", eye, 640, 480, np.pi / 3, 0.01, 20)

    # ------------------------------------------------------------------ scene

    def _load_agent(self, options: dict, *args: Any, **kwargs: Any) -> None:
        super()._load_agent(options, sapien.Pose(build.fixture_pose(self.task_config.robot)))

    def _load_scene(self, options: dict) -> None:
        self.fixtures = build.build_fixtures(self.scene, self.task_config, self.furniture_pack, self._visual_level)
        count = self.task_config.objects.count
        draws = self._draw_seeds(torch.arange(self.num_envs))
        chosen = [choose_objects(np.random.default_rng([d, _OBJECTS]), self._object_ids, count) for d in draws]
        self.object_assets: list[list[LoadedObject]] = [[self.object_pack.objects[i] for i in ids] for ids in chosen]
        self.objects: list[Actor] = [
            build.build_object_slot(
                self.scene, slot, [assets[slot] for assets in self.object_assets], self._visual_level
            )
            for slot in range(count)
        ]
        facts = [[asset.asset for asset in assets] for assets in self.object_assets]
        self._centers_of_mass = torch.tensor(
            [[f.center_of_mass for f in row] for row in facts], dtype=torch.float32, device=self.device
        )
        self._rest_height = torch.zeros(self.num_envs, count, device=self.device)
        self.target_slot = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self.basket_at_start = Pose.create(sapien.Pose(self._basket_pose()), device=self.device)
        inner = self._basket_asset.asset.inner
        assert inner is not None  # find_container saw to it
        self._basket_low = torch.tensor(inner.min, device=self.device)
        self._basket_high = torch.tensor(inner.max, device=self.device)

    def _load_lighting(self, options: dict) -> None:
        lights = self.task_config.lights
        self.scene.set_ambient_light([lights.ambient] * 3)
        self.scene.add_directional_light(
            list(lights.direction),
            [lights.directional] * 3,
            shadow=lights.shadow or self.enable_shadow,
            shadow_scale=5,
            shadow_map_size=2048,
        )
        self.scene.add_directional_light([0, 0, -1], [lights.directional] * 3)

    def _basket_pose(self) -> np.ndarray:
        return build.furniture_pose(self.task_config.basket, self._basket_asset)

    def _draw_seeds(self, env_idx: torch.Tensor) -> list[int]:
        """Draw the seed of what follows for each env, from its own episode generator.

        Drawn rather than read from ``_episode_seed``, which an unseeded partial reset leaves as it was.
        """
        assert self._batched_episode_rng is not None
        return [int(self._batched_episode_rng[i].randint(2**31)) for i in env_idx.tolist()]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            count = len(env_idx)
            rest = torch.as_tensor(self.agent.keyframes["rest"].qpos, dtype=torch.float32)
            self.agent.reset(rest.repeat(count, 1))
            self.agent.robot.set_pose(sapien.Pose(build.fixture_pose(self.task_config.robot)))
            for furniture in self.fixtures.furniture.values():
                if isinstance(furniture, Articulation):
                    furniture.set_qpos(torch.zeros(count, furniture.max_dof))
                    furniture.set_qvel(torch.zeros(count, furniture.max_dof))
            self.fixtures.basket.set_pose(Pose.create(sapien.Pose(self._basket_pose())))
            poses, targets = self._sample_layouts(env_idx)
            for slot, actor in enumerate(self.objects):
                actor.set_pose(Pose.create(torch.as_tensor(_raw_poses(poses[:, slot]), device=self.device)))
            self.target_slot[env_idx] = torch.as_tensor(targets, device=self.device)
            self._rest_height[env_idx] = torch.as_tensor(poses[:, :, 2, 3], dtype=torch.float32, device=self.device)

    def _sample_layouts(self, env_idx: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
        """Layout and target of each env: (n, K, 4, 4) objects in the world, (n,) slots."""
        layouts, targets = [], []
        for env, seed in zip(env_idx.tolist(), self._draw_seeds(env_idx), strict=True):
            layout_rng, target_rng = (np.random.default_rng([seed, stream]) for stream in (_LAYOUT, _TARGET))
            assets = self.object_assets[env]
            for _ in range(_LAYOUT_TRIES):
                poses = self._support_in_world @ sample_scattered(
                    layout_rng,
                    [build.placeable(asset) for asset in assets],
                    self._region,
                    min_gap=self.task_config.layout.min_gap,
                    max_tries=self.task_config.layout.max_tries,
                )
                target = self._choose_target(target_rng, assets, poses)
                if target is not None:
                    break
            else:
                raise LayoutError(
                    "no object qualifies as the target",
                    where="target",
                    found=f"{_LAYOUT_TRIES} layouts tried",
                    fix="Raise target.max_distance, lower target.min_grasps, or use other objects.",
                )
            layouts.append(poses)
            targets.append(target)
        return np.stack(layouts), np.array(targets)

    def _choose_target(self, rng: np.random.Generator, assets: list[LoadedObject], poses: np.ndarray) -> int | None:
        rules = self.task_config.target
        robot_xy = np.array(self.task_config.robot.position[:2])
        distance = np.linalg.norm(poses[:, :2, 3] - robot_xy, axis=1)
        graspable = np.array([asset.asset.grasp_count >= rules.min_grasps for asset in assets])
        names = [asset.asset.name for asset in assets]
        eligible = graspable & (distance <= rules.max_distance)

        def has_free_grasps(slot: int) -> bool:
            others = [transform(p, a.surface_points()) for a, p in zip(assets, poses, strict=True)]
            del others[slot]
            points = np.concatenate([self._fixture_points, *others])
            return count_free_grasps(assets[slot], poses[slot], points, robot_xy) >= rules.min_free_grasps

        return choose_target(rng, names, poses[:, :2, 3], eligible, robot_xy, has_free_grasps)

    # ------------------------------------------------------------------ state

    @property
    def object_poses(self) -> torch.Tensor:
        """(N, K, 7) poses of the objects in the world: position m, quaternion wxyz."""
        return torch.stack([actor.pose.raw_pose for actor in self.objects], dim=1)

    def target_asset(self, env: int = 0) -> LoadedObject:
        """The target's asset in one env."""
        return self.object_assets[env][int(self.target_slot[env])]

    def gripper_forces(self) -> torch.Tensor:
        """(N, 3, K, 3) N: force of each object on left finger, right finger and hand, world frame."""
        bodies = [self.agent.finger1_link, self.agent.finger2_link, self.agent.robot.links_map[HAND_LINK]]
        return contact_forces(self.scene, bodies, self.objects)

    def grasped(self, forces: torch.Tensor | None = None) -> torch.Tensor:
        """(N, K) bool: which objects both fingers hold right now.

        Args:
            forces: of ``gripper_forces``, if they are known already.
        """
        forces = self.gripper_forces() if forces is None else forces
        y = torch.tensor([[0.0, 1.0, 0.0]], device=self.device).expand(self.num_envs, 3)
        # the left finger opens along its own +y
        return terms.finger_grasps(forces[:, 0], forces[:, 1], terms.rotate(self.agent.finger1_link.pose.q, y))

    def target_measures(self) -> dict[str, torch.Tensor]:
        """Conditions of success that have to hold at the same moment, (N,) bool each; for reports."""
        raise NotImplementedError

    def get_language_instruction(self) -> list[str]:
        """The instruction of each env."""
        raise NotImplementedError

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        """Nothing in visual modes; in state modes what only a simulator knows."""
        if not self.obs_mode_struct.state and self.obs_mode not in {"state", "state_dict"}:
            return {}
        return {
            "object_poses": self.object_poses.flatten(1),
            "target": torch.nn.functional.one_hot(self.target_slot, len(self.objects)).float(),
            "basket_pose": self.fixtures.basket.pose.raw_pose,
        }


def _raw_poses(matrices: np.ndarray) -> np.ndarray:
    """(n, 4, 4) -> (n, 7) float32: position, quaternion wxyz."""
    xyzw = Rotation.from_matrix(matrices[:, :3, :3]).as_quat()
    return np.concatenate([matrices[:, :3, 3], xyzw[:, [3, 0, 1, 2]]], axis=1).astype(np.float32)
