"""A trajectory file of ``robocas generate`` as the page shows it: no pictures, but the objects' motion."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.datasets.checks.scene_values import sound
from robocas_ms3.datasets.sources.arrays import planar_base
from robocas_ms3.datasets.sources.provenance import succeeded, task_of
from robocas_ms3.errors import DatasetError
from robocas_ms3.recordings.reading import Recording, TrajectoryFile
from robocas_ms3.recordings.seeds import one_seed
from robocas_ms3.robots import constants as c
from robocas_ms3.viewer.damage import integer, readable, text
from robocas_ms3.viewer.failures import Failures, describe, stages
from robocas_ms3.viewer.plots import ARM, ROLL_PITCH_YAW, XYZ, base_plot, gripper_plot, motion_plots
from robocas_ms3.viewer.source import Picture, make_episode, make_index, make_trace, plot, row

NOTE = "A trajectory file holds states, no pictures: `robocas convert {name} --to robocas --out DIR` renders them."
_STILL = 0.002  # m: an object that moves less is drawn where it stands


class TrajectorySource:
    """``F.h5`` with ``F.json`` beside it; a step is a state, T = S + 1."""

    def __init__(self, path: Path) -> None:
        """Open both.

        Raises:
            DatasetError: a file is missing, damaged, or they do not match.
        """
        self.root = path
        self.failures = Failures.read(path.parent)
        with readable(path):
            self.file = TrajectoryFile(path)
            self._position = {int(e["episode_id"]): i for i, e in enumerate(self.file.episodes)}
            self._kwargs = dict(self.file.env_info["env_kwargs"])
        self._reading = threading.Lock()  # HDF5 reads from one thread at a time

    def index(self) -> dict[str, Any]:
        """From the JSON alone; seeds without an episode, from ``failures.jsonl``, come last."""
        task, rows = task_of(str(self.file.env_info.get("env_id"))) or "", []
        for episode in self.file.episodes:
            recorded, wrong = _entry(episode)
            seed = one_seed(episode.get("episode_seed"))
            rows.append(
                row(
                    int(episode["episode_id"]),
                    steps=(integer(episode.get("elapsed_steps")) or 0) + 1,
                    instruction=recorded["instruction"],
                    task=task,
                    target=(recorded["target"] or {}).get("name", ""),
                    seed=seed,
                    success=succeeded(episode),
                    stages=stages(self.failures.of_seed(seed), recorded),
                    attempts=recorded.get("attempts"),
                    damage=wrong,
                )
            )
        rows += self.failures.given_up(rows, [self.file.env_info] * len(rows))
        note = f"{NOTE.format(name=self.root.name)} {self.failures.note}".strip()
        return make_index(self.root, "trajectory file", self.file.control_freq, (), False, rows, note)

    def episode(self, number: int) -> dict[str, Any]:
        """States as plots, recorded actions, and the paths of TCP and objects."""
        if number not in self._position:
            raise DatasetError("no such episode", where=self.root, found=number)
        position = self._position[number]
        with self._reading:
            recording = self.file.recording(position)
        entry, _ = _entry(self.file.episodes[position])  # the table says what is wrong
        config = self._kwargs.get("config")
        steps = recording.control_steps + 1
        motion = recording.motion(np.arange(steps))
        to_base = np.linalg.inv(motion.arm_base_in_world)
        tcp = to_base @ motion.tcp_in_world
        xyzw = Rotation.from_matrix(tcp[:, :3, :3]).as_quat()
        last = steps - 1
        return make_episode(
            number,
            instruction=recording.instruction,
            steps=steps,
            rate_hz=self.file.control_freq,
            subgoals=[
                {
                    "type": goal.goal_type,
                    "text": goal.goal_description,
                    "first": goal.first,
                    "last": last if goal.last == last - 1 else goal.last,  # the last state is its last action's
                }
                for goal in recording.subgoals
            ],
            plots=[
                *motion_plots(tcp[:, :3, 3], xyzw, motion.qpos[:, c.ARM_SLICE]),
                gripper_plot(motion.qpos[:, c.FINGER_SLICE].sum(axis=1), None),
                *_actions(recording),
                *base_plot(planar_base(motion.root_in_world, motion.qpos)),
            ],
            trace=make_trace(motion.tcp_in_world, _objects(recording, entry, to_base[0]), moving=True),
            facts={
                "Configuration": config if isinstance(config, str) else None,  # a whole one is too long
                "Object pack": self._kwargs.get("pack"),
                "Recorded with": recording.control_mode,
                "Relation": entry.get("relation"),
                **{str(name).capitalize(): value for name, value in (entry.get("facts") or {}).items()},
            },
            failures=describe(self.failures.of_seed(recording.seed), entry),
        )

    def rgb(self, number: int, camera: str, step: int) -> Picture:
        """There is none."""
        raise DatasetError("a trajectory file holds no pictures", where=self.root, fix="Use robocas convert.")

    def depth(self, number: int, camera: str, step: int) -> NDArray[np.uint16]:
        """There is none."""
        raise DatasetError("a trajectory file holds no pictures", where=self.root, fix="Use robocas convert.")


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


def _objects(recording: Recording, entry: dict[str, Any], world_to_base: NDArray) -> list[dict[str, Any]]:
    """Paths of actors, thinned to one point where they stand still, without those parked far away."""
    target = (entry["target"] or {}).get("slot")
    named = {f"object_{slot}": str(name).replace("_", " ") for slot, name in enumerate(entry.get("objects") or ())}
    if target is not None:
        named[f"object_{target}"] = entry["target"]["name"]
    found = []
    for actor, states in recording.states.get("actors", {}).items():
        path = states[:, :3].astype(float)
        start = world_to_base[:3, :3] @ path[0] + world_to_base[:3, 3]
        if np.linalg.norm(start) > 5 or actor in ("ground", "room"):
            continue
        still = np.ptp(path, axis=0).max() < _STILL
        name = named.get(actor, actor.replace("_", " "))
        found.append({"name": name, "target": actor == f"object_{target}", "path": path[:1] if still else path})
    return found


def _entry(episode: dict[str, Any]) -> tuple[dict[str, Any], str]:
    """What the generator said of an episode, without values that are wrong, and those in words."""
    said = episode.get("robocas")
    known = said if isinstance(said, dict) else {}
    entry, wrong = sound({"recorded": said, "target": known.get("target")}, "its entry of the JSON")
    instruction = text(known.get("instruction"))
    return {**(entry.get("recorded") or {}), "target": entry.get("target"), "instruction": instruction}, wrong
