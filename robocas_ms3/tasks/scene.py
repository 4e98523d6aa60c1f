"""What RoboCAS environments are made of: the scene of a configuration, and where everything starts."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, cast

import numpy as np
import sapien
import torch
from mani_skill.render.utils import can_render
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs import Actor, Articulation, Pose
from mani_skill.utils.structs.types import SceneConfig, SimConfig

from robocas_ms3.assets.pack import VISUALS, LoadedObject, VisualLevel, load_pack
from robocas_ms3.assets.physics import CONTACT_OFFSET
from robocas_ms3.core.errors import ConfigError
from robocas_ms3.core.extensions import load
from robocas_ms3.robots.agent import MobileManipulator
from robocas_ms3.robots.table import DEFAULT, find_robot
from robocas_ms3.scenes import build
from robocas_ms3.scenes.bank import layout_bank
from robocas_ms3.scenes.config import TaskConfig, load_config_of
from robocas_ms3.scenes.layout import Array
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.source import LayoutSource
from robocas_ms3.scenes.task_specs import SIM_FREQ, STANDARD_FREQ, TaskSpec
from robocas_ms3.tasks.bodies import Bodies
from robocas_ms3.tasks.contacts import Contacts
from robocas_ms3.tasks.engine_errors import EngineErrors
from robocas_ms3.tasks.gpu_memory import gpu_memory
from robocas_ms3.tasks.renderer import keep_renderer
from robocas_ms3.tasks.seeds import SeededEnv
from robocas_ms3.tasks.vector.backend import check_one_process

# with a renderer what is left of a scene holds 8 MB until it is collected, without one 0.5 MB
_RESETS_PER_COLLECTION, _RESETS_PER_COLLECTION_STATE_ONLY = 20, 30
_STATIC_CAMERA_SHARE = 0.75  # of the render camera's distance, as it sees 90 deg instead of 60


class SceneEnv(SeededEnv):
    """Environment whose scene is that of a task configuration.

    Every env has its own objects and target. On a CPU (one env a process) the scene is built anew at each reset, so
    that each seed has its own objects; with several envs on a GPU the objects are drawn once, from the seeds the envs
    are built with, and each reset draws a new layout and target (``reconfiguration_freq`` changes either).

    Args:
        config: name, path or content of a task configuration; default: the task's own.
        pack: name or folder of the pack that objects come from.
        furniture_pack: the same for room, furniture and basket.
        visual_level: ``fast`` or ``full`` meshes to render.
        layouts: folder of the layout bank; default: in the cache, filled as layouts are asked for; None: no bank,
            every layout is sampled anew (the same ones, only slower); a file of frozen ones (`scenes.frozen`); or a
            function that gives the layout of an objects seed and a seed.
        seeds: least and greatest seed that unseeded resets draw from, such as those of a bank built ahead; default: any
            seed, with several envs 0 to 99.
        robot_uids: name of the robot, a row of `robots.table`.
        reconfiguration_freq: see ``BaseEnv``; default 1 for one env, 0 for several.
        kwargs: passed to ``BaseEnv``.

    Raises:
        VectorEnvError: there are several envs and no GPU.
        ExtensionError: there is no such robot, or it can't be loaded.
    """

    SPEC: ClassVar[TaskSpec]
    SUPPORTED_REWARD_MODES = ("sparse", "none")

    agent: MobileManipulator

    def __init__(
        self,
        *args: Any,
        config: str | Path | dict | TaskConfig | None = None,
        pack: str | Path = "builtin",
        furniture_pack: str | Path = "builtin",
        visual_level: VisualLevel = "fast",
        layouts: str | Path | LayoutSource | None = "auto",
        seeds: tuple[int, int] | None = None,
        robot_uids: str | None = DEFAULT,
        num_envs: int = 1,
        reconfiguration_freq: int | None = None,
        **kwargs: Any,
    ) -> None:
        check_one_process(num_envs, kwargs.get("sim_backend", "auto"))
        self.task_config = load_config_of(self.SPEC, config)
        self.robot_spec = find_robot(robot_uids, where="robot_uids")
        load(self.robot_spec.agent)  # tells ManiSkill of it
        if visual_level not in VISUALS:
            raise ConfigError("no such visual_level", expected=f"one of {list(VISUALS)}", found=visual_level)
        sees_nothing = kwargs.get("obs_mode") in {None, "none", "state", "state_dict"}
        if kwargs.get("render_backend") == "none" and not sees_nothing:
            raise ConfigError(
                "pictures need a renderer",
                where="render_backend",
                found=f'"none", with obs_mode={kwargs["obs_mode"]!r}',
                fix="Leave render_backend out.",
            )
        self.model = SceneModel.load(
            self.task_config, load_pack(pack), load_pack(furniture_pack), robot=self.robot_spec.description
        )
        self._visual_level: VisualLevel = visual_level
        self._resets = 0
        self._engine_errors: EngineErrors | None = None
        super().__init__(
            *args,
            layouts=layout_bank(self.model, layouts),
            seeds=seeds,
            robot_uids=self.robot_spec.description.uid,
            num_envs=num_envs,
            reconfiguration_freq=reconfiguration_freq,
            **kwargs,
        )

    @property
    def _default_sim_config(self) -> SimConfig:
        contacts, random = SceneConfig(contact_offset=CONTACT_OFFSET), self.task_config.randomisation
        objects = self.task_config.objects.count + (random.distractors.count[1] if random.distractors else 0)
        memory = gpu_memory(self.num_envs, objects)
        return SimConfig(
            sim_freq=SIM_FREQ,
            control_freq=STANDARD_FREQ,
            spacing=10,
            scene_config=contacts,
            gpu_memory_config=memory,
        )

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        eye, target = self.overview()
        pose = sapien_utils.look_at(eye.tolist(), target.tolist())
        return CameraConfig("render_camera", pose, 640, 480, np.pi / 3, 0.01, 20)

    def overview(self) -> tuple[Array, Array]:
        """Where to look at the task from, and at what: points (3,) in the world, m."""
        # over the robot's shoulder, from its right, at what stands on the support
        region, robot = self.model.region, self.model.robot_pose[:3, 3]
        middle = np.array([*np.add(region.min_xy, region.max_xy) / 2, region.z, 1.0])
        target = (self.model.support_pose @ middle)[:3]
        back = (robot - target)[:2] / np.linalg.norm((robot - target)[:2])
        aside = np.array([-back[1], back[0]])
        eye = target + np.append(1.05 * back + 1.2 * aside, max(1.1, 1.5 - target[2]))
        return eye, target + [0, 0, 0.05]

    # ------------------------------------------------------------------ scene

    def _clear(self) -> None:
        """Forget the scene. ManiSkill collects garbage each time, 0.14 s; here on a CPU only now and then."""
        self._resets += 1
        renders = can_render(self.backend.render_device)
        every = _RESETS_PER_COLLECTION if renders else _RESETS_PER_COLLECTION_STATE_ONLY
        if self._resets % every == 0 or self.num_envs > 1 or self._sim_device.is_cuda():
            super()._clear()
            return
        self._close_viewer()
        self.agent = None  # pyright: ignore[reportAttributeAccessIssue]
        self._sensors, self._human_render_cameras, self._hidden_objects = {}, {}, []
        self.scene = None  # pyright: ignore[reportAttributeAccessIssue]

    def _setup_scene(self) -> None:
        keep_renderer(self.backend.render_device)
        super()._setup_scene()

    def _clear_sim_state(self) -> None:
        """Stop everything in the envs that are being reset, on a GPU in two writes."""
        if not self.gpu_sim_enabled:
            super()._clear_sim_state()
            return
        self.bodies.stop(self.scene._reset_mask.nonzero()[:, 0])
        self.scene._gpu_apply_all()
        self.scene._gpu_fetch_all()

    def close(self) -> None:
        """Close the environment and free what it held."""
        self._resets = -1
        if self._engine_errors is not None:
            self._engine_errors.close()
            self._engine_errors = None
        super().close()

    def _load_agent(self, options: dict, *args: Any, **kwargs: Any) -> None:
        super()._load_agent(options, sapien.Pose(self.model.robot_pose))
        if self.task_config.static_camera == "overview":
            eye, target = self.overview()
            near = target + _STATIC_CAMERA_SHARE * (eye - target)
            self.agent.static_camera_pose = sapien_utils.look_at(near.tolist(), target.tolist()).sp

    def _load_scene(self, options: dict) -> None:
        self.fixtures = build.build_fixtures(self.scene, self.model, self._visual_level, self._scene_seeds)
        objects = self.model.object_pack.objects
        self.object_assets: list[list[LoadedObject]] = [[objects[i] for i in ids] for ids in self._object_ids]
        self.objects: list[Actor] = [
            build.build_object_slot(
                self.scene, slot, [assets[slot] for assets in self.object_assets], self._visual_level
            )
            for slot in range(len(self._object_ids[0]))
        ]
        if self.task_config.leaves_slots_empty:
            build.build_parking(self.scene, len(self.objects))
        facts = [[asset.asset for asset in assets] for assets in self.object_assets]
        self._centers_of_mass = torch.tensor(
            [[f.center_of_mass for f in row] for row in facts], dtype=torch.float32, device=self.device
        )
        self._extents = torch.tensor([[f.extents for f in row] for row in facts], dtype=torch.float32).to(self.device)
        slots = len(self.objects)
        self.start_poses = torch.zeros(self.num_envs, slots, 7, device=self.device)
        self.present = torch.ones(self.num_envs, slots, dtype=torch.bool, device=self.device)
        self.target_slot = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self.basket_at_start = torch.zeros(self.num_envs, 7, device=self.device)
        self._sideways = torch.tensor([[0.0, 1.0, 0.0]], device=self.device)

    def _after_reconfigure(self, options: dict) -> None:
        super()._after_reconfigure(options)
        if self.gpu_sim_enabled and self._engine_errors is None:
            self._engine_errors = EngineErrors()
        self.bodies = Bodies(self.scene, self.agent.robot)
        rows = [self.bodies.actors.index(actor.name) for actor in self.objects]
        assert rows == list(range(rows[0], rows[0] + len(rows))), "the objects are built one after the other"
        self._object_rows = slice(rows[0], rows[-1] + 1)
        basket = self.fixtures.basket
        self._basket_row = None if basket is None else self.bodies.actors.index(basket.name)
        gripper = [self.agent.finger1_link, self.agent.finger2_link, self.agent.hand_link]
        self._gripper_contacts = Contacts(self.scene, gripper, self.objects)

    def _load_lighting(self, options: dict) -> None:
        shadow = self.task_config.lights.shadow or self.enable_shadow
        build.build_lights(self.scene, self.task_config, self._scene_seeds, shadow=shadow)

    def _setup_sensors(self, options: dict) -> None:
        super()._setup_sensors(options)
        sensors: dict[str, Any] = dict(self._sensors)
        cameras = [sensors[name].camera for name in sorted(sensors)]
        build.shift_cameras(cameras, self.task_config, self._scene_seeds)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        if self._engine_errors is not None:
            self._engine_errors.check()
        starts = self._find_starts(env_idx.cpu().numpy())
        with torch.device(self.device):
            count = len(env_idx)
            start = self.agent.keyframes[self.task_config.robot_start].qpos
            self.agent.reset(torch.as_tensor(start, dtype=torch.float32).repeat(count, 1))
            self.agent.reset_only(env_idx)
            self.agent.robot.set_pose(cast("Any", Pose.create(starts.robot_poses)))
            for name, furniture in self.fixtures.furniture.items():
                if isinstance(furniture, Articulation):
                    positions = self.model.joint_positions(name, opened=False)
                    qpos = torch.tensor([positions.get(joint.name, 0.0) for joint in furniture.active_joints])
                    furniture.set_qpos(qpos.repeat(count, 1))
                    furniture.set_qvel(torch.zeros(count, furniture.max_dof))
            if self.fixtures.basket is not None:
                basket = Pose.create(starts.basket_poses)
                self.fixtures.basket.set_pose(basket)
                self.basket_at_start[env_idx] = basket.raw_pose
            if self.gpu_sim_enabled:
                self.bodies.put_actors(env_idx, self._object_rows, starts.object_poses)
            else:
                for slot, actor in enumerate(self.objects):
                    actor.set_pose(Pose.create(starts.object_poses[:, slot]))
            self.start_poses[env_idx] = starts.object_poses
            self.target_slot[env_idx] = starts.targets
            self._is_target = torch.nn.functional.one_hot(self.target_slot, len(self.objects)).bool()
            self.present[env_idx] = starts.present
