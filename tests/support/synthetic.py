"""Synthetic recordings, and a ray caster that renders them: trajectories and frames without a simulator."""

from __future__ import annotations

import json
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from robocas_ms3.datasets.images.image_files import ImageOptions, compute_bounding_box
from robocas_ms3.datasets.sources.episode_source import FIRST_SLOT, StepImages
from robocas_ms3.robots.camera_models import CameraModel
from robocas_ms3.robots.cameras import STANDARD_CAMERA_NAMES, standard_camera_parent
from robocas_ms3.robots.description import MOBILE_PANDA

STEPS = 22  # control steps; with a stride of 4 the last dataset step is shorter
SIZE = (64, 48)
TABLE = ((0.3, 0.6, 0.0), (1.5, 1.4, 0.61))
ROOM = ((-3.0, -3.0, 0.0), (3.0, 3.0, 4.0))
HALF = 0.05  # m, half the edge of the cubes on the table
COLOURS = np.array([[90, 90, 90], [200, 160, 100], [220, 40, 40], [40, 200, 60], [40, 60, 220]], np.uint8)


def pose(xyz, rotation=None):
    matrix = np.eye(4)
    matrix[:3, 3] = xyz
    if rotation is not None:
        matrix[:3, :3] = rotation.as_matrix()
    return matrix


def looking(eye, at):
    """Return the pose of an OpenCV camera (x right, y down, z forward) at `eye` that looks at `at`, without roll."""
    z = np.subtract(at, eye) / np.linalg.norm(np.subtract(at, eye))
    x = np.cross(z, [0, 0, 1])
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([x, np.cross(z, x), z, eye])
    return matrix


CAMERA_IN_PARENT = {
    "base_camera": looking([0.1, 0.3, 1.2], [0.8, 0.0, 0.0]),
    "gripper_camera": pose([0.06, 0.0, -0.1]),
    "static_camera": looking([1.0, 1.8, 1.6], [0.85, 0.8, 0.5]),
}


def render_by(renderer, convert):
    """Return a conversion function that uses another renderer than its settings."""
    return lambda settings, **more: convert(replace(settings, open_renderer=renderer), **more)


class RayCaster:
    """``Renderer`` of a room with a floor, a table and a cube for each actor."""

    def __init__(self, env_info, control_mode, image_options=None):
        self.image_options = (image_options or ImageOptions()).select_cameras(STANDARD_CAMERA_NAMES, "here")
        self.size = self.image_options.size or SIZE
        self.closed = False

    def load_scene(self, recording):
        pass

    def close(self):
        self.closed = True

    @contextmanager
    def select_cameras(self, names):
        options = self.image_options
        self.image_options = replace(options, cameras=tuple(names))
        try:
            yield
        finally:
            self.image_options = options

    def cameras(self):
        return {
            name: CameraModel(
                self.intrinsic(), CAMERA_IN_PARENT[name], standard_camera_parent(name), CAMERA_IN_PARENT[name]
            )
            for name in self.image_options.cameras
        }

    def scene(self):
        return {
            "task": "pick",
            "config": {"task": "pick"},
            "layout": {"object_ids": ["cube"] * 3},
            "objects": [{"slot": slot, "id": "cube", "name": "cube"} for slot in range(3)],
        }

    def intrinsic(self):
        width, height = self.size
        return np.array([height / 2, height / 2, width / 2, height / 2])  # 90 deg vertical field of view

    def frames(self, recording, samples):
        motion = recording.compute_motion(np.asarray(samples))
        for index, base, tcp in zip(samples, motion.arm_base_in_world, motion.tcp_in_world, strict=True):
            state = recording.state(int(index))
            parents = {"base_camera": base, "gripper_camera": tcp, "static_camera": np.eye(4)}
            boxes = [TABLE] + [(p[0, :3] - HALF, p[0, :3] + HALF) for p in state["actors"].values()]
            wanted = {n: CAMERA_IN_PARENT[n] for n in self.image_options.cameras}
            shots = {n: self.shoot(parents[n] @ camera, boxes) for n, camera in wanted.items()}
            depth = {n: p[1] for n, p in shots.items() if self.image_options.depth}
            masks = {n: p[2] == 2 for n, p in shots.items() if self.image_options.boxes}  # after the table: the target
            found = {n: box for n, mask in masks.items() if (box := compute_bounding_box(mask))}
            values = np.maximum(np.arange(len(boxes) + 1) - 2 + FIRST_SLOT, 0) * (np.arange(len(boxes) + 1) > 1)
            wanted_values = shots if self.image_options.segmentation else {}
            segmentation = {n: values[p[2]].astype(np.uint8) for n, p in wanted_values.items()}
            yield StepImages({n: p[0] for n, p in shots.items()}, depth, found, segmentation)

    def shoot(self, camera_in_world, boxes):
        width, height = self.size
        fx, fy, cx, cy = self.intrinsic()
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones_like(rows)], -1) @ camera_in_world[:3, :3].T
        eye = camera_in_world[:3, 3]
        hit, depth = np.zeros((height, width), int), slab(eye, rays, ROOM)[1]
        for index, box in enumerate(boxes):
            near, far = slab(eye, rays, box)
            in_front = (near < far) & (near > 0.001) & (near < depth)
            depth = np.where(in_front, near, depth)
            hit[in_front] = index + 1
        return COLOURS[hit % len(COLOURS)], np.round(depth * 1000).astype(np.uint16), hit


