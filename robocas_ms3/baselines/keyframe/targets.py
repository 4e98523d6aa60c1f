"""Choice of the target among the objects that may be the one that an instruction names."""

from __future__ import annotations

import numpy as np

from robocas_ms3.baselines.keyframe.observed_scene import ObservedObject
from robocas_ms3.core.poses import Array
from robocas_ms3.scenes.relations import Relation, select_by_relation

_SURE = 0.6  # probability of a target, above which less probable targets are ignored
_SAME_TARGET = 0.05  # m between the centres of the target in two views


class TargetChoice:
    """Choice of the target in one view after another.

    A relation is resolved in the first view, because later views may show fewer of the objects with this name.

    Args:
        relation: relation that distinguishes the target from other objects of the same name, or None: the nearest to
            the arm's base is meant.
    """

    def __init__(self, relation: Relation | None) -> None:
        self._relation: Relation | None = relation
        self._last_xy: Array | None = None  # predicted centre in the last view that showed the target

    def choose(self, found: list[ObservedObject]) -> ObservedObject | None:
        """Return the target among the objects of a view that may be the target, or None without objects."""
        if not found:
            return None
        sure = [one for one in found if one.probability > _SURE] or found
        xy = np.stack([one.center[:2] for one in sure])
        index = None
        if self._last_xy is not None:
            distances = np.linalg.norm(xy - self._last_xy, axis=1)
            index = int(distances.argmin()) if distances.min() < _SAME_TARGET else None
        if index is None and self._relation is not None:
            index = select_by_relation(self._relation, xy, 0.0)
        if index is None:  # without a relation, or if it fits no object
            index = int(np.linalg.norm(xy, axis=1).argmin())
        self._last_xy = xy[index]
        return sure[index]
