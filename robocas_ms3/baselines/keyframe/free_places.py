"""Free places of a surface, from a map of observed heights."""

from __future__ import annotations

import numpy as np

from robocas_ms3.core.poses import Array

_MAP_X, _MAP_Y, _MAP_CELL = (0.2, 1.05), (-0.8, 0.8), 0.02  # m
_FREE_CELLS = (11, 7)  # sizes of free squares in cells, the preferred one first
_PLACES = 20
_PLACE_DISTANCES = (0.35, 0.8)  # m from the base, least and greatest distance of a free place


class HeightMap:
    """Greatest observed height of each cell of the workspace; NaN where nothing was observed."""

    def __init__(self) -> None:
        shape = tuple(round((high - low) / _MAP_CELL) for low, high in (_MAP_X, _MAP_Y))
        self.heights = np.full(shape, np.nan)

    def update(self, points: Array) -> None:
        """Replace the heights of the cells that have points (P, 3)."""
        cells = np.floor((points[:, :2] - (_MAP_X[0], _MAP_Y[0])) / _MAP_CELL).astype(int)
        inside = ((cells >= 0) & (cells < self.heights.shape)).all(axis=1)
        new = np.full(self.heights.shape, -np.inf)
        np.maximum.at(new, tuple(cells[inside].T), points[inside, 2])
        observed = np.isfinite(new)
        self.heights[observed] = new[observed]

    def find_free_squares(self, table: float, cells: int) -> Array:
        """Return the middles (N, 2) of squares of ``cells`` x ``cells`` cells on the surface with nothing on it, m."""
        free = np.isfinite(self.heights) & (self.heights < table + 0.012)
        windows = np.lib.stride_tricks.sliding_window_view(free, (cells, cells)).all(axis=(2, 3))
        squares = (np.argwhere(windows) + cells / 2) * _MAP_CELL + (_MAP_X[0], _MAP_Y[0])
        return np.asarray(squares, np.float64)

    def find_free_places(self, table: float, near: Array, avoid: list[tuple[Array, float]]) -> Array:
        """Return free places (N, 2) of the surface, the nearest first, m.

        Args:
            table: height of the surface, m.
            near: (2,) point from which the distances are measured, m.
            avoid: points (2,) with the least distance of a free place from each, m.
        """
        for cells in _FREE_CELLS:
            places = self.find_free_squares(table, cells)
            distance = np.linalg.norm(places, axis=1)
            fits = (distance > _PLACE_DISTANCES[0]) & (distance < _PLACE_DISTANCES[1])
            for point, gap in avoid:
                fits &= np.linalg.norm(places - point, axis=1) > gap
            if fits.any():
                places = places[fits]
                order = np.argsort(np.linalg.norm(places - near, axis=1), kind="stable")
                return places[order[: 2 * _PLACES : 2]]  # neighbours are 2 cm apart
        return np.zeros((0, 2))
