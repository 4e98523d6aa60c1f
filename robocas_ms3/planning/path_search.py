"""RRT-Connect and path shortcutting with a budget of collision checks.

A budget of checks instead of a time limit makes paths depend on the seed only, not on the load of the machine.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from robocas_ms3.planning.protocol import Array

CountFree = Callable[[Array], int]


SPARSE = 8  # every SPARSE-th configuration of an edge is checked first


class BudgetExceededError(Exception):
    """The path search has used its budget of collision checks."""


class _Tree:
    """Search tree of configurations (n,), with the index of the parent of each node."""

    def __init__(self, roots: list[Array]) -> None:
        self.qpos = np.empty((256, len(roots[0])))
        self.parent: list[int] = []
        for root in roots:
            self.add(root, -1)

    def add(self, qpos: Array, parent: int) -> int:
        count = len(self.parent)
        if count == len(self.qpos):
            self.qpos = np.concatenate([self.qpos, np.empty_like(self.qpos)])
        self.qpos[count] = qpos
        self.parent.append(parent)
        return count

    def nearest(self, qpos: Array) -> int:
        difference = self.qpos[: len(self.parent)] - qpos
        return int(np.argmin(np.einsum("ij,ij->i", difference, difference)))

    def path_to_root(self, node: int) -> list[Array]:
        chain = []
        while node >= 0:
            chain.append(self.qpos[node].copy())
            node = self.parent[node]
        return chain[::-1]


class PathSearch:
    """RRT-Connect path search in joint space.

    Args:
        count_leading_free: function that returns the number of configurations (M, n) before the first collision.
        lower: (n,) lower joint limits, rad.
        upper: (n,) upper joint limits, rad.
        step: maximum extension of a tree per sample, rad (norm over joints).
        spacing: distance between collision checks along an edge, rad (norm over joints).
    """

    def __init__(
        self, count_leading_free: CountFree, lower: Array, upper: Array, *, step: float, spacing: float
    ) -> None:
        self._free_until, self._lower, self._upper = count_leading_free, lower, upper
        self._step, self.spacing = step, spacing
        self._remaining_checks = 0

    def _edge_points(self, a: Array, b: Array) -> Array:
        """Return configurations (M, n) to check on the edge from ``a`` to ``b``, without ``a``.

        The budget of collision checks is reduced by M.

        Raises:
            BudgetExceededError: the budget is smaller than M.
        """
        count = max(1, int(np.ceil(np.linalg.norm(b - a) / self.spacing)))
        if self._remaining_checks < count:
            raise BudgetExceededError
        self._remaining_checks -= count
        return a + (b - a) * (np.arange(1, count + 1) / count)[:, None]

    def is_edge_free(self, a: Array, b: Array) -> bool:
        """Return whether the edge from ``a`` (collision-free) to ``b`` is collision-free.

        Every SPARSE-th configuration is checked first. Raises BudgetExceededError.
        """
        points = self._edge_points(a, b)
        points = np.concatenate([points[i::SPARSE] for i in (SPARSE - 1, *range(SPARSE - 1))])
        return self._free_until(points) == len(points)

    def connect(
        self, start: Array, goals: list[Array], rng: np.random.Generator, *, max_checks: int
    ) -> list[Array] | None:
        """Return waypoints (n,) from ``start`` to one of ``goals``, or None.

        None means that no path was found with ``max_checks`` collision checks.

        ``start`` and ``goals`` are collision-free configurations (n,).
        """
        self._remaining_checks = max_checks
        trees = (_Tree([start]), _Tree(goals))
        grow, other = 0, 1
        try:
            while True:
                sample = self._sample(start, goals, rng)
                node, _ = self._extend(trees[grow], sample, greedy=False)
                if node is not None:
                    target = trees[grow].qpos[node].copy()
                    last, reached = self._extend(trees[other], target, greedy=True)
                    if reached and last is not None:
                        ends = {grow: node, other: last}
                        forward, backward = trees[0].path_to_root(ends[0]), trees[1].path_to_root(ends[1])
                        return forward + backward[::-1][1:]
                grow, other = other, grow
        except BudgetExceededError:
            return None

    def _sample(self, start: Array, goals: list[Array], rng: np.random.Generator) -> Array:
        """Sample a configuration (n,) within the joint limits.

        Half of the samples are near the straight motion from ``start`` to a goal, since most detours are small.
        """
        if rng.random() < 0.5:
            return rng.uniform(self._lower, self._upper)
        goal = goals[int(rng.integers(len(goals)))]
        low, high = np.minimum(start, goal) - 0.7, np.maximum(start, goal) + 0.7
        return rng.uniform(np.maximum(low, self._lower), np.minimum(high, self._upper))

    def _extend(self, tree: _Tree, target: Array, *, greedy: bool) -> tuple[int | None, bool]:
        """Extend a tree towards ``target`` by one step.

        With ``greedy`` the tree is extended as far as the edge is collision-free.

        Returns:
            Index of the last new node, or None if the first configuration collides; whether the target is reached.
        """
        node = tree.nearest(target)
        here = tree.qpos[node].copy()
        distance = float(np.linalg.norm(target - here))
        if distance <= 1e-9:
            return node, True
        arrives = greedy or distance <= self._step
        points = self._edge_points(here, target if arrives else here + (target - here) * (self._step / distance))
        free = self._free_until(points)
        every = max(1, round(self._step / self.spacing))
        for index in [*range(every, free, every), free] if free else []:
            node = tree.add(points[index - 1], node)
        return (node if free else None), arrives and free == len(points)

    def shorten(self, path: list[Array], rng: np.random.Generator, *, tries: int, max_checks: int) -> list[Array]:
        """Shorten a path of waypoints (n,); the result is as good as ``max_checks`` collision checks allow.

        First waypoints are dropped greedily. Then random points of the path are connected by straight edges, ``tries``
        times.
        """
        self._remaining_checks = max_checks
        try:
            path = self._drop_waypoints(path)
            for _ in range(tries):
                if len(path) <= 2:
                    break
                path = self._shortcut(path, rng)
        except BudgetExceededError:
            pass
        return path

    def _drop_waypoints(self, path: list[Array]) -> list[Array]:
        """Connect each waypoint to a far waypoint by a free straight edge; bisection finds the far waypoint."""
        kept, index = [path[0]], 0
        while index < len(path) - 1:
            reach = len(path) - 1
            while reach > index + 1:
                try:
                    if self.is_edge_free(path[index], path[reach]):
                        break
                except BudgetExceededError:
                    return kept + path[index + 1 :]
                reach = index + (reach - index) // 2
            kept.append(path[reach])
            index = reach
        return kept

    def _shortcut(self, path: list[Array], rng: np.random.Generator) -> list[Array]:
        points = np.array(path)
        lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
        ends = np.concatenate([[0.0], np.cumsum(lengths)])
        low, high = np.sort(rng.uniform(0, ends[-1], 2))
        first, second = (min(int(np.searchsorted(ends, at, side="right")) - 1, len(lengths) - 1) for at in (low, high))
        if first == second:
            return path
        a = points[first] + (points[first + 1] - points[first]) * ((low - ends[first]) / max(lengths[first], 1e-12))
        b = points[second] + (points[second + 1] - points[second]) * (
            (high - ends[second]) / max(lengths[second], 1e-12)
        )
        if np.linalg.norm(b - a) > 0.98 * (high - low) or not self.is_edge_free(a, b):
            return path
        return [*path[: first + 1], a, b, *path[second + 1 :]]