def slab(eye, rays, box):
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = ((np.asarray(corner) - eye) / rays for corner in box)
    return np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)


def make_states(seed, steps=STEPS):
    """Return states 0..S of a robot that reaches out, and of three cubes, the first of which is lifted."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, steps + 1)[:, None]
    qpos = np.zeros((steps + 1, 12))
    qpos[:, 3:10] = (
        np.array(MOBILE_PANDA.arm_evaluation_start) + rng.uniform(-0.1, 0.1, 7) + t * rng.uniform(-0.15, 0.15, 7)
    )
    qpos[:, 10:] = np.where(t < 0.4, 0.04, 0.02)
    robot = np.zeros((steps + 1, 37), np.float32)
    robot[:, :3] = 0.7, 0.15, 0.0
    robot[:, 3:7] = np.sqrt(0.5), 0, 0, np.sqrt(0.5)  # wxyz: 90 deg about z
    robot[:, 13:25] = qpos
    robot[:-1, 25:] = np.diff(qpos, axis=0) * 20
    actors = {}
    for index in range(3):
        actors[f"object_{index}"] = cube = np.zeros((steps + 1, 13), np.float32)
        cube[:, :3] = 0.6 + 0.25 * index, 0.8 + 0.3 * rng.random(), 0.66
        cube[:, 3] = 1
    actors["object_0"][:, 2] += 0.2 * np.clip(t[:, 0] - 0.5, 0, 1)
    return {"actors": actors, "articulations": {"robocas_mobile_panda": robot}}


def write_trajectory(path: Path, seeds=(3, 4, 5), failed=(), steps=STEPS):
    """Write ``F.h5`` and ``F.json`` as the generator does; return the path."""
    episodes = []
    with h5py.File(path, "w") as file:
        for number, seed in enumerate(seeds):
            group = file.create_group(f"traj_{number}")
            states = make_states(seed, steps)
            for kind, arrays in states.items():
                for name, array in arrays.items():
                    group.create_dataset(f"env_states/{kind}/{name}", data=array)
            actions = np.zeros((steps, 8), np.float32)
            actions[:, :7] = states["articulations"]["robocas_mobile_panda"][1:, 16:23]
            actions[:, 7] = np.where(np.arange(steps) < 9, 1, -1)
            group.create_dataset("actions", data=actions)
            for flag in ("success", "terminated", "truncated"):
                group.create_dataset(flag, data=np.zeros(steps, bool))
            episodes.append(
                {
                    "episode_id": number,
                    "episode_seed": seed,
                    "control_mode": "pd_joint_pos",
                    "elapsed_steps": steps,
                    "reset_kwargs": {"seed": seed},
                    "success": number not in failed,
                    "robocas": {
                        "instruction": f"grasp the cube {seed} on the table and move it to the basket",
                        "target": {"slot": 0, "asset_id": "cube", "name": f"cube {seed}"},
                        "support": "table",
                        "subgoals": [
                            {
                                "goal_type": "move and grasp",
                                "goal_description": f"grasp the cube {seed} on the table",
                                "goal_range": [0, 11],
                            },
                            {
                                "goal_type": "transfer object",
                                "goal_description": f"Drop the cube {seed} into the basket",
                                "goal_range": [12, steps - 1],
                            },
                        ],
                    },
                }
            )
    metadata = {
        "env_info": {"env_id": "robocas_ms3:RoboCASPick-v1", "env_kwargs": {"control_mode": "pd_joint_pos"}},
        "episodes": episodes,
        "robocas": {"control_freq": 20, "versions": {"robocas_ms3": "0.1.0"}},
    }
    path.with_suffix(".json").write_text(json.dumps(metadata))
    return path


def add_action_noise(path: Path) -> Path:
    """Add deviations of the joints by action noise to all episodes of a trajectory file, in place; return the path."""
    rng = np.random.default_rng(7)
    with h5py.File(path, "r+") as file:
        for group in file.values():
            deviations = rng.normal(scale=0.01, size=(len(group["actions"]), 7)).astype(np.float32)
            group["joint_deviations"] = deviations
            group["intended_actions"] = group["actions"] - np.pad(deviations, ((0, 0), (0, 1)))
    metadata = json.loads(path.with_suffix(".json").read_text())
    for episode in metadata["episodes"]:
        episode["robocas"]["action_noise"] = [3.0, 1.0]
    path.with_suffix(".json").write_text(json.dumps(metadata))
    return path


def stub_embeddings(source, entries):
    """Return unit vectors instead of sentence embeddings, whose model takes seconds to load."""
    texts = {text for entry in entries for text in source.list_texts(entry["source"])}
    return {text: np.eye(384, dtype=np.float32)[number] for number, text in enumerate(sorted(texts))}


__all__ = ["RayCaster", "add_action_noise", "stub_embeddings", "make_states", "render_by", "write_trajectory"]
