"""Synthetic decisions with candidates, whose outcomes follow from their geometry by simple rules."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from robocas_ms3.demos.candidates.candidates_file import write_candidates
from robocas_ms3.demos.candidates.records import DecisionRecord

ENV_INFO = {
    "env_id": "robocas_ms3:RoboCASSearch-v1",
    "env_kwargs": {
        "config": "search_table_stacked",
        "pack": "builtin",
        "obs_mode": "none",
        "control_mode": "pd_joint_pos",
        "sim_config": {"control_freq": 20},
    },
    "max_episode_steps": 2400,
}
SETTINGS = {"candidates": 16, "candidate_depth": 0}
DOWN = (0.0, 1.0, 0.0, 0.0)  # quaternion of a TCP that points down
TARGET = 0
NAMES = {
    "flat_screwdriver": "screwdriver",
    "mug": "mug",
    "peach": "peach",
    "plum": "plum",
    "soap": "soap",
    "lemon": "lemon",
}
NEAR = 0.1  # m; other objects within this distance of an object are its obstacles


def pose(position, quaternion=(1.0, 0.0, 0.0, 0.0)):
    return np.array([*position, *quaternion], np.float32)


def clutter_of(poses):
    """Return hidden fraction, number of obstacles and number of free grasps of each object."""
    distances = np.linalg.norm(poses[:, None, :2] - poses[None, :, :2], axis=-1)
    obstacles = (distances < NEAR).sum(axis=1) - 1
    return np.clip(obstacles / 8, 0, 1).astype(np.float32), obstacles, np.maximum(0, 20 - 8 * obstacles)


def describe_objects(poses):
    hidden, obstacles, free = clutter_of(poses)
    return {"hidden_fraction": hidden, "obstacles": obstacles, "free_grasps": free}


def make_candidate(before, primitive, slot, rng):
    """Make a candidate: grasps near the middle of a free object succeed, pushes displace the object by 12 cm."""
    after, slots = before.copy(), len(before)
    position = before[slot, :3] + [*rng.normal(0, 0.02, 2), 0.0]
    start, end = pose(position, DOWN), np.full(7, np.nan, np.float32)
    held, fallen = False, np.zeros(slots, bool)
    if primitive == "push":
        angle = rng.uniform(-np.pi, np.pi)
        shift = np.array([np.cos(angle), np.sin(angle), 0.0]) * 0.12
        start, end = pose(before[slot, :3] - shift / 3, DOWN), pose(before[slot, :3] + shift, DOWN)
        after[slot, :3] += shift
        success = True
    elif primitive == "lift":
        end = pose([rng.uniform(0.3, 0.7), rng.uniform(-0.6, -0.4), 0.2], DOWN)
        success = bool(np.linalg.norm(position[:2] - before[slot, :2]) < 0.03)
        after[slot, :3] = end[:3] if success else after[slot, :3]
    else:
        success = held = bool(np.linalg.norm(position[:2] - before[slot, :2]) < 0.02)
    feasible = bool(success or rng.random() < 0.8)
    displacement = np.linalg.norm(after[:, :3] - before[:, :3], axis=-1)
    return {
        "primitive": primitive,
        "source": str(rng.choice(["expert", "random", "near_miss"])),
        "slot": slot,
        "start_in_base": start,
        "end_in_base": end if primitive == "push" else np.full(7, np.nan),
        "final_in_base": end,
        "chosen": False,
        "feasible": feasible,
        "failure": "" if success else "grasp: missed" if feasible else "approach: no_path",
        "success": success,
        "held": held,
        "seconds": 4.0 if feasible else 0.0,
        "object_after_in_base": after,
        "displacement": displacement,
        "fallen": fallen,
        "disturbed": 0,
        "in_basket": np.zeros(slots, bool),
        "opening": np.nan,
        **describe_objects(after),
        "moves_to_grasp": -1,
    }


def make_record(seed, number, slots=5, candidates=6):
    """Make decision ``number`` of the episode of a seed: grasps of the target, pushes and lifts of other objects."""
    rng = np.random.default_rng([seed, number])
    poses = np.stack([pose([rng.uniform(0.4, 0.6), rng.uniform(-0.1, 0.1), 0.15]) for _ in range(slots)])
    primitives = ("grasp", "push", "lift")
    found = []
    for index in range(candidates):
        primitive = primitives[index % 3]
        slot = TARGET if primitive == "grasp" else int(rng.integers(1, slots))
        found.append(make_candidate(poses, primitive, slot, rng))
    if found:
        found[0]["chosen"] = True
    ids = [list(NAMES)[slot % len(NAMES)] for slot in range(slots)]
    names = [NAMES[name] for name in ids]
    values = {
        "seed": seed,
        "decision": number,
        "kind": "move",
        "attempt": 0,
        "in_episode": True,
        "moves_left": 0,
        "step": 40 * number,
        "instruction": f"search the {names[TARGET]} and transfer it to the basket",
        "target_slot": TARGET,
        "object_id": ids,
        "object_name": names,
        "present": np.ones(slots, bool),
        "fallen": np.zeros(slots, bool),
        "object_in_base": poses,
        "basket_in_base": pose([0.5, 0.45, 0.1]),
        "tcp_in_base": pose([0.4, 0.0, 0.4], DOWN),
        "qpos": np.linspace(-1, 1, 7),
        "gripper_width": 0.08,
        "held_slot": -1,
        "opening": np.nan,
        **describe_objects(poses),
    }
    state = {
        "actors": {f"object_{slot}": np.r_[poses[slot], np.zeros(6)].astype(np.float32) for slot in range(slots)},
        "articulations": {"robocas_mobile_panda": np.r_[pose([0, 0, 0]), np.arange(30)].astype(np.float32)},
        "task": {"stages": np.array([True, False])},
    }
    return DecisionRecord(values, state, found)


def write_episodes(path: Path, seeds=(3, 4), decisions=2, slots=5, candidates=6) -> Path:
    """Write the decisions of these seeds to one file."""
    records = [make_record(seed, number, slots, candidates) for seed in seeds for number in range(decisions)]
    write_candidates(path, records, ENV_INFO, SETTINGS)
    return path
