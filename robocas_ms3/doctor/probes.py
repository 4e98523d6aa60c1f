"""Probes of libraries that may crash; this file runs as a program in its own process.

``python probes.py NAME`` prints one line (a device or version) and exits with status 0. If the probe fails, the last
line on stderr is the error, and the exit status is 1. If the machine has no such device, the exit status is 3.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

ABSENT = 3


class MissingDevice(Exception):
    """The machine lacks the device of a probe."""


def render() -> str:
    """Open the render device that SAPIEN chooses; return the name of the device."""
    from sapien import render as sapien_render

    return sapien_render.RenderSystem().device.name


def physx_cpu() -> str:
    """Let a box fall for 0.1 s on the CPU; raise RuntimeError if it does not fall 5 cm."""
    import sapien

    scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    scene.set_timestep(0.01)
    box = _add_falling_box(scene)
    for _ in range(10):
        scene.step()
    fallen = 1.0 - float(box.pose.p[2])
    if not 0.04 < fallen < 0.06:  # 0.5 g t^2 = 4.9 cm; the integrator gives 5.4 cm
        raise RuntimeError(f"a box fell {fallen:.3f} m in 0.1 s (expected 0.04 to 0.06 m)")
    return "ok"


def physx_cuda() -> str:
    """Let a box fall for 0.1 s on the GPU; raise RuntimeError if it does not fall 5 cm."""
    import torch

    if not torch.cuda.is_available():
        raise MissingDevice("no CUDA device that this build of torch can use")
    import sapien

    sapien.physx.enable_gpu()
    system = sapien.physx.PhysxGpuSystem("cuda")
    scene = sapien.Scene([system])
    system.timestep = 0.01
    system.set_scene_offset(scene, [0, 0, 0])
    _add_falling_box(scene)
    system.gpu_init()
    for _ in range(10):
        system.step()
    system.gpu_fetch_rigid_dynamic_data()
    fallen = 1.0 - float(system.cuda_rigid_body_data.torch()[0, 2])
    if not 0.04 < fallen < 0.06:
        raise RuntimeError(f"a box fell {fallen:.3f} m in 0.1 s (expected 0.04 to 0.06 m)")
    return torch.cuda.get_device_name()


def planner() -> str:
    """Write the URDF files of the robot, create the planner and plan a short motion."""
    import numpy as np

    from robocas_ms3.planning.rrt_connect import RRTConnectPlanner
    from robocas_ms3.robots.registry import find_robot

    robot = find_robot(None)
    files = robot.files()
    planner = RRTConnectPlanner(files.arm_urdf, files.arm_srdf, robot=robot.description, dt=0.05)
    start = np.asarray(robot.description.arm_rest, dtype=np.float64)
    path = planner.plan_to_qpos(start, [start + 0.2], stage="doctor")
    return f"planned a path of {len(path.qpos)} steps"


def packs() -> str:
    """Load all asset packs."""
    from robocas_ms3.assets.pack import find_packs, load_pack
    from robocas_ms3.core.text import format_count

    loaded = [load_pack(name) for name in find_packs()]
    if not any(pack.name == "builtin" for pack in loaded):
        raise RuntimeError("the builtin pack is not installed")
    return ", ".join(f"{pack.name} ({format_count(len(pack.objects), 'object')})" for pack in loaded)


def _add_falling_box(scene):
    import sapien

    builder = scene.create_actor_builder()
    builder.add_box_collision(half_size=[0.05, 0.05, 0.05])
    builder.initial_pose = sapien.Pose([0, 0, 1])
    return builder.build(name="box")


PROBES = {probe.__name__: probe for probe in (render, physx_cpu, physx_cuda, planner, packs)}


def _main() -> int:
    # Python puts the folder of this file first on the path. Replace it by the parent of the package, last, so that a
    # clone that is not installed can be imported.
    sys.path.pop(0)
    sys.path.append(str(Path(__file__).resolve().parents[2]))
    # Output of libraries goes to stderr; stdout has only the line of the probe.
    stdout = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    try:
        found = PROBES[sys.argv[1]]()
    except MissingDevice as error:
        sys.stderr.write(f"{error}\n")
        return ABSENT
    except Exception as error:  # any error is the result of the probe
        from robocas_ms3.core.text import escape_controls

        sys.stderr.write(escape_controls(f"{type(error).__name__}: {' '.join(str(error).split())}") + "\n")
        return 1
    stdout.write(found + "\n")
    stdout.flush()
    return 0


if __name__ == "__main__":
    exit_code = _main()
    from robocas_ms3.core.signals import exit_immediately

    exit_immediately(exit_code)  # skips destructors of libraries, which may crash
