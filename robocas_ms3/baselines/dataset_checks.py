"""Check that a baseline can learn from a dataset, before its images are decoded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.manage.repairs import eef_turn
from robocas_ms3.datasets.sources.protocol import EpisodeSource
from robocas_ms3.robots.cameras import EE_CAMERA

_MAX_BASE_MOTION = 0.005  # m or rad; a base that stands trembles by less than a tenth of a mm


@dataclass(frozen=True)
class DatasetNeeds:
    """What a baseline needs of a dataset.

    Attributes:
        baseline: its name.
        cameras: whose images it takes.
        rate_hz: rate of its actions.
        language: whether it takes embeddings of the instructions.
        cameras_option: option that chooses other cameras, for messages.
        language_option: option that does without language; empty: there is none.
    """

    baseline: str
    cameras: Sequence[str]
    rate_hz: float
    language: bool
    cameras_option: str
    language_option: str = ""


def check_dataset(source: EpisodeSource, numbers: Sequence[int], needs: DatasetNeeds) -> None:
    """Check cameras, embeddings, rate, the frame of the actions, and that the base stands in some episodes."""
    if any(camera not in source.cameras for camera in needs.cameras):
        raise DatasetError(
            f"the dataset lacks a camera of {needs.baseline}",
            where=source.root,
            expected=", ".join(needs.cameras),
            found=", ".join(source.cameras) or "none",
            fix=f"Convert the trajectory with these cameras, or train with {needs.cameras_option}.",
        )
    if needs.language and not source.has_embeddings:
        more = f", or train with {needs.language_option}" * bool(needs.language_option)
        raise DatasetError(
            f"{needs.baseline} needs embeddings of the instructions",
            where=source.root,
            found="none",
            fix=f"Convert the trajectory with embeddings{more}; a LeRobot folder has none.",
        )
    if source.rate_hz != needs.rate_hz:
        raise DatasetError(
            f"the rate of the dataset is not that of {needs.baseline}",
            where=source.root,
            expected=f"{needs.rate_hz:g} Hz",
            found=f"{source.rate_hz:g} Hz",
            fix=f"Convert with --rate {needs.rate_hz:g}, or train with --set rate_hz={source.rate_hz:g}.",
        )
    for number in numbers[:1]:
        check_tcp_frame(source, number)
    for number in numbers:
        motion = source.episode(number).read(["rel_agv_pose"])["rel_agv_pose"]
        check_base_stands(motion, f"{source.root}, episode {number}")


def check_base_stands(motion: NDArray[np.floating], where: object) -> None:
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
