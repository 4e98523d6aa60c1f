"""The scene of an environment: building it, resetting it from a layout, its states and its images."""

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
from robocas_ms3.core.arrays import Array
from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.extensions import import_object
from robocas_ms3.core.poses import from_wxyz
from robocas_ms3.robots.agent import MobileManipulator
from robocas_ms3.robots.camera_models import OPENCV_IN_SAPIEN, CameraModel, find_mount_in_parent
from robocas_ms3.robots.registry import DEFAULT_ROBOT, find_robot
from robocas_ms3.scenes import build
from robocas_ms3.scenes.cache import make_layout_source
from robocas_ms3.scenes.config import TaskConfig, load_config_for
from robocas_ms3.scenes.layout import Layout, LayoutSource
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.randomise import draw_camera_shifts
from robocas_ms3.scenes.task_specs import TaskSpec
from robocas_ms3.tasks import engine
from robocas_ms3.tasks.bodies import BodyStateReader, read_link_poses
from robocas_ms3.tasks.initial_states import set_initial_states
from robocas_ms3.tasks.observations import over_shoulder_viewpoint, place_overview_camera
from robocas_ms3.tasks.seeds import EpisodeSeeds, parse_reset_options


class SceneEnv(BaseEnv):
    """Environment with the scene of a task configuration, without success, rewards and instructions.

    There are N envs with K object slots each. A single env is built again at each reset. Several envs draw their
    objects when they are built, and each reset draws a new layout and target.

    Args:
        config: name, path or content of a task configuration; None: the task's default configuration.
        pack: name or folder of the object pack.
        furniture_pack: name or folder of the pack that has room, furniture and basket.
        visual_level: level of detail of the rendered meshes, ``fast`` or ``full``.
        layouts: source of the layouts (`scenes.cache.make_layout_source`): ``auto`` for the user's layout cache,
            another folder of layout caches, None for no cache, a ``.npy`` file of frozen layouts, or a function.
        seeds: least and greatest seed of resets without a seed (`EpisodeSeeds`).
        robot_uids: name of the robot in `robots.registry`.
        num_envs: N; more than 1 needs a GPU.
        kwargs: arguments of ``BaseEnv``; ``reconfiguration_freq`` defaults to 1 for one env and 0 for several envs.

    Raises:
        VectorEnvError: ``num_envs`` is greater than 1 without a GPU.
        ConfigError: an argument is invalid.
        ExtensionError: the robot is unknown, or can't be loaded.

    Attributes:
        task_config: the task configuration.
        model: geometry of the scene.
        objects: K actors, by slot.
        object_assets: assets of the objects of each env, by slot.
        seeds: objects seeds, layout seeds and layouts of the envs.
        present: (N, K) bool, whether each slot has an object.
        target_slot: (N,) slot of the target.
        is_target: (N, K) bool, whether each object is the target.
        start_poses: (N, K, 7) world poses of the objects at the start of the episode.
        basket_start_poses: (N, 7) world poses of the basket at the start of the episode.
        camera_shifts: (N, C, 4, 4) random motions of the cameras in their frames (SAPIEN: x forward, y left, z up).
        observes_images: whether observations have images and camera parameters; `render_images` works without.
        observes_privileged_state: whether observations in a state mode have the privileged observations.
    """

    SPEC: ClassVar[TaskSpec]

    agent: MobileManipulator
    observes_images = True
    observes_privileged_state = True

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
        engine.check_engine_arguments(num_envs, visual_level, **kwargs)
        self.task_config = load_config_for(self.SPEC, config)
        self.robot_spec = find_robot(robot_uids, where="robot_uids")
        import_object(self.robot_spec.agent)  # registers it with ManiSkill
        robot = self.robot_spec.description
        self.cameras = self.task_config.cameras_of(robot)
        self.model = SceneModel.load(self.task_config, load_pack(pack), load_pack(furniture_pack), robot=robot)
        self._visual_level: VisualLevel = visual_level
        self._resets = 0
        self._engine_error_monitor = engine.EngineErrorMonitor()
        if kwargs.get("reconfiguration_freq") is None:
            kwargs["reconfiguration_freq"] = 1 if num_envs == 1 else 0
        cache, stay = make_layout_source(self.model, layouts), kwargs["reconfiguration_freq"] == 0
        self.seeds = EpisodeSeeds(num_envs, cache, seed_range=seeds, objects_stay=stay)
        super().__init__(num_envs=num_envs, robot_uids=robot.uid, **kwargs)

    @property
    def _default_sim_config(self) -> SimConfig:
        return engine.make_sim_config(self.num_envs, self.task_config)

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        pose = sapien_utils.look_at(*(point.tolist() for point in self.overview_viewpoint()))
        return CameraConfig("render_camera", pose, 640, 480, np.pi / 3, 0.01, 20)

    def overview_viewpoint(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the position of the overview camera and the point it looks at, (3,) each, world frame, m."""
        return over_shoulder_viewpoint(self.model)

    def _setup_sensors(self, options: dict) -> None:
        super()._setup_sensors(options)
        sensors = cast("dict[str, Any]", self._sensors)
        if self.task_config.randomisation.cameras is not None:
            build.shift_cameras([sensors[spec.name].camera for spec in self.cameras], self.camera_shifts)

    @property
    def appearance_seeds(self) -> list[int]:
        """Seed of the appearance of each env; it changes only when the scene is built again."""
        return [int(seed) for seed in cast("NDArray[np.int64]", self._episode_seed)]

    def _reconfigure(self, options: dict | None = None) -> None:
        seeds = cast("NDArray[np.int64]", self._episode_seed)
        self.seeds.choose_objects(seeds, self.device, on_gpu=self._sim_device.is_cuda())
        engine.keep_render_system(self.backend.render_device)
        super()._reconfigure(options)

    def _clear(self) -> None:
        self._resets += 1
        on_gpu = self.num_envs > 1 or self._sim_device.is_cuda()
        if on_gpu or engine.is_garbage_collection_due(self.backend.render_device, self._resets):
            super()._clear()
        else:  # without ManiSkill's garbage collection, which takes 0.14 s
            self._close_viewer()
            self._sensors, self._human_render_cameras, self._hidden_objects = {}, {}, []
            self.agent = self.scene = None  # pyright: ignore[reportAttributeAccessIssue]

    def close(self) -> None:
        self._resets = -1  # `_clear` then collects garbage
        self._engine_error_monitor.close()
        super().close()

    def _load_agent(self, options: dict, *args: Any, **kwargs: Any) -> None:
        super()._load_agent(options, sapien.Pose(self.model.robot_pose))
        self.agent.cameras = tuple(place_overview_camera(camera, self.overview_viewpoint()) for camera in self.cameras)

    def _load_scene(self, options: dict) -> None:
        self.camera_shifts = draw_camera_shifts(self.task_config, len(self.cameras), self.appearance_seeds)
        self.fixtures = build.build_fixtures(self.scene, self.model, self._visual_level, self.appearance_seeds)
        assets, ids = self.model.object_pack.objects, self.seeds.object_ids
        self.object_assets: list[list[LoadedObject]] = [[assets[i] for i in row] for row in ids]
        self.objects = build.build_objects(self.scene, self.task_config, self.object_assets, self._visual_level)
        slots = len(self.objects)
        self.start_poses = torch.zeros(self.num_envs, slots, 7, device=self.device)
        self.present = torch.ones(self.num_envs, slots, dtype=torch.bool, device=self.device)
        self.target_slot = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self.is_target = torch.zeros_like(self.present)
        self.basket_start_poses = torch.zeros(self.num_envs, 7, device=self.device)

    def _load_lighting(self, options: dict) -> None:
        build.build_lights(self.scene, self.task_config, self.appearance_seeds, shadow=self.enable_shadow)

    def _after_reconfigure(self, options: dict) -> None:
        super()._after_reconfigure(options)
        if self.gpu_sim_enabled:
            self._engine_error_monitor.open()
        self.bodies = BodyStateReader(self.scene, self.agent.robot, self.objects, self.fixtures.basket)

    def reset(self, seed: int | list[int] | None = None, options: dict | None = None) -> tuple[Any, dict]:
        """Reset all envs, or only the envs ``options["env_idx"]``; a seed always gives the same layout.

        Args:
            seed: seed of each env. A single seed is for the first env; the other envs get the next seeds, which wrap
                around in the range of seeds if the seed is in it. None: each env draws a seed.
            options: options of ``BaseEnv.reset``.

        Raises:
            LayoutError: a requested seed has no layout, or none of many drawn seeds has one.
            RobocasError: ``options`` contains ``reset_to_env_states``.
        """
        options, envs = parse_reset_options(options, self.num_envs, self.device)
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
        seeds: Any = None if seed is None else self.seeds.map_to_range(seed)
        if seeds is None or self._batched_episode_rng is None or len(envs) == self.num_envs:
            super()._set_episode_rng(seeds, env_idx)
        else:  # ManiSkill's method would seed all envs
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
            self.bodies.zero_velocities(self.scene._reset_mask.nonzero()[:, 0])
            self.scene._gpu_apply_all()
            self.scene._gpu_fetch_all()

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self._engine_error_monitor.check()
        set_initial_states(self, self.seeds.find_initial_states(env_idx.cpu().numpy(), self.device), env_idx)

    def layout(self, env: int = 0) -> Layout:
        """Return the layout of the current episode in env number ``env``."""
        return self.seeds.layout(env)

    def get_state_dict(self) -> dict:
        """Return the states of all bodies in ManiSkill's format, together with `extra_state`."""
        return {**self.bodies.to_state_dict(self.bodies.read().clone()), **self.extra_state()}

    def extra_state(self) -> dict:
        """Return state that ManiSkill's state dictionary lacks: the last commanded pose of the controllers."""
        return {"controller": self.agent.controller.targets()}

    def set_state_dict(self, state: dict, env_idx: torch.Tensor | None = None) -> None:
        """Set the state of some envs.

        Args:
            state: a state of `get_state_dict`. Without ``controller``, the next action starts from the robot's pose.
            env_idx: indices of the envs; None: all envs.
        """
        super().set_state_dict(state, cast("torch.Tensor", env_idx))
        self.agent.controller.set_targets(state.get("controller"), env_idx)

    @property
    def object_states(self) -> torch.Tensor:
        """States (N, K, 13) of the objects (`bodies.BODY`); read only."""
        return self.bodies.object_states(self.bodies.read())

    @property
    def object_poses(self) -> torch.Tensor:
        """Poses (N, K, 7) of the objects in the world frame: position m, quaternion wxyz."""
        return self.object_states[..., :7].clone()

    @property
    def basket_pose(self) -> torch.Tensor:
        """Pose (N, 7) of the basket in the world frame; read only. The scene must have a basket."""
        pose = self.bodies.basket_pose(self.bodies.read())
        assert pose is not None, "there is no basket in this scene"
        return pose

    def tcp_in_world(self) -> Array:
        """Return the TCP pose (N, 7) in the world frame as a native array (`core.arrays`)."""
        return read_link_poses(self.scene, [self.agent.tcp])[:, 0]

    def target_asset(self, env: int = 0) -> LoadedObject:
        """Return the asset of the target in env number ``env``."""
        return self.object_assets[env][int(self.target_slot[env])]

    def object_names(self, env: int = 0) -> set[str]:
        """Return the names of all objects in env number ``env``."""
        present = self.layout(env).present
        return {asset.asset.name for asset, used in zip(self.object_assets[env], present, strict=True) if used}

    def camera_models(self) -> list[dict[str, CameraModel]]:
        """Return the intrinsics and poses of the cameras of each env, by name."""
        sensors = cast("dict[str, Any]", self._sensors)
        found: list[dict[str, CameraModel]] = [{} for _ in range(self.num_envs)]
        for number, spec in enumerate(self.agent.cameras):
            if spec.name not in sensors:
                continue
            sensor = sensors[spec.name]
            mount = find_mount_in_parent(self.robot_spec, spec.mount)
            in_parent = mount @ from_wxyz(sensor.config.pose.raw_pose[0])
            matrices = sensor.camera.get_intrinsic_matrix().cpu().numpy().astype(np.float64)
            for env, models in enumerate(found):
                models[spec.name] = CameraModel(
                    intrinsic=matrices[env][[0, 1, 0, 1], [0, 1, 2, 2]],
                    camera_in_parent=in_parent @ OPENCV_IN_SAPIEN,
                    parent=spec.parent,
                    true_camera_in_parent=in_parent @ self.camera_shifts[env, number] @ OPENCV_IN_SAPIEN,
                )
        return found

    def render_images(self) -> dict[str, dict[str, torch.Tensor]]:
        """Render the present state of all envs; return camera -> kind, such as ``rgb`` -> (N, H, W, C)."""
        return self._get_obs_sensor_data()

    def _get_obs_with_sensor_data(self, info: dict, apply_texture_transforms: bool = True) -> dict:
        if not self.observes_images:
            return self._get_obs_state_dict(info)
        return super()._get_obs_with_sensor_data(info, apply_texture_transforms)
