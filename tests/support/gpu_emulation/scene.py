"""Replaces the GPU parts of SAPIEN and ManiSkill: physics, indices of bodies, devices and rendering."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.envs import sapien_env
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.envs.utils.system.backend import BackendInfo, parse_sim_and_render_backend
from sapien import physx

from gpu_emulation import has_emulated_tensors
from gpu_emulation.buffers import Buffer
from gpu_emulation.device_copies import CudaTensorSystem
from gpu_emulation.physics import EmulatedGpuSystem

_Scene = sapien.Scene


class EmulatedScene(_Scene):
    """Scene of one env with a CPU system, which reports the emulated GPU system as its own."""

    def __init__(self, systems: Sequence[Any] | None = None) -> None:
        self.gpu_system: EmulatedGpuSystem | None = None
        for system in systems or ():
            if isinstance(system, EmulatedGpuSystem):
                self.gpu_system = system
        if self.gpu_system is None:
            super().__init__(systems)
        else:
            super().__init__([self.gpu_system.add_env() if s is self.gpu_system else s for s in systems or ()])

    @property
    def physx_system(self) -> Any:
        return super().physx_system if self.gpu_system is None else self.gpu_system


class EmulatedDevice:
    """Stand-in for ``sapien.Device("cuda")``."""

    name, cuda_id = "emulated", 0

    def is_cuda(self) -> bool:
        return True

    def is_cpu(self) -> bool:
        return False

    def can_render(self) -> bool:
        return False


class EmulatedCameraGroup:
    """Stand-in for ``RenderCameraGroup``: cameras that render one after the other."""

    def __init__(self, cameras: Sequence[Any]) -> None:
        self._cameras = cameras

    def take_picture(self) -> None:
        for camera in self._cameras:
            camera.take_picture()

    def get_picture_cuda(self, name: str) -> Buffer:
        return Buffer(np.stack([camera.get_picture(name) for camera in self._cameras]))


class EmulatedRenderSystemGroup:
    """Stand-in for ``RenderSystemGroup``; it renders the poses of the CPU systems."""

    def __init__(self, scenes: Sequence[_Scene]) -> None:
        self._scenes = scenes

    def update_render(self) -> None:
        for scene in self._scenes:
            scene.update_render()

    def create_camera_group(self, cameras: Sequence[Any], names: Sequence[str]) -> EmulatedCameraGroup:
        return EmulatedCameraGroup(cameras)


def install() -> None:
    """Replace the GPU parts of SAPIEN and ManiSkill in this process."""
    physx.PhysxGpuSystem = EmulatedGpuSystem if has_emulated_tensors() else CudaTensorSystem
    physx.enable_gpu = lambda: None  # SAPIEN's downloads NVIDIA's library
    sapien.Scene = EmulatedScene
    body_row = property(_body_row)
    physx.PhysxRigidDynamicComponent.gpu_index = body_row
    physx.PhysxRigidDynamicComponent.gpu_pose_index = body_row
    physx.PhysxArticulationLinkComponent.gpu_pose_index = property(_link_row)
    physx.PhysxArticulation.gpu_index = property(_articulation_row)
    sapien.render.RenderCameraComponent.set_gpu_pose_batch_index = lambda self, index: None
    ManiSkillScene._sapien_setup_gpu_rendering = _set_up_rendering
    sapien_env.parse_sim_and_render_backend = _parse_backends


def _system_of(component: Any) -> EmulatedGpuSystem | None:
    system = component.entity.scene.gpu_system
    return system if system is not None and system.ready else None


def _body_row(body: Any) -> int:
    system = _system_of(body)
    if system is None:
        raise RuntimeError("the body is not added to a GPU scene")
    return system.body_rows[body]


def _link_row(link: Any) -> int:
    system = _system_of(link)
    return -1 if system is None else system.link_rows[link]  # as SAPIEN's on a CPU


def _articulation_row(articulation: Any) -> int:
    system = _system_of(articulation.links[0])
    return -1 if system is None else system.articulation_rows[articulation]


def _set_up_rendering(scene: Any) -> None:
    scene.render_system_group = EmulatedRenderSystemGroup(scene.sub_scenes)


def _parse_backends(sim_backend: str, render_backend: str) -> BackendInfo:
    if not sim_backend.startswith(("physx_cuda", "cuda", "gpu")):
        return parse_sim_and_render_backend(sim_backend, render_backend)
    info: Any = parse_sim_and_render_backend("physx_cpu", render_backend)
    info.device, info.sim_device, info.sim_backend = torch.device("cuda"), EmulatedDevice(), "physx_cuda"
    return info
