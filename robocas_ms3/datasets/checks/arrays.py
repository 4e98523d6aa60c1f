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


def check_file(episode: EpisodeArrays) -> Iterator[Violation]:
    """Check that the file and all of its arrays can be read."""
    for key, error in episode.unreadable.items():
        if isinstance(error, FileNotFoundError):
            yield Violation(episode.file, "", "this file", NO_FILE, "missing")
        else:
            expected = "an array without pickles" if key else "a numpy archive without pickles"
            yield Violation(episode.file, key, expected, episode.describe_error(key))


def check_keys(episode: EpisodeArrays) -> Iterator[Violation]:
    """Check that all keys of the schema are present, and no others; embeddings may be absent together."""
    if "" in episode.unreadable:
        return
    embedded = any(spec.name in episode.arrays for spec in schema.EPISODE_INFO if spec.embedding)
    present = {*episode.arrays, *episode.unreadable, *episode.ignored}
    for spec in schema.EPISODE_INFO:
        if spec.name not in present and not spec.optional and (embedded or not spec.embedding):
            yield Violation(episode.file, spec.name, "this key", "no such key", "missing")
    for key in sorted(present - set(SPECS)):
        yield Violation(episode.file, key, "no keys outside the schema", "an unknown key", "unexpected")


def check_shapes(episode: EpisodeArrays) -> Iterator[Violation]:
    """Check data types and shapes of the arrays, and that ``episode_length`` is their length."""
    for spec, array in _iter_schema_arrays(episode):
        if not spec.has_dtype(array):
            yield Violation(episode.file, spec.name, spec.dtype, str(array.dtype))
        if array.shape != spec.shape_for(episode.steps):
            yield Violation(episode.file, spec.name, f"shape {spec.shape_for(episode.steps)}", f"shape {array.shape}")
        elif spec.name == "episode_length" and not 0 < array <= schema.MAX_STEPS:
            yield Violation(episode.file, spec.name, f"1 to {schema.MAX_STEPS} steps", str(array))
        elif spec.name == "episode_length" and array != episode.steps:
            yield Violation(episode.file, spec.name, f"{episode.steps}, the length of the arrays", str(array))


def check_finite(episode: EpisodeArrays) -> Iterator[Violation]:
    """Check that no array contains NaN or infinite values, also arrays whose key is not in the schema."""
    for key, array in episode.arrays.items():
        wrong = np.sum(~np.isfinite(array)) if array.dtype.kind == "f" else 0
        if wrong:
            yield Violation(episode.file, key, "finite numbers", f"{wrong} NaN or infinite values")


def check_unit_length(episode: EpisodeArrays) -> Iterator[Violation]:
    """Check that quaternions and embeddings have unit length."""
    for spec, array in _iter_schema_arrays(episode):
        if spec.quaternion or spec.embedding:
            error = np.abs(np.linalg.norm(array, axis=-1) - 1)
            if error.max() > UNIT_TOLERANCE:
                expected = "unit quaternions" if spec.quaternion else "unit length"
                row = f" in row {int(error.argmax())}" if error.ndim else ""
                yield Violation(episode.file, spec.name, expected, f"off by {error.max():.2g}{row}")


def check_motion(episode: EpisodeArrays) -> Iterator[Violation]:
    """Check that the relative motion of the EEF and of the arm base agrees with their poses."""
    for keys in schema.RELATIVE_PAIRS:
        yield from check_relative_poses(episode, keys)


def check_relative_poses(episode: EpisodeArrays, keys: tuple[str, str, str, str]) -> Iterator[Violation]:
    """Check that a relative motion agrees with the poses; ``keys`` is one of ``schema.RELATIVE_PAIRS``."""
    position, orientation, rel_position, rel_orientation = keys
    if not set(keys) <= episode.arrays.keys():
        return
    turns = [episode.arrays.get(key) for key in (orientation, rel_orientation, schema.INTENDED_POSE[1])]
    if any(turn is not None and np.linalg.norm(turn, axis=1).min() < 0.5 for turn in turns):
        return  # reported by `check_unit_length`
    shift, turn = compute_motion_errors(episode, keys)
    if (shift <= POSITION_TOLERANCE).all() and (turn <= ANGLE_TOLERANCE).all():
        return
    limits = POSITION_TOLERANCE, ANGLE_TOLERANCE
    if all(
        (e <= limit).all() for e, limit in zip(compute_motion_errors(episode, keys, wxyz=True), limits, strict=True)
    ):
        yield Violation(episode.file, f"{orientation}, {rel_orientation}", "quaternions xyzw", "quaternions wxyz")
        return
    for key, error, limit, unit in (
        (rel_position, shift, POSITION_TOLERANCE, "m"),
        (rel_orientation, turn, ANGLE_TOLERANCE, "rad"),
    ):
        if error.max() > limit:
            rows = f"{int(np.sum(error > limit))} of {len(error)} rows off"
            text = f"{rows}, at most {error.max():.3g} {unit} (row {int(error.argmax())})"
            yield Violation(episode.file, key, f"the motion between rows of {position}, {orientation}", text)


