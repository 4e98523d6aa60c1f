"""A trajectory file of ``robocas generate`` on the page: no pictures, but recorded actions and the objects' motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.poses import inverse
from robocas_ms3.core.words import called
from robocas_ms3.datasets.sources.arrays import planar_base
from robocas_ms3.datasets.sources.provenance import succeeded, task_of
from robocas_ms3.datasets.sources.trajectory import TrajectorySource
from robocas_ms3.demos.recordings.motion import Motion
from robocas_ms3.demos.recordings.reading import Recording, TrajectoryFile
from robocas_ms3.demos.recordings.subgoals import SubGoal
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.viewer import damage
from robocas_ms3.viewer.content import PageContent
from robocas_ms3.viewer.damage import readable
from robocas_ms3.viewer.episode import ARM, ROLL_PITCH_YAW, XYZ, facts_of, plot, show_motion

NOTE = "A trajectory file holds states, no pictures: `robocas convert {name} --to robocas --out DIR` renders them."
_STILL = 0.002  # m: an object that moves less is drawn where it stands


class TrajectoryContent(PageContent):
    """``F.h5`` with ``F.json`` beside it; a step is a state, T = S + 1."""

    scene_name = entry_name = "its entry of the JSON"

    def __init__(self, path: Path) -> None:
        """Open both.

        Raises:
            DatasetError: a file is missing, damaged, or they do not match.
        """
        with readable(path):
            with TrajectoryFile(path) as file:
                rate_hz, self._listed = file.control_freq, file.episodes
                self._task = task_of(file.env_info["env_id"])
            self.recordings = TrajectorySource(path, rate_hz=rate_hz, include_failed=True)
        super().__init__(self.recordings, "trajectory file", notes=[NOTE.format(name=path.name)], split={})

    def _entry(self, number: int) -> tuple[dict[str, Any], str]:
        """What can be told of a damaged one, which has no scene."""
        listed = self._listed[number]
        said = listed.get("robocas")
        target = said.get("target") if isinstance(said, dict) else None
        seed, success = listed.get("episode_seed"), succeeded(listed)
        entry = {"task": self._task, "seed": seed, "success": success, "target": target}
        return damage.scene(lambda: entry, self.entry_name)

    def _show(self, number: int, scene: Mapping[str, Any]) -> dict[str, Any]:
        """States as plots, recorded actions, and the paths of TCP and objects."""
        recording = self.recordings.episode(number).recording()
        motion = recording.motion(np.arange(recording.control_steps + 1))
        objects = _objects(recording, scene, self.recordings.info(number).objects, motion.arm_base_in_world[0])
        return {
            **show_motion(_arrays(recording, motion), _goals(recording), _actions(recording), objects, moving=True),
            "facts": facts_of({**scene, "source": None}),  # which is this file
        }


def _arrays(recording: Recording, motion: Motion) -> dict[str, NDArray]:
    """Those of ``episode_info.npz`` that the page shows, at all states."""
    tcp, base = motion.tcp_in_base, motion.arm_base_in_world
    return {
        "language_goal": np.array(recording.instruction),
        "ee_pos": tcp[:, :3, 3],
        "ee_orn": Rotation.from_matrix(tcp[:, :3, :3]).as_quat(),
        "base_pos": base[:, :3, 3],
        "base_orn": Rotation.from_matrix(base[:, :3, :3]).as_quat(),
        "robot_joints": motion.qpos[:, RobotDescription.arm_slice],
        "gripper_width": motion.gripper_width,
        "agv_pose": planar_base(motion.root_in_world, motion.qpos),
    }


def _goals(recording: Recording) -> list[SubGoal]:
    """Sub-goals over the states; the last state is its last action's."""
    last = recording.control_steps
    return [replace(goal, last=last) if goal.last == last - 1 else goal for goal in recording.subgoals]


def _actions(recording: Recording) -> list[dict[str, Any]]:
    """Recorded actions: arm, gripper, and base where it moves. The last state has none; it shows the one before."""
    values = np.concatenate([recording.actions, recording.actions[-1:]])
    arm = {7: 6, 8: 7, 10: 6, 11: 7}.get(values.shape[1])  # 6: end-effector deltas
    if arm is None:
        return [plot("Actions", "", [f"a{i + 1}" for i in range(values.shape[1])], values, steps=True)]
    names = ARM if arm == 7 else (*XYZ, *ROLL_PITCH_YAW)
    unit = "rad" if recording.control_mode == "pd_joint_pos" else ""
    plots = [
        plot(f"Action: arm, {recording.control_mode}", unit, names, values[:, :arm], steps=True),
        plot("Action: gripper, 1 opens", "", ("gripper",), values[:, arm : arm + 1], steps=True),
    ]
    base = values[:, arm + 1 :]
    return plots + ([plot("Action: mobile base", "", ("x", "y", "yaw"), base, steps=True)] if base.any() else [])


def _objects(recording: Recording, scene: Mapping[str, Any], ids: Any, base_in_world: NDArray) -> list[dict[str, Any]]:
    """Paths of actors, thinned to one point where they stand still, without those parked far away."""
    target, world_to_base = scene.get("target") or {}, inverse(base_in_world)
    chosen = f"object_{target['slot']}" if target else ""
    names = {thing["slot"]: thing["name"] for thing in scene.get("objects") or ()}
    named = {f"object_{slot}": called(str(asset), names.get(slot, "")) for slot, asset in enumerate(ids or ())}
    named |= {chosen: called(target.get("asset_id") or "", target.get("name") or "")}
    found = []
    for actor, states in recording.states.get("actors", {}).items():
        path = states[:, :3].astype(float)
        start = world_to_base[:3, :3] @ path[0] + world_to_base[:3, 3]
        if np.linalg.norm(start) > 5 or actor in ("ground", "room"):
            continue
        still = np.ptp(path, axis=0).max() < _STILL
        name = named.get(actor, actor.replace("_", " "))
        found.append({"name": name, "target": actor == chosen, "path": path[:1] if still else path})
    return found
