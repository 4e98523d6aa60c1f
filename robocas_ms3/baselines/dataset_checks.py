"""Checks before the training: whether a baseline can learn from a dataset."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.baselines.baseline import Split, make_empty_split_error
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.formats import detect_format, open_source
from robocas_ms3.datasets.manage.repairs import find_eef_rotation
from robocas_ms3.datasets.sources.episode_source import EpisodeSource
from robocas_ms3.robots.cameras import EE_CAMERA

_MAX_BASE_MOTION = 0.005  # m or rad; a standing base moves by less than 0.1 mm


def open_image_dataset(path: Path) -> EpisodeSource:
    """Open a dataset with images; raise DatasetError for a recording or for a folder with only a recording."""
    found, recording = detect_format(path), path
    if found is None and (path / "trajectory.h5").is_file():
        found, recording = detect_format(path / "trajectory.h5"), path / "trajectory.h5"
    if found and found.name == "trajectory" and recording.is_file():
        raise DatasetError(
            "not a dataset with images",
            where=path,
            found="a recording",
            fix=f"Render it first: robocas convert {recording} --size 512 384 --out DIR.",
        )
    return open_source(path)


def check_dataset(
    source: EpisodeSource, split: Split, cameras: Collection[str], rate_hz: float, *, language: bool
) -> list[int]:
    """Check that a baseline can learn from a split of a dataset; return the numbers of the episodes.

    The dataset must have these cameras, this rate, instruction embeddings (if ``language``), and actions in the frame
    of ManiSkill's TCP. The base must not move.

    Raises:
        DatasetError: the dataset does not fulfil one of these conditions.
        EmptySplitError: the split has no episodes.
    """
    if any(camera not in source.cameras for camera in cameras):
        fix = (
            "Convert with --cameras, or train with other cameras: --set views.CAMERA=null (small), --set cameras (rt1)."
        )
        expected, found = ", ".join(cameras), ", ".join(source.cameras) or "none"
        raise DatasetError("missing camera in the dataset", where=source.root, expected=expected, found=found, fix=fix)
    if language and not source.has_embeddings:
        fix = "Convert with embeddings (the default), or train small with --set language=false."
        raise DatasetError("no instruction embeddings in the dataset", where=source.root, fix=fix)
    if source.rate_hz != rate_hz:
        fix = f"Convert with --rate {rate_hz:g}, or train with --set rate_hz={source.rate_hz:g}."
        expected, found = f"{rate_hz:g} Hz", f"{source.rate_hz:g} Hz"
        raise DatasetError(
            "the dataset has another rate than the policy", where=source.root, expected=expected, found=found, fix=fix
        )
    numbers = source.split(split)
    if not numbers:
        raise make_empty_split_error(source.root, split)
    check_tcp_frame(source, numbers[0])
    for number in numbers:
        motion = source.episode(number).read(["rel_agv_pose"])["rel_agv_pose"]
        check_base_is_fixed(motion, f"{source.root}, episode {number}")
    return numbers


def check_base_is_fixed(motion: NDArray[np.floating], where: object) -> None:
    """Check that the base does not move, because 7-D actions cannot move it.

    Args:
        motion: (T, 3) motion of the base per step: x and y in m, yaw in rad.
        where: file and episode; the error shows it.

    Raises:
        DatasetError: the base moves by more than 5 mm or 0.005 rad.
    """
    path = np.cumsum(motion, axis=0, dtype=np.float64)
    furthest = float(np.abs(np.concatenate([motion, path])).max(initial=0))
    if not furthest <= _MAX_BASE_MOTION:  # NaN is refused too
        raise DatasetError(
            "the base moves, and 7-D actions cannot move it",
            where=where,
            expected=f"at most {_MAX_BASE_MOTION:g} m or rad from its first pose",
            found=f"{furthest:.3g} m or rad",
            fix="Record with a task configuration without base_motion.",
        )


def check_tcp_frame(source: EpisodeSource, number: int) -> None:
    """Check that the actions of an episode are in the frame of ManiSkill's TCP.

    `robocas convert` writes such actions, and ``scene.json`` shows that it wrote the episode. For other episodes the
    pose of the gripper camera shows the frame of the actions.

    Raises:
        DatasetError: the actions are in RoboCAS-v0's frame, which is rotated about z; or the frame is unknown, because
            the episode has neither a gripper camera nor a ``scene.json``.
    """
    camera, episode = EE_CAMERA, source.episode(number)
    if episode.scene.get("env_info"):  # recorded by this package, always in the frame of ManiSkill's TCP
        return
    if camera not in source.cameras:
        if episode.scene:
            return
        raise DatasetError(
            "unknown frame of the actions",
            where=episode.where,
            expected=f"{camera}, or a scene.json written by robocas convert",
            found="neither",
            fix="Import the dataset with `robocas import-robocas`.",
        )
    turn = find_eef_rotation(episode.camera_in_parent(camera))
    if turn:
        raise DatasetError(
            "the actions are not in the frame of ManiSkill's TCP",
            where=source.root,
            found=f"a frame rotated by {-turn} degrees about z, as in RoboCAS-v0",
            fix="Import the dataset with `robocas import-robocas`, without --no-turn-eef.",
        )
