"""Check that a baseline can learn from a dataset, before its images are decoded."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.baselines.baseline import Split, empty_split_error
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.manage.repairs import eef_turn
from robocas_ms3.datasets.sources.episode_source import EpisodeSource
from robocas_ms3.robots.cameras import EE_CAMERA

_MAX_BASE_MOTION = 0.005  # m or rad; a base that stands trembles by less than a tenth of a mm


def check_dataset(
    source: EpisodeSource, split: Split, cameras: Collection[str], rate_hz: float, *, language: bool
) -> list[int]:
    """Check that a split has what a baseline learns from, and return the numbers of its episodes.

    Checked are cameras, embeddings of the instructions with ``language``, the rate, the frame of the actions, and that
    the base stands.

    Raises:
        DatasetError: something of that is missing or another.
        EmptySplitError: the split has no episodes.
    """
    if any(camera not in source.cameras for camera in cameras):
        fix = "Convert the trajectory with these cameras, or choose others: --set cameras or --set views."
        expected, found = ", ".join(cameras), ", ".join(source.cameras) or "none"
        raise DatasetError("the dataset lacks a camera", where=source.root, expected=expected, found=found, fix=fix)
    if language and not source.has_embeddings:
        fix = "Convert the trajectory with embeddings; small can do without: --set language=false."
        raise DatasetError("the dataset has no embeddings of the instructions", where=source.root, fix=fix)
    if source.rate_hz != rate_hz:
        fix = f"Convert with --rate {rate_hz:g}, or train with --set rate_hz={source.rate_hz:g}."
        expected, found = f"{rate_hz:g} Hz", f"{source.rate_hz:g} Hz"
        raise DatasetError("the dataset has another rate", where=source.root, expected=expected, found=found, fix=fix)
    numbers = source.split(split)
    if not numbers:
        raise empty_split_error(source.root, split)
    check_tcp_frame(source, numbers[0])
    for number in numbers:
        motion = source.episode(number).read(["rel_agv_pose"])["rel_agv_pose"]
        check_base_is_fixed(motion, f"{source.root}, episode {number}")
    return numbers


def check_base_is_fixed(motion: NDArray[np.floating], where: object) -> None:
    """Check that a base stands, of motions (T, 3) in m, m and rad per step: actions of 7 numbers leave it out."""
    path = np.cumsum(motion, axis=0, dtype=np.float64)
    furthest = float(np.abs(np.concatenate([motion, path])).max(initial=0))
    if not furthest <= _MAX_BASE_MOTION:  # NaN is refused too
        raise DatasetError(
            "the base drives, which actions of 7 numbers leave out",
            where=where,
            expected=f"at most {_MAX_BASE_MOTION:g} m or rad away from its first pose",
            found=f"{furthest:.3g}",
            fix="Train on a configuration without base_motion.",
        )


def check_tcp_frame(source: EpisodeSource, number: int) -> None:
    """Check that actions are in the frame of ManiSkill's TCP, as those of our recordings are.

    For a dataset made elsewhere, the pose of the gripper camera tells the frame.

    Raises:
        DatasetError: they are in RoboCAS-v0's frame, which is turned about z; or the frame is not known, as there is
            neither that camera nor the scene description of converted episodes.
    """
    camera, episode = EE_CAMERA, source.episode(number)
    if episode.scene.get("env_info"):  # recorded here, in that frame, wherever its configuration puts the camera
        return
    if camera not in source.cameras:
        if episode.scene:
            return
        raise DatasetError(
            "the frame of the actions is not known",
            where=episode.where,
            expected=f"{camera}, or the scene.json of robocas convert",
            fix="robocas import-robocas makes a dataset of it with a known frame.",
        )
    turn = eef_turn(episode.camera_in_parent(camera))
    if turn:
        raise DatasetError(
            "actions are in another frame than policies act in",
            where=source.root,
            expected="ManiSkill's TCP",
            found=f"one that is turned by {-turn} degrees about z",
            fix="robocas import-robocas, without --no-turn-eef, turns them.",
        )
