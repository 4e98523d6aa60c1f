"""Checks of the arrays of an episode: file, keys, shapes, types, values, poses and motion."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.poses import from_xyzw
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.violation import NO_FILE, Violation
from robocas_ms3.datasets.sources.arrays import SPECS, EpisodeArrays
from robocas_ms3.demos.recordings.motion import compute_agv_motion, compute_relative_motion
from robocas_ms3.scenes.language.templates import GOAL_TYPES

Check = Callable[[EpisodeArrays], Iterator[Violation]]
"""Function that yields the violations of one rule. Only `check_keys` reports missing arrays."""
UNIT_TOLERANCE = 1e-3  # of lengths of unit vectors and quaternions
POSITION_TOLERANCE = 1e-4  # m
ANGLE_TOLERANCE = 1e-3  # rad


def check_file(stored: EpisodeArrays) -> Iterator[Violation]:
    """Check that the file and all of its arrays can be read."""
    for key, error in stored.unreadable.items():
        if isinstance(error, FileNotFoundError):
            yield Violation(stored.file, "", "this file", NO_FILE, "missing")
        else:
            expected = "an array without pickles" if key else "a numpy archive without pickles"
            yield Violation(stored.file, key, expected, stored.reason(key))


def check_keys(stored: EpisodeArrays) -> Iterator[Violation]:
    """Check that the keys are those of the schema, with all embeddings or none."""
    if "" in stored.unreadable:
        return
    embedded = any(spec.name in stored.arrays for spec in schema.EPISODE_INFO if spec.embedding)
    present = {*stored.arrays, *stored.unreadable, *stored.ignored}
    for spec in schema.EPISODE_INFO:
        if spec.name not in present and not spec.optional and (embedded or not spec.embedding):
            yield Violation(stored.file, spec.name, "this key", "no such key", "missing")
    for key in sorted(present - set(SPECS)):
        yield Violation(stored.file, key, "no keys outside the schema", "an unknown key", "unexpected")


def check_shapes(stored: EpisodeArrays) -> Iterator[Violation]:
    """Check types and shapes, and that ``episode_length`` is the length of the arrays."""
    for spec, array in _known(stored):
        if not spec.has_dtype(array):
            yield Violation(stored.file, spec.name, spec.dtype, str(array.dtype))
        if array.shape != spec.shape_for(stored.steps):
            yield Violation(stored.file, spec.name, f"shape {spec.shape_for(stored.steps)}", f"shape {array.shape}")
        elif spec.name == "episode_length" and not 0 < array <= schema.MAX_STEPS:
            yield Violation(stored.file, spec.name, f"1 to {schema.MAX_STEPS} steps", str(array))
        elif spec.name == "episode_length" and array != stored.steps:
            yield Violation(stored.file, spec.name, f"{stored.steps}, the length of the arrays", str(array))


def check_finite(stored: EpisodeArrays) -> Iterator[Violation]:
    """Check that all numbers are finite, including those of unknown keys."""
    for key, array in stored.arrays.items():
        wrong = np.sum(~np.isfinite(array)) if array.dtype.kind == "f" else 0
        if wrong:
            yield Violation(stored.file, key, "finite numbers", f"{wrong} NaN or infinite values")


def check_units(stored: EpisodeArrays) -> Iterator[Violation]:
    """Check that quaternions and embeddings have unit length."""
    for spec, array in _known(stored):
        if spec.quaternion or spec.embedding:
            error = np.abs(np.linalg.norm(array, axis=-1) - 1)
            if error.max() > UNIT_TOLERANCE:
                expected = "unit quaternions" if spec.quaternion else "unit length"
                row = f" in row {int(error.argmax())}" if error.ndim else ""
                yield Violation(stored.file, spec.name, expected, f"off by {error.max():.2g}{row}")


def check_motion(stored: EpisodeArrays) -> Iterator[Violation]:
    """Check that relative poses are the motion between absolute poses, with quaternions xyzw."""
    for keys in schema.RELATIVE_PAIRS:
        yield from check_pair(stored, keys)


def check_pair(stored: EpisodeArrays, keys: tuple[str, str, str, str]) -> Iterator[Violation]:
    """Check the relative poses of one of ``schema.RELATIVE_PAIRS``."""
    position, orientation, rel_position, rel_orientation = keys
    if not set(keys) <= stored.arrays.keys():
        return
    if any(np.linalg.norm(stored.arrays[key], axis=1).min() < 0.5 for key in (orientation, rel_orientation)):
        return  # reported by `check_units`
    shift, turn = motion_errors(stored, keys)
    if (shift <= POSITION_TOLERANCE).all() and (turn <= ANGLE_TOLERANCE).all():
        return
    limits = POSITION_TOLERANCE, ANGLE_TOLERANCE
    if all((e <= limit).all() for e, limit in zip(motion_errors(stored, keys, -1), limits, strict=True)):
        yield Violation(stored.file, f"{orientation}, {rel_orientation}", "quaternions xyzw", "quaternions wxyz")
        return
    for key, error, limit, unit in (
        (rel_position, shift, POSITION_TOLERANCE, "m"),
        (rel_orientation, turn, ANGLE_TOLERANCE, "rad"),
    ):
        if error.max() > limit:
            rows = f"{int(np.sum(error > limit))} of {len(error)} rows off"
            text = f"{rows}, at most {error.max():.3g} {unit} (row {int(error.argmax())})"
            yield Violation(stored.file, key, f"the motion between rows of {position}, {orientation}", text)


def motion_errors(stored: EpisodeArrays, keys: tuple[str, ...], order: int = 0) -> tuple[NDArray, NDArray]:
    """Return the errors (T,) of relative poses in m and in rad; ``order`` -1 reads quaternions as wxyz."""
    arrays = [stored.arrays[key].astype(np.float64) for key in keys]
    absolute, relative = (from_xyzw(arrays[i], np.roll(arrays[i + 1], order, axis=1)) for i in (0, 2))
    motion = compute_relative_motion(absolute)
    turn = Rotation.from_matrix(np.swapaxes(motion[:, :3, :3], 1, 2) @ relative[:, :3, :3]).magnitude()
    return np.linalg.norm(motion[:, :3, 3] - relative[:, :3, 3], axis=1), turn


def check_base_motion(stored: EpisodeArrays) -> Iterator[Violation]:
    """Check that ``rel_agv_pose`` are the differences of ``agv_pose``."""
    if {"agv_pose", "rel_agv_pose"} <= stored.arrays.keys():
        error = np.abs(compute_agv_motion(stored.arrays["agv_pose"]) - stored.arrays["rel_agv_pose"]).max()
        if error > POSITION_TOLERANCE:
            yield Violation(stored.file, "rel_agv_pose", "differences of agv_pose", f"off by {error:.3g}")


def check_values(stored: EpisodeArrays) -> Iterator[Violation]:
    """Check limits of numbers, types of sub-goals, and that there is an instruction."""
    for spec, array in _known(stored):
        if spec.limits and not spec.limits[0] <= array.min() <= array.max() <= spec.limits[1]:
            expected = f"{spec.limits[0]:g} to {spec.limits[1]:g} {spec.unit}"
            yield Violation(stored.file, spec.name, expected, f"{array.min():.3f} to {array.max():.3f}")
    types = stored.arrays.get("step_goal_type", np.zeros(0, np.str_))
    for goal_type in sorted(set(types.tolist()) - set(GOAL_TYPES)):
        yield Violation(stored.file, "step_goal_type", f"one of {', '.join(GOAL_TYPES)}", goal_type)
    if "language_goal" in stored.arrays and not str(stored.arrays["language_goal"]).strip():
        yield Violation(stored.file, "language_goal", "an instruction", "an empty text")


FORM: tuple[Check, ...] = (check_file, check_keys, check_shapes, check_finite)
"""Checks that arrays must pass before the other checks run."""
CONTENT: tuple[Check, ...] = (check_motion, check_base_motion, check_values)


def violations_of(stored: EpisodeArrays, checks: tuple[Check, ...]) -> Iterator[Violation]:
    """Yield the violations that some checks find in the arrays of an episode."""
    return (violation for check in checks for violation in check(stored))


def _known(stored: EpisodeArrays) -> Iterator[tuple[schema.ArraySpec, NDArray]]:
    return ((SPECS[key], array) for key, array in stored.arrays.items() if key in SPECS)
