"""Made-up candidates at decisions of a recording: ``candidates.h5`` without a simulator."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from robocas_ms3.core.poses import from_wxyz, inverse, to_wxyz
from robocas_ms3.demos.candidates.candidates_file import merge_candidates, write_candidates
from robocas_ms3.demos.candidates.records import DecisionRecord
from robocas_ms3.demos.recordings.motion import split_robot_states
from robocas_ms3.demos.recordings.trajectory_file import TrajectoryFile

DOWN = Rotation.from_euler("x", 180, degrees=True)
PER_DECISION = 10
KINDS = {"move": ("push", "push", "lift"), "grasp": ("grasp",), "release": ("release",), "pull": ("pull",)}


def write_recorded_candidates(path: Path, trajectory: Path, steps=(0, 8, 16), episodes=None, kinds=tuple(KINDS)):
    """Write a candidates file with made-up decisions at control steps of each episode of a trajectory file.

    The decisions have the given kinds in turn. Positions of objects and robot are those of the recording. The first
    candidate of each decision is chosen and successful, and helps if it is a push or lift.
    """
    with TrajectoryFile(trajectory) as file:
        parts = []
        for index in range(len(file.episodes)) if episodes is None else episodes:
            entry = file.episodes[index]
            part = path.with_name(f"part_{index}.h5")
            recording = file.read_recording(index)
            target = entry["robocas"]["target"]["slot"]
            names = entry["robocas"].get("objects")
            records = make_records(recording, steps, target, names, kinds)
            write_candidates(part, records, file.env_info, {"made_up": True})
            parts.append(part)
    merge_candidates(parts, path)
    for part in parts:
        part.unlink()
    return path


def make_records(recording, steps, target, names=None, kinds=tuple(KINDS)):
    rng = np.random.default_rng(recording.seed)
    samples = np.array(steps)
    motion = recording.compute_motion(samples)
    _, qpos, _ = split_robot_states(recording.states["articulations"][recording.robot.description.uid][samples])
    actors = recording.states["actors"]
    slots = sum(name.startswith("object_") for name in actors)
    records = []
    for number, (step, joints) in enumerate(zip(steps, qpos, strict=True)):
        world_in_base = inverse(motion.arm_base_in_world[number])
        poses = np.stack([actors[f"object_{slot}"][step, :7] for slot in range(slots)])
        objects = to_wxyz(world_in_base @ from_wxyz(poses)).astype(np.float32)
        basket = np.full(7, np.nan)
        if "basket" in actors:
            basket = to_wxyz(world_in_base @ from_wxyz(actors["basket"][step, :7]))
        kind = kinds[number % len(kinds)]
        measures = {
            "hidden_fraction": rng.uniform(0.2, 0.6, slots),
            "obstacles": np.full(slots, 4),
            "free_grasps": rng.integers(0, 9, slots),
        }
        values = {
            "seed": recording.seed,
            "decision": number,
            "kind": kind,
            "attempt": 0,
            "in_episode": True,
            "moves_left": 0,
            "step": step,
            "instruction": recording.instruction,
            "target_slot": target,
            "object_id": list(names or ["cube"] * slots),
            "object_name": [name.replace("_", " ") for name in names or ["cube"] * slots],
            "present": np.linalg.norm(objects[:, :2], axis=1) < 3,
            "object_in_base": objects,
            "fallen": np.zeros(slots, bool),
            "basket_in_base": basket,
            "tcp_in_base": to_wxyz(motion.tcp_in_base[number]),
            "qpos": joints[3:10],
            "gripper_width": joints[10:].sum(),
            "held_slot": -1,
            "opening": np.nan,
            **measures,
        }
        state = {
            kind: {name: rows[step] for name, rows in of.items()}
            for kind, of in recording.states.items()
            if kind != "controller"
        }
        candidates = [_make_candidate(rng, values, measures, index) for index in range(PER_DECISION)]
        records.append(DecisionRecord(values, state, candidates))
    return records


def _make_candidate(rng, values, measures, index):
    objects, target = np.array(values["object_in_base"]), values["target_slot"]
    primitives = KINDS[values["kind"]]
    primitive = primitives[index % len(primitives)]
    slot = target
    if values["kind"] == "move":
        near = np.argsort(np.linalg.norm(objects[:, :2] - objects[target, :2], axis=1))
        slot = int(near[1 + index % 3] if len(near) > 3 else near[-1])
    centre = objects[slot, :3]
    turn = rng.uniform(-np.pi, np.pi)
    rotation = Rotation.from_euler("z", turn) * DOWN
    if index % 2:
        rotation = rotation * Rotation.from_euler("xy", rng.uniform(-30, 30, 2), degrees=True)
    start, end = centre.copy(), np.full(7, np.nan)
    direction = np.array([np.cos(turn), np.sin(turn), 0])
    if primitive == "push":
        start = centre - 0.06 * direction
        end[:3] = centre + 0.1 * direction
    elif primitive == "lift":
        end[:3] = centre + [*rng.uniform(-0.25, 0.25, 2), 0]
    elif primitive == "release":
        start = values["basket_in_base"][:3] if np.isfinite(values["basket_in_base"]).all() else centre
        start = start + [*rng.uniform(-0.1, 0.1, 2), 0.3]
    elif primitive == "pull":
        end[:3] = centre - [0.2, 0.02 * index, 0]
    quaternion = rotation.as_quat()[[3, 0, 1, 2]]
    if np.isfinite(end[:3]).all():
        end[3:] = quaternion
    feasible = index == 0 or index % 4 != 3
    success = feasible and index % 4 != 2
    helps = success and primitive in ("push", "lift") and index % 4 == 0
    after = {name: np.array(value) for name, value in measures.items()}
    if helps:
        after["obstacles"][target] = 2
        after["hidden_fraction"] = 0.2 * after["hidden_fraction"]
    moved = objects.copy()
    if success and primitive == "push":
        moved[slot, :2] += 0.1 * direction[:2]
    return {
        "primitive": primitive,
        "source": ("expert", "random", "near_miss")[index % 3],
        "slot": -1 if primitive == "pull" else slot,
        "start_in_base": np.concatenate([start, quaternion]),
        "end_in_base": end if primitive == "push" else np.full(7, np.nan),
        "final_in_base": end,
        "chosen": index == 0,
        "feasible": feasible,
        "failure": "" if success else "grasp: slipped" if feasible else "grasp: unreachable",
        "success": success,
        "held": success and primitive == "grasp",
        "seconds": rng.uniform(1, 8) if feasible else 0,
        "object_after_in_base": moved,
        "displacement": np.linalg.norm(moved[:, :3] - objects[:, :3], axis=1),
        "fallen": np.zeros(len(objects), bool),
        "disturbed": index % 3,
        "in_basket": np.zeros(len(objects), bool),
        "opening": np.nan,
        "moves_to_grasp": 0 if helps else -1,
        **after,
    }