def compute_motion_errors(episode: EpisodeArrays, keys: tuple[str, ...], wxyz: bool = False) -> tuple[NDArray, NDArray]:
    """Return the position error (T,) in m and the rotation error (T,) in rad of a relative motion.

    ``keys`` is one of ``schema.RELATIVE_PAIRS``. ``wxyz``: read the quaternions as wxyz instead of xyzw.
    """

    def read(position: str, orientation: str) -> NDArray[np.float64]:
        shift, turn = (episode.arrays[key].astype(np.float64) for key in (position, orientation))
        return from_xyzw(shift, np.roll(turn, -1 if wxyz else 0, axis=1))

    absolute, relative = read(*keys[:2]), read(*keys[2:])
    has_noise = keys == schema.RELATIVE_PAIRS[0] and set(schema.INTENDED_POSE) <= episode.arrays.keys()
    motion = compute_relative_motion(absolute, read(*schema.INTENDED_POSE) if has_noise else None)
    turn = Rotation.from_matrix(np.swapaxes(motion[:, :3, :3], 1, 2) @ relative[:, :3, :3]).magnitude()
    return np.linalg.norm(motion[:, :3, 3] - relative[:, :3, 3], axis=1), turn


def check_base_motion(episode: EpisodeArrays) -> Iterator[Violation]:
    """Check that ``rel_agv_pose`` has the differences of ``agv_pose`` between steps."""
    if {"agv_pose", "rel_agv_pose"} <= episode.arrays.keys():
        error = np.abs(compute_agv_motion(episode.arrays["agv_pose"]) - episode.arrays["rel_agv_pose"]).max()
        if error > POSITION_TOLERANCE:
            yield Violation(episode.file, "rel_agv_pose", "differences of agv_pose", f"off by {error:.3g}")


def check_values(episode: EpisodeArrays) -> Iterator[Violation]:
    """Check that numbers are within limits, sub-goal types are known, and the instruction is not empty."""
    for spec, array in _iter_schema_arrays(episode):
        if spec.limits and not spec.limits[0] <= array.min() <= array.max() <= spec.limits[1]:
            expected = f"{spec.limits[0]:g} to {spec.limits[1]:g} {spec.unit}"
            yield Violation(episode.file, spec.name, expected, f"{array.min():.3f} to {array.max():.3f}")
    types = episode.arrays.get("step_goal_type", np.zeros(0, np.str_))
    for goal_type in sorted(set(types.tolist()) - set(GOAL_TYPES)):
        yield Violation(episode.file, "step_goal_type", f"one of {', '.join(GOAL_TYPES)}", goal_type)
    if "language_goal" in episode.arrays and not str(episode.arrays["language_goal"]).strip():
        yield Violation(episode.file, "language_goal", "an instruction", "an empty text")


FORM_CHECKS: tuple[Check, ...] = (check_file, check_keys, check_shapes, check_finite)
"""Checks that arrays must pass before the other checks run."""
CONTENT_CHECKS: tuple[Check, ...] = (check_motion, check_base_motion, check_values)


def run_checks(episode: EpisodeArrays, checks: tuple[Check, ...]) -> Iterator[Violation]:
    """Yield the violations that the given checks find in the arrays of an episode."""
    return (violation for check in checks for violation in check(episode))


def _iter_schema_arrays(episode: EpisodeArrays) -> Iterator[tuple[schema.ArraySpec, NDArray]]:
    return ((SPECS[key], array) for key, array in episode.arrays.items() if key in SPECS)
