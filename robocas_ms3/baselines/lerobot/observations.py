"""What a LeRobot policy of ours sees, the same numbers in training and over the socket. NumPy alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

STATE, EMBEDDING, ACTION = "observation.state", "observation.environment_state", "action"
"""Keys of LeRobot. Its policies take what is no robot's as the environment's state; ours holds the instruction."""
STATE_NAMES = (
    *("x", "y", "z"),
    *("xx", "xy", "xz", "yx", "yy", "yz"),
    *(f"joint_{number}" for number in range(1, 8)),
    "gripper_width",
)
"""TCP in the arm's base, m; its x and y axes there; rad; m."""
DIMENSIONS = 384  # of an embedding


def state_of(position: NDArray, xyzw: NDArray, joints: NDArray, width: NDArray) -> NDArray[np.float32]:
    """(N, 17) of `STATE_NAMES`.

    Axes stand for the orientation, as a hand that points down has a quaternion whose sign is a matter of chance. Where
    the base stands is left out: the socket does not tell it.

    Args:
        position: (N, 3) m, of the TCP in the arm's base.
        xyzw: (N, 4) its orientation there.
        joints: (N, 7) rad.
        width: (N, 1) m.
    """
    turns = Rotation.from_quat(np.asarray(xyzw, np.float64)).as_matrix()
    return np.concatenate([position, turns[:, :, 0], turns[:, :, 1], joints, width], axis=1).astype(np.float32)


def scaled(embeddings: NDArray) -> NDArray[np.float32]:
    """Embeddings (N, 384) of unit length, so that a number of them is about 1; LeRobot leaves them as they are."""
    return (np.asarray(embeddings) * np.sqrt(DIMENSIONS)).astype(np.float32)
