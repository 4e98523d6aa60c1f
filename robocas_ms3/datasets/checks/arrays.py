"""Checks the arrays of an episode: shapes and types, poses and the motion between them, values."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.rigid import ANGLE_TOLERANCE, NORM_TOLERANCE, POSITION_TOLERANCE, apart, same
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.sources.tolerant import planar_motion
from robocas_ms3.language.templates import GOAL_TYPES
from robocas_ms3.poses import from_xyzw
from robocas_ms3.recordings.motion import relative_motion


def check_shapes(file: str, arrays: dict[str, NDArray], steps: int) -> Iterator[Violation]:
    """Check that the arrays are those of the schema, of ``steps`` rows, and numbers."""
    embedded = any(spec.name in arrays for spec in schema.EPISODE_INFO if spec.embedding)
    for spec in schema.EPISODE_INFO:
        if spec.name not in arrays:
            if not spec.embedding or embedded:
                yield Violation(file, spec.name, "this key", "no such key")
            continue
        array = arrays[spec.name]
        if not spec.has_dtype(array):
            yield Violation(file, spec.name, spec.dtype, str(array.dtype))
        if array.shape != spec.shape_for(steps):
            yield Violation(file, spec.name, f"shape {spec.shape_for(steps)}", f"shape {array.shape}")
        elif array.dtype.kind == "f" and not np.isfinite(array).all():
            yield Violation(file, spec.name, "finite numbers", f"{np.sum(~np.isfinite(array))} others")
        elif spec.name == "episode_length" and spec.has_dtype(array) and not 0 < array <= schema.MAX_STEPS:
            yield Violation(file, spec.name, f"1 to {schema.MAX_STEPS} steps", str(array))
    for key in sorted(set(arrays) - {spec.name for spec in schema.EPISODE_INFO}):
        yield Violation(file, key, "keys of the schema only", "an unknown key")


def check_poses(file: str, arrays: dict[str, NDArray]) -> Iterator[Violation]:
    """Check that quaternions are xyzw of unit length, and relative poses the motion between absolute ones."""
    for spec in schema.EPISODE_INFO:
        if spec.quaternion:
            error = np.abs(np.linalg.norm(arrays[spec.name], axis=1) - 1)
            if error.max() > NORM_TOLERANCE:
                row = int(error.argmax())
                yield Violation(file, spec.name, "unit quaternions", f"off by {error.max():.2g} in row {row}")
    for position, orientation, rel_position, rel_orientation in schema.RELATIVE_PAIRS:
        pairs = [(arrays[position], arrays[orientation]), (arrays[rel_position], arrays[rel_orientation])]
        if any(np.linalg.norm(q, axis=1).min() < 0.5 for _, q in pairs):
            continue  # said already
        absolute, relative = (from_xyzw(p.astype(np.float64), q.astype(np.float64)) for p, q in pairs)
        if same(relative_motion(absolute), relative).all():
            continue
        as_wxyz = [from_xyzw(p.astype(np.float64), np.roll(q, -1, axis=1).astype(np.float64)) for p, q in pairs]
        if same(relative_motion(as_wxyz[0]), as_wxyz[1]).all():
            yield Violation(file, f"{orientation}, {rel_orientation}", "quaternions xyzw", "quaternions wxyz")
            continue
        shift, turn = apart(relative_motion(absolute), relative)
        for key, error, limit, unit in (
            (rel_position, shift, POSITION_TOLERANCE, "m"),
            (rel_orientation, turn, ANGLE_TOLERANCE, "rad"),
        ):
            if error.max() > limit:
                wrong = int(np.sum(error > limit))
                row = int(error.argmax())
                found = f"{wrong} of {len(error)} rows off, by {error.max():.3g} {unit} in row {row}"
                yield Violation(file, key, f"the motion between rows of {position}, {orientation}", found)


def check_values(file: str, arrays: dict[str, NDArray]) -> Iterator[Violation]:
    """Check base motion, gripper width, texts and embeddings."""
    error = np.abs(planar_motion(arrays["agv_pose"]) - arrays["rel_agv_pose"]).max()
    if error > POSITION_TOLERANCE:
        yield Violation(file, "rel_agv_pose", "differences of agv_pose", f"off by {error:.3g}")
    width = arrays["gripper_width"]
    if width.min() < -0.005 or width.max() > 0.085:
        yield Violation(file, "gripper_width", "0 to 0.08 m", f"{width.min():.3f} to {width.max():.3f}")
    for kind in sorted(set(arrays["step_goal_type"].tolist()) - set(GOAL_TYPES)):
        yield Violation(file, "step_goal_type", f"one of {', '.join(GOAL_TYPES)}", kind)
    if not str(arrays["language_goal"]).strip():
        yield Violation(file, "language_goal", "an instruction", "nothing")
    for spec in schema.EPISODE_INFO:
        if spec.embedding and spec.name in arrays:
            error = np.abs(np.linalg.norm(arrays[spec.name], axis=-1) - 1).max()
            if error > NORM_TOLERANCE:
                yield Violation(file, spec.name, "unit length", f"off by {error:.2g}")
