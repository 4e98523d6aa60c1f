"""Refuse numbers that no plan can be made with."""

from __future__ import annotations

import numpy as np

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.planning.protocol import Array


def require_finite(values: Array, where: object, fix: str = "Check how the numbers were computed.") -> None:
    """Refuse NaN and infinite numbers.

    Args:
        values: any shape.
        where: argument or method, for the error.
        fix: for the error.

    Raises:
        RobocasError: some value is NaN or infinite.
    """
    finite = np.isfinite(values)
    if not finite.all():
        found = f"{np.size(finite) - np.count_nonzero(finite)} of {np.size(finite)} are not finite"
        raise RobocasError("NaN or infinite numbers", where=where, expected="finite numbers", found=found, fix=fix)
