"""Whether the 7 numbers of a dataset's actions say all there is to say, in the frame that policies act in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.manage.eef import eef_turn
from robocas_ms3.datasets.sources.protocol import EpisodeSource

_DRIVEN = 0.005  # m or rad; a base that stands trembles by less than a tenth of a mm


def check_stands(motion: NDArray[np.floating], where: object) -> None:
    """See that the base stands throughout an episode.

    Args:
        motion: (T, 3) its ``rel_agv_pose``: x and y in m and yaw in rad, from step to step.
        where: it is, for messages.

    Raises:
        DatasetError: it drives, in one step or slowly.
    """
    away = np.cumsum(motion, axis=0, dtype=np.float64)
    furthest = float(np.abs(np.concatenate([motion, away])).max(initial=0))
    if not furthest <= _DRIVEN:  # nor where it is no number
        raise DatasetError(
            "the base drives, which 7 numbers of an action leave out",
            where=where,
            expected=f"at most {_DRIVEN:g} m or rad away from where it began",
            found=f"{furthest:.3g}",
            fix="Train on a configuration without base_motion.",
        )


def check_tcp(source: EpisodeSource, number: int) -> None:
    """See that actions are motions of ManiSkill's TCP, by where an episode's gripper camera is.

    Raises:
        DatasetError: they are of upstream's, which is turned about its z; or nothing tells, as that camera is not
            there, and no description of the scene, which converted episodes have.
    """
    camera, episode = "gripper_camera", source.episode(number)
    if camera not in source.cameras:
        if episode.scene:
            return
        raise DatasetError(
            "nothing tells in which frame actions are",
            where=episode.where,
            expected=f"{camera}, or the scene.json of robocas convert",
            fix="robocas import-robocas makes a dataset of it that tells.",
        )
    turn = eef_turn(episode.camera_in_parent(camera))
    if turn:
        raise DatasetError(
            "actions are in another frame than policies act in",
            where=source.root,
            expected="ManiSkill's TCP",
            found=f"one that is turned by {-turn} degrees about z",
            fix="robocas import-robocas, without --no-turn-eef, makes a dataset of it that is.",
        )


def check_bases(source: EpisodeSource, numbers: Sequence[int]) -> None:
    """See that the base stands in some of a dataset's episodes.

    Raises:
        DatasetError: it drives in one of them, or that is not known.
    """
    for number in numbers:
        motion = source.episode(number).read(["rel_agv_pose"])["rel_agv_pose"]
        check_stands(motion, f"{source.root}, episode {number}")
