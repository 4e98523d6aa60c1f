"""The base environment of all tasks: move the target in the scene of a task configuration to a goal."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, cast

import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.utils.randomization.batched_rng import BatchedRNG
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs.types import SimConfig
from numpy.typing import NDArray

from robocas_ms3.assets.pack import LoadedObject, VisualLevel, load_pack
from robocas_ms3.core.arrays import Array, as_tensor
from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.extensions import load_object
from robocas_ms3.robots.agent import MobileManipulator
from robocas_ms3.robots.registry import DEFAULT_ROBOT, find_robot
from robocas_ms3.scenes import build
from robocas_ms3.scenes.cache import make_layout_source
from robocas_ms3.scenes.config import TaskConfig, load_config_for
from robocas_ms3.scenes.language.instructions import Instruction, episode_instruction
from robocas_ms3.scenes.layout import Layout, LayoutSource
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.task_specs import TaskSpec
from robocas_ms3.tasks import engine
from robocas_ms3.tasks.bodies import Bodies, Contacts, link_poses
from robocas_ms3.tasks.goals import Goal, InBasket
from robocas_ms3.tasks.initial_states import set_initial_states
from robocas_ms3.tasks.observations import over_the_shoulder, place_camera, privileged_observations
from robocas_ms3.tasks.rewards import DENSE, TRANSFER, DenseReward, RewardTable, count_fraction
from robocas_ms3.tasks.seeds import EpisodeSeeds, check_reset_options
from robocas_ms3.tasks.success import SuccessCheck

STAGES = ("reached_any", "picked_any", "reached_target", "target_grasped", "target_lifted", "target_in_basket")


class RoboCASEnv(BaseEnv):
    """Base class of all tasks: move the target to the ``GOAL``, by default the basket.

    A task is a subclass with a ``SPEC``. It may override ``evaluate``, ``reward_progress`` and
    ``privileged_observations``. N envs, K object slots. A single env is rebuilt at each reset. Several envs draw their
    objects when they are built; each reset draws a new layout and target.

    Args:
        config: name, path or content of a task configuration; default: the task's default configuration.
        pack: name or folder of the object pack.
        furniture_pack: name or folder of the pack of room, furniture and basket.
        visual_level: level of detail of the rendered meshes, ``fast`` or ``full``.
        layouts: source of the layouts; see `scenes.cache.make_layout_source`.
        seeds: least and greatest seed of unseeded resets; see `EpisodeSeeds`.
        robot_uids: name of the robot in `robots.registry`.
        num_envs: N; more than 1 needs a GPU.
        kwargs: arguments of ``BaseEnv``; ``reconfiguration_freq`` defaults to 1 for one env and 0 for several.

    Raises:
        VectorEnvError: several envs were requested without a GPU.
        ConfigError: an argument is invalid.
        ExtensionError: the robot is unknown, or can't be loaded.

    Attributes:
        present: (N, K) bool, which object slots are used.
        target_slot: (N,) slot of the target.
        is_target: (N, K) bool, the same as flags.
        start_poses: (N, K, 7) object poses at the start of the episode.
        basket_start_poses: (N, 7) basket poses at the start of the episode.
        renders_images: whether visual observations are rendered; otherwise images are zero.
    """

    SPEC: ClassVar[TaskSpec]
    STAGES: ClassVar[tuple[str, ...]] = STAGES
    GOAL: ClassVar[type[Goal]] = InBasket
    REWARDS: ClassVar[RewardTable] = TRANSFER
    SUPPORTED_REWARD_MODES = ("sparse", *DENSE, "none")  # the first is the default

    agent: MobileManipulator
    renders_images = True

    def __init__(
        self,
        config: str | Path | dict | TaskConfig | None = None,
        pack: str | Path = "builtin",
        furniture_pack: str | Path = "builtin",
        visual_level: VisualLevel = "fast",
        layouts: str | Path | LayoutSource | None = "auto",
        seeds: tuple[int, int] | None = None,
        robot_uids: str | None = DEFAULT_ROBOT,
        num_envs: int = 1,
        **kwargs: Any,
    ) -> None:
        engine.check_engine(num_envs, visual_level, **kwargs)
        self.task_config = load_config_for(self.SPEC, config)
        self.robot_spec = find_robot(robot_uids, where="robot_uids")
        load_object(self.robot_spec.agent)  # registers it with ManiSkill
        robot = self.robot_spec.description
        self.cameras = self.task_config.cameras_of(robot)
        self.model = SceneModel.load(self.task_config, load_pack(pack), load_pack(furniture_pack), robot=robot)
        self._visual_level: VisualLevel = visual_level
        self._resets = 0
        self._engine_errors = engine.EngineErrors()
        if kwargs.get("reconfiguration_freq") is None:
            kwargs["reconfiguration_freq"] = 1 if num_envs == 1 else 0
        cache, stay = make_layout_source(self.model, layouts), kwargs["reconfiguration_freq"] == 0
        self.seeds = EpisodeSeeds(num_envs, cache, seed_range=seeds, objects_stay=stay)
        super().__init__(num_envs=num_envs, robot_uids=robot.uid, **kwargs)

    @property
    def _default_sim_config(self) -> SimConfig:
        return engine.sim_config(self.num_envs, self.task_config)

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        pose = sapien_utils.look_at(*(point.tolist() for point in self.overview()))
        return CameraConfig("render_camera", pose, 640, 480, np.pi / 3, 0.01, 20)

    def overview(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the position of the overview camera and the point at which it looks, (3,) each, world, m."""
        return over_the_shoulder(self.model)

    def _setup_sensors(self, options: dict) -> None:
        super()._setup_sensors(options)
        sensors = cast("dict[str, Any]", self._sensors)
        build.shift_cameras([sensors[spec.name].camera for spec in self.cameras], self.task_config, self.scene_seeds)

    @property
    def scene_seeds(self) -> list[int]:
        """Seed of each env's appearance, which stays the same until the scene is rebuilt."""
        return [int(seed) for seed in cast("NDArray[np.int64]", self._episode_seed)]

    def _reconfigure(self, options: dict | None = None) -> None:
        seeds = cast("NDArray[np.int64]", self._episode_seed)
        self.seeds.choose_objects(seeds, self.device, on_gpu=self._sim_device.is_cuda())
        engine.keep_renderer(self.backend.render_device)
        super()._reconfigure(options)

    def _clear(self) -> None:
        self._resets += 1
        on_gpu = self.num_envs > 1 or self._sim_device.is_cuda()
        if on_gpu or engine.is_collection_due(self.backend.render_device, self._resets):
            super()._clear()
        else:  # without ManiSkill's garbage collection, which takes 0.14 s
            self._close_viewer()
            self._sensors, self._human_render_cameras, self._hidden_objects = {}, {}, []
            self.agent = self.scene = None  # pyright: ignore[reportAttributeAccessIssue]

    def close(self) -> None:
        self._resets = -1  # collects garbage
        self._engine_errors.close()
        super().close()

    def _load_agent(self, options: dict, *args: Any, **kwargs: Any) -> None:
        super()._load_agent(options, sapien.Pose(self.model.robot_pose))
        self.agent.cameras = tuple(place_camera(camera, self.overview()) for camera in self.cameras)

    def _load_scene(self, options: dict) -> None:
        self.fixtures = build.build_fixtures(self.scene, self.model, self._visual_level, self.scene_seeds)
        assets, ids = self.model.object_pack.objects, self.seeds.object_ids
        self.object_assets: list[list[LoadedObject]] = [[assets[i] for i in row] for row in ids]
        self.objects = build.build_objects(self.scene, self.task_config, self.object_assets, self._visual_level)
        slots = len(self.objects)
        self.start_poses = torch.zeros(self.num_envs, slots, 7, device=self.device)
        self.present = torch.ones(self.num_envs, slots, dtype=torch.bool, device=self.device)
        self.target_slot = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self.is_target = torch.zeros_like(self.present)
        self.basket_start_poses = torch.zeros(self.num_envs, 7, device=self.device)
        self.dense_reward = DenseReward(self.REWARDS, self.num_envs, self.device)
        self.goal = self.GOAL(self)
        self.success_check = SuccessCheck(self, self.STAGES)

    def _load_lighting(self, options: dict) -> None:
        build.build_lights(self.scene, self.task_config, self.scene_seeds, shadow=self.enable_shadow)

    def _after_reconfigure(self, options: dict) -> None:
        super()._after_reconfigure(options)
        if self.gpu_sim_enabled:
            self._engine_errors.open()
        self.bodies = Bodies(self.scene, self.agent.robot, self.objects, self.fixtures.basket)
        gripper = [self.agent.finger1_link, self.agent.finger2_link, self.agent.hand_link]
        self.gripper_contacts = Contacts(self.scene, gripper, self.objects)

    def reset(self, seed: int | list[int] | None = None, options: dict | None = None) -> tuple[Any, dict]:
        """Reset all envs or those of ``options["env_idx"]``; a seed always gives the same layout.

        Args:
            seed: seed of each env; for a single seed, the first env gets it and the others get the next seeds within
                the range of seeds. None: each env draws a seed.
            options: options of ``BaseEnv.reset``.

        Raises:
            LayoutError: a requested seed, or each of many drawn seeds, has no layout.
            RobocasError: ``options`` has ``reset_to_env_states``.
        """
        options, envs = check_reset_options(options, self.num_envs, self.device)
        seed = self.seeds.start_reset(seed, envs)
        while True:
            try:
                return super().reset(seed, options)
            except LayoutError as error:
                if not self.seeds.retry_reset(error):
                    raise
                seed = None

    def _set_episode_rng(self, seed: Any, env_idx: torch.Tensor) -> None:
        envs = env_idx.cpu().numpy()
        seeds: Any = None if seed is None else self.seeds.within_range(seed)
        if seeds is None or self._batched_episode_rng is None or len(envs) == self.num_envs:
            super()._set_episode_rng(seeds, env_idx)
        else:  # ManiSkill's would seed all envs
            if len(seeds) == 1 and len(envs) > 1:
                seeds = np.concatenate([seeds, np.random.RandomState(seeds[0]).randint(2**31, size=len(envs) - 1)])
            self._episode_seed[envs] = seeds
            self._batched_episode_rng[envs] = BatchedRNG.from_seeds(seeds, backend=self._batched_rng_backend)
        drawn = None if seeds is None else self._episode_seed[envs]
        self.seeds.set_layout_seeds(envs, drawn, self._batched_episode_rng)

    def _clear_sim_state(self) -> None:
        if not self.gpu_sim_enabled:
            super()._clear_sim_state()
        else:
            self.bodies.stop(self.scene._reset_mask.nonzero()[:, 0])
            self.scene._gpu_apply_all()
            self.scene._gpu_fetch_all()

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self._engine_errors.check()
        set_initial_states(self, self.seeds.find_initial_states(env_idx.cpu().numpy(), self.device), env_idx)
        self.success_check.reset(env_idx)
        self.dense_reward.reset(env_idx)

    def layout(self, env: int = 0) -> Layout:
        return self.seeds.layout(env)

    def get_state_dict(self) -> dict:
        """Return the state of all bodies in ManiSkill's format, and `extra_state`."""
        return {**self.bodies.split(self.bodies.read().clone()), **self.extra_state()}

    def extra_state(self) -> dict:
        """Return the targets of the controllers, and the reached ``stages`` (N, stages) bool."""
        task = {"stages": self.success_check.reached.T.clone()}
        return {"controller": self.agent.controller.targets(), "task": task}

    def set_state_dict(self, state: dict, env_idx: torch.Tensor | None = None) -> None:
        """Set the state of some envs.

        Args:
            state: a state of `get_state_dict`. Without controller targets, the next action starts from the robot's
                pose. Without stages, the reached stages stay unchanged.
            env_idx: indices of the envs; None: all envs.
        """
        super().set_state_dict(state, cast("torch.Tensor", env_idx))
        self.agent.controller.set_targets(state.get("controller"), env_idx)
        envs = slice(None) if env_idx is None else env_idx
        self.success_check.restore(state.get("task", {}).get("stages"), envs)
        self.dense_reward.reset(envs)

    @property
    def object_states(self) -> torch.Tensor:
        """(N, K, 13) states of the objects (`bodies.BODY`); read only."""
        return self.bodies.objects(self.bodies.read())

    @property
    def object_poses(self) -> torch.Tensor:
        """(N, K, 7) poses of the objects in the world: position m, quaternion wxyz."""
        return self.object_states[..., :7].clone()

    @property
    def basket_pose(self) -> torch.Tensor:
        """(N, 7) pose of the basket in the world; read only. The scene must have a basket."""
        pose = self.bodies.basket(self.bodies.read())
        assert pose is not None, "there is no basket in this scene"
        return pose

    def tcp_in_world(self) -> Array:
        """Return the TCP pose (N, 7) in the world frame as a native array (`core.arrays`)."""
        return link_poses(self.scene, [self.agent.tcp])[:, 0]

    def target_center(self, objects: Array) -> Array:
        return self.success_check.target_center(objects)

    def target_asset(self, env: int = 0) -> LoadedObject:
        return self.object_assets[env][int(self.target_slot[env])]

    def gripper_forces(self) -> torch.Tensor:
        """Return forces (N, 3, K, 3), N, world frame, of objects on left finger, right finger and hand."""
        return as_tensor(self.gripper_contacts.forces())

    def grasped(self) -> torch.Tensor:
        """Return (N, K) bool, which objects both fingers hold."""
        return as_tensor(self.success_check.grasped(self.gripper_contacts.forces()))

    def step(self, action: Any) -> tuple[Any, torch.Tensor, torch.Tensor, torch.Tensor, dict]:
        """Execute an action; see ``BaseEnv``.

        Raises:
            SimulationError: PhysX ran out of memory on the GPU and dropped contacts.
        """
        self._engine_errors.check()
        plain = self._obs_mode == "none" and self._reward_mode == "none" and isinstance(action, np.ndarray)
        # without observation and reward, BaseEnv.step has an overhead on a CPU
        if not plain or self.gpu_sim_enabled or action.shape != self._orig_single_action_space.shape:
            return super().step(action)
        engine.step_without_observation(self, action)
        info, self._last_obs = self.get_info(), {}
        return {}, torch.zeros(1), info["success"] | info["fail"], torch.zeros(1, dtype=torch.bool), info

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Return stages, ``success`` and ``fail`` (N,) bool, and ``disturbed`` (N,) int; see docs/tasks.md."""
        return self.success_check.check()

    def success_conditions(self) -> dict[str, torch.Tensor]:
        return self.success_check.success_conditions()

    def instruction(self, env: int = 0, target: str = "") -> Instruction:
        """Return the instruction of an env.

        Args:
            env: index of the env.
            target: another name for the target; default: the name of its asset.
        """
        name, seed = target or self.target_asset(env).asset.name, int(self.seeds.layout_seeds[env])
        return episode_instruction(self.task_config, self.layout(env), seed, name, self.object_names(env))

    def object_names(self, env: int = 0) -> set[str]:
        present = self.layout(env).present
        return {asset.asset.name for asset, used in zip(self.object_assets[env], present, strict=True) if used}

    def get_language_instruction(self) -> list[str]:
        return [self.instruction(env).text for env in range(self.num_envs)]

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        mode = self.obs_mode_struct
        privileged = self.privileged_observations() if mode.state or mode.state_dict else {}
        return {**privileged, "tcp_pose": as_tensor(self.tcp_in_world())}

    def privileged_observations(self) -> dict[str, torch.Tensor]:
        """Return the privileged observations, (N, D) each, in the order of the flat state; see docs/rl.md."""
        return privileged_observations(self)

    def _get_obs_sensor_data(self, apply_texture_transforms: bool = True) -> dict:
        last = self._last_obs.get("sensor_data") if isinstance(self._last_obs, dict) else None
        if self.renders_images or last is None:  # None: point clouds, which are computed from images
            return super()._get_obs_sensor_data(apply_texture_transforms)
        return {camera: {kind: torch.zeros_like(of) for kind, of in kinds.items()} for camera, kinds in last.items()}

    def get_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        if self._reward_mode == "progress":
            reward = self.dense_reward.increase(self.compute_normalized_dense_reward(obs, action, info))
        else:
            reward = super().get_reward(obs, action, info)
        if self._reward_mode in DENSE and action is not None:
            self.dense_reward.store_action(action)
        return reward

    def compute_sparse_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return info["success"].float()

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """Return the reward (N,) in [0, ``REWARDS.total``]; add ``reward_terms`` to the info."""
        state = self.success_check.state
        penalties = {"disturbed": count_fraction(state.disturbed.sum(1)), **self.goal.penalties(state)}
        return self.dense_reward.compute(self.reward_progress(), penalties, action, info)

    def reward_progress(self) -> tuple[Array, dict[str, Array]]:
        """Return the stage and the reward terms of each env; see `Goal.progress`."""
        return self.goal.progress(self.success_check.state, self.success_check.stages["target_lifted"], self.REWARDS)

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return self.compute_dense_reward(obs, action, info) / self.REWARDS.total
