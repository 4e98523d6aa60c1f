"""Repairs of the arrays of an episode in the format of RoboCAS-v0."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks import arrays as array_checks
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.images.image_files import ImageOptions
from robocas_ms3.datasets.sources.arrays import SPECS, EpisodeArrays, compute_motion_arrays
from robocas_ms3.demos.recordings.motion import compute_agv_motion
from robocas_ms3.robots.quantities import to_continuous_xyzw

EMBEDDINGS = tuple(spec.name for spec in schema.EPISODE_INFO if spec.embedding)
_ESSENTIAL = ("ee_pos", "ee_orn", "gripper_status", "language_goal", "step_lang_goals", "step_goal_type")
_CAMERA_OFFSET = (0.03, 0.07)  # m: the gripper camera is 0.05 m from the axis of the hand

Outcome = Literal["skipped", "repaired", "warning"]
"""skipped: the episode is not imported; repaired; warning: the episode is imported with the finding."""
Keys = tuple[str, str, str, str]
"""One of ``schema.RELATIVE_PAIRS``."""


@dataclass(frozen=True)
class Finding:
    """Violation found by an import.

    Attributes:
        episode: number of the episode; None for a violation of the whole dataset.
        outcome: skipped, repaired or warning.
        repair: description of the change, or empty.
    """

    episode: int | None
    violation: Violation
    outcome: Outcome
    repair: str = ""

    @property
    def problem(self) -> str:
        """Text with the found and the expected value, and the repair."""
        wrong = f"found {self.violation.found}, expected {self.violation.expected}"
        return f"{wrong}: {self.repair}" if self.repair else wrong

    def as_json(self) -> dict[str, Any]:
        where = self.violation.where
        return {"episode": self.episode, "file": where, "problem": self.problem, "outcome": self.outcome}


@dataclass
class ImportedEpisode:
    """Episode of an input dataset while it is checked and repaired.

    Attributes:
        number: number of the episode.
        stored: its arrays, with the repairs so far.
        findings: violations found so far.
        eef_rotation_deg: rotation of its EEF frame about z by the repair, degrees.
        image_options: cameras, size, depth and format of its images; None: not checked yet.
    """

    number: int
    stored: EpisodeArrays
    findings: list[Finding] = field(default_factory=list)
    eef_rotation_deg: int = 0
    image_options: ImageOptions | None = None

    @property
    def is_importable(self) -> bool:
        return all(found.outcome != "skipped" for found in self.findings)

    @property
    def has_embeddings(self) -> bool:
        return set(EMBEDDINGS) <= self.stored.arrays.keys()

    def add_finding(self, violation: Violation, outcome: Outcome, repair: str = "") -> None:
        self.findings.append(Finding(self.number, violation, outcome, repair))

    def set_arrays(self, arrays: Mapping[str, NDArray]) -> None:
        self.stored = _replace_arrays(self.stored, arrays)


def add_key_findings(episode: ImportedEpisode, loaded: EpisodeArrays) -> None:
    """Add a finding for each missing, unreadable or unknown key of the loaded arrays."""
    for wrong in (*array_checks.check_file(loaded), *array_checks.check_keys(loaded)):
        if wrong.kind == "unexpected":
            episode.add_finding(wrong, "warning", "not imported")
        elif wrong.key in episode.stored.derived:
            episode.add_finding(wrong, "repaired", f"derived from {episode.stored.derived[wrong.key]}")
        elif wrong.key in EMBEDDINGS:
            episode.add_finding(wrong, "warning", "not imported")
        elif wrong.kind != "missing" or wrong.key in _ESSENTIAL:
            episode.add_finding(wrong, "skipped")
        else:
            episode.add_finding(wrong, "warning", "can't be derived")


def repair_arrays(episode: ImportedEpisode) -> None:
    """Repair the shapes, then the unit vectors, then the content of the arrays.

    If a repair fails, the episode gets a finding with the outcome ``skipped``, and the next repairs are omitted.
    """
    for stage in (_repair_shapes, _drop_invalid_unit_vectors, _repair_content):
        if episode.is_importable:
            stage(episode)


def _repair_shapes(episode: ImportedEpisode) -> None:
    stored = episode.stored
    for wrong in [*array_checks.check_shapes(stored), *array_checks.check_finite(stored)]:
        if wrong.key == "episode_length" and 0 < stored.steps <= schema.MAX_STEPS:
            episode.set_arrays({wrong.key: SPECS[wrong.key].cast(stored.steps)})
            episode.add_finding(wrong, "repaired")
        else:
            _drop_or_skip(episode, wrong)


def _drop_invalid_unit_vectors(episode: ImportedEpisode) -> None:
    for wrong in [*array_checks.check_unit_length(episode.stored)]:
        _drop_or_skip(episode, wrong)


def _drop_or_skip(episode: ImportedEpisode, wrong: Violation) -> None:
    """Remove the invalid array if it is an embedding; otherwise mark the episode as skipped."""
    if wrong.key not in EMBEDDINGS:
        episode.add_finding(wrong, "skipped")
        return
    arrays = {key: array for key, array in episode.stored.arrays.items() if key != wrong.key}
    episode.stored = replace(episode.stored, arrays=arrays)
    episode.add_finding(wrong, "warning", "not imported")


def _repair_content(episode: ImportedEpisode) -> None:
    for keys in schema.RELATIVE_PAIRS:
        _repair_motion(episode, keys)
    for wrong in [*array_checks.check_base_motion(episode.stored)]:
        episode.set_arrays({wrong.key: SPECS[wrong.key].cast(compute_agv_motion(episode.stored.arrays["agv_pose"]))})
        episode.add_finding(wrong, "repaired", "derived from agv_pose")
    for wrong in array_checks.check_values(episode.stored):
        episode.add_finding(wrong, "skipped" if wrong.key == "language_goal" else "warning")


def _repair_motion(episode: ImportedEpisode, keys: Keys) -> None:
    """Convert the relative motion from the convention in which it agrees with the poses, if there is one."""
    stored = episode.stored
    found = list(array_checks.check_relative_poses(stored, keys))
    for repair, converted, repaired in _CONVENTIONS if found else ():
        if not any(array_checks.check_relative_poses(_replace_arrays(stored, converted(stored.arrays, keys)), keys)):
            episode.set_arrays(repaired(stored.arrays, keys))
            for wrong in found:
                episode.add_finding(wrong, "repaired", repair)
            return
    for wrong in found:
        episode.add_finding(wrong, "skipped")


def _replace_arrays(stored: EpisodeArrays, arrays: Mapping[str, NDArray]) -> EpisodeArrays:
    return replace(stored, arrays={**stored.arrays, **arrays})


def _convert_from_wxyz(arrays: Mapping[str, NDArray], keys: Keys) -> dict[str, NDArray]:
    return {key: np.ascontiguousarray(np.roll(arrays[key], -1, axis=1)) for key in (keys[1], keys[3])}


def _shift_from_next_step(arrays: Mapping[str, NDArray], keys: Keys) -> dict[str, NDArray]:
    return _set_last_row_to_identity({key: np.roll(arrays[key], -1, axis=0) for key in keys[2:]}, keys)


def _set_last_row_to_identity(arrays: Mapping[str, NDArray], keys: Keys) -> dict[str, NDArray]:
    last = {keys[2]: [0, 0, 0], keys[3]: [0, 0, 0, 1]}
    return {key: np.vstack([arrays[key][:-1], row]).astype(arrays[key].dtype) for key, row in last.items()}


_CONVENTIONS = (  # description, conversion to compare with the poses, repair
    ("converted from wxyz", _convert_from_wxyz, _convert_from_wxyz),
    ("moved by one step (convention of the paper)", _shift_from_next_step, compute_motion_arrays),
    ("the last row set to the identity", _set_last_row_to_identity, compute_motion_arrays),
)


def find_eef_rotation(camera_in_ee: NDArray) -> int:
    """Find the rotation about z from the EEF frame of a dataset to ManiSkill's TCP.

    The result is 0, 90, 180 or -90 degrees. ``camera_in_ee`` (4, 4) is the pose of the gripper camera in the EEF frame.
    The camera is 0.05 m from the axis of the hand, in the x direction of ManiSkill's TCP. The EEF frame of RoboCAS-v0
    is rotated by -90 degrees. The result is 0 for a camera in another place.
    """
    x, y = camera_in_ee[:2, 3]
    if not _CAMERA_OFFSET[0] < np.hypot(x, y) < _CAMERA_OFFSET[1]:
        return 0
    angle = np.rad2deg(np.arctan2(y, x))
    quarter = round(angle / 90)
    return (quarter % 4 if quarter % 4 != 3 else -1) * 90 if abs(angle - quarter * 90) < 5 else 0


def rotate_eef_frame(episode: ImportedEpisode, degrees: int) -> None:
    """Rotate the EEF frame of an episode about its z axis, and compute the relative motion again."""
    arrays = episode.stored.arrays
    turns = Rotation.from_quat(arrays["ee_orn"]) * Rotation.from_euler("z", degrees, degrees=True)
    arrays = {**arrays, "ee_orn": SPECS["ee_orn"].cast(to_continuous_xyzw(turns.as_matrix()))}
    episode.set_arrays({**arrays, **compute_motion_arrays(arrays, schema.RELATIVE_PAIRS[0])})
    episode.eef_rotation_deg = degrees
    wrong = Violation(episode.stored.file, "ee_orn, rel_pos, rel_orn", "ManiSkill's TCP frame", "another frame")
    episode.add_finding(wrong, "repaired", f"rotated by {degrees} degrees about z")
