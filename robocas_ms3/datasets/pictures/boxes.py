"""Boxes of objects in images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Box = tuple[int, int, int, int]
"""x_min, y_min, x_max, y_max: first and last column and row of the pixels, from 0 at the top left."""


def box_of(mask: NDArray[np.bool_]) -> Box | None:
    """Return the box around the pixels of a mask (H, W), or None where there are none."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    return int(columns[0]), int(rows[0]), int(columns[-1]), int(rows[-1])
