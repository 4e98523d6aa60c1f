"""Checks that a dataset suits a baseline, before its images are decoded."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.baselines.baseline import Split, empty_split_error
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.manage.repairs import eef_turn
from robocas_ms3.datasets.sources.episode_source import EpisodeSource
from robocas_ms3.robots.cameras import EE_CAMERA

_MAX_BASE_MOTION = 0.005  # m or rad; a standing base moves by less than 0.1 mm


def check_dataset(
    source: EpisodeSource, split: Split, cameras: Collection[str], rate_hz: float, *, language: bool
) -> list[int]:
    """Check that a split suits a baseline, and return the numbers of its episodes.

    Checks the cameras, the instruction embeddings (with ``language``), the rate, the frame of the actions, and that the
    base does not move.

    Raises:
        DatasetError: one of these is missing or differs.
        EmptySplitError: the split has no episodes.
    """
    if any(camera not in source.cameras for camera in cameras):
        fix = "Convert the trajectory with these cameras, or choose cameras: --set cameras (rt1), --set views (small)."
        expected, found = ", ".join(cameras), ", ".join(source.cameras) or "none"
        raise DatasetError("missing camera in the dataset", where=source.root, expected=expected, found=found, fix=fix)
    if language and not source.has_embeddings:
        fix = "Convert the trajectory with embeddings, or train small with --set language=false."
        raise DatasetError("no instruction embeddings in the dataset", where=source.root, fix=fix)
    if source.rate_hz != rate_hz:
        fix = f"Convert with --rate {rate_hz:g}, or train with --set rate_hz={source.rate_hz:g}."
        expected, found = f"{rate_hz:g} Hz", f"{source.rate_hz:g} Hz"
        raise DatasetError("wrong rate of the dataset", where=source.root, expected=expected, found=found, fix=fix)
    numbers = source.split(split)
    if not numbers:
        raise empty_split_error(source.root, split)
    check_tcp_frame(source, numbers[0])
    for number in numbers:
        motion = source.episode(number).read(["rel_agv_pose"])["rel_agv_pose"]
        check_base_is_fixed(motion, f"{source.root}, episode {number}")
    return numbers


def check_base_is_fixed(motion: NDArray[np.floating], where: object) -> None:
    """Check that the base does not move, which 7-D actions cannot express.

    Args:
        motion: (T, 3) motion of the base per step, m, m, rad.
        where: place of the episode, for the error.

    Raises:
        DatasetError: the base moves.
    """
    path = np.cumsum(motion, axis=0, dtype=np.float64)
    furthest = float(np.abs(np.concatenate([motion, path])).max(initial=0))
    if not furthest <= _MAX_BASE_MOTION:  # NaN is refused too
        raise DatasetError(
            "the base moves, which 7-D actions cannot express",
            where=where,
            expected=f"within {_MAX_BASE_MOTION:g} m or rad of its first pose",
            found=f"{furthest:.3g}",
            fix="Train on a configuration without base_motion.",
        )


def check_tcp_frame(source: EpisodeSource, number: int) -> None:
    """Check that actions are in the frame of ManiSkill's TCP.

    Episodes of `robocas convert` are. For other datasets the pose of the gripper camera shows the frame.

    Raises:
        DatasetError: the actions are in RoboCAS-v0's frame, which is rotated about z; or the frame is unknown, because
            neither the gripper camera nor ``scene.json`` is there.
    """
    camera, episode = EE_CAMERA, source.episode(number)
    if episode.scene.get("env_info"):  # recorded by this package, in that frame, wherever the camera is mounted
        return
    if camera not in source.cameras:
        if episode.scene:
            return
        raise DatasetError(
            "unknown frame of the actions",
            where=episode.where,
            expected=f"{camera}, or the scene.json of robocas convert",
            fix="Import the dataset with `robocas import-robocas`.",
        )
    turn = eef_turn(episode.camera_in_parent(camera))
    if turn:
        raise DatasetError(
            "wrong frame of the actions",
            where=source.root,
            expected="frame of ManiSkill's TCP",
            found=f"a frame rotated by {-turn} degrees about z",
            fix="Import the dataset with `robocas import-robocas`, without --no-turn-eef.",
        )
