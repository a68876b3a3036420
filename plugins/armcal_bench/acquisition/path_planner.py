"""Paths between poses on which nothing comes too near."""

import heapq
from collections.abc import Callable, Sequence
from functools import cached_property
from itertools import pairwise

import numpy as np
from armcal.arm.clearance import ClearanceCheck
from armcal.base.arrays import Array

_SPREAD = 256
_TRIED_AT_ONCE = 24
_ESCAPES = 32
_NEARER_M = 1e-6

JointPath = tuple[Array, ...]
"""Joint angles to go through in turn, in straight lines of joint space; the start is the first."""


class PathPlanner:
    """Straight lines where they are clear; else the shortest path through known poses and others all over joint space.

    A lazy roadmap: a line is checked only when a shortest path would use it. [Bohlin2000]

    Attributes:
        meanwhile: called now and then during a search, which may take seconds.
    """

    def __init__(self, check: ClearanceCheck | None, limits: Array, known: Array, step: float, seed: int = 0) -> None:
        """Take what is too near (None: nothing is), and where the arm may go.

        Args:
            check: of clearance.
            limits: of the joints (joints x 2, rad).
            known: poses that are worth going through (N x joints).
            step: how far apart the poses of a line are that are checked (rad, of the joint that turns most).
            seed: of the poses that are spread.
        """
        self._check, self._limits, self._known, self._step, self._seed = check, limits, known, step, seed
        self._clear: dict[tuple[bytes, bytes], bool] = {}
        self.meanwhile: Callable[[], None] = lambda: None

    def allowed(self, pose: Array) -> bool:
        """Whether nothing is too near there (joints, rad)."""
        return self._check is None or bool(self._check(pose[:, None]).allowed[0])

    def within(self, pose: Array) -> bool:
        """Whether it lies within the limits (joints, rad)."""
        return bool(np.all((pose >= self._limits[:, 0]) & (pose <= self._limits[:, 1])))

    def trouble(self, joints: Sequence[str], pose: Array) -> str:
        """What is wrong with a pose (joints, rad); empty if nothing is."""
        rows = zip(joints, np.degrees(pose), np.degrees(self._limits), strict=True)
        parts = [
            f"{joint} stands at {angle:.1f} deg, beyond {low:.1f} to {high:.1f} deg"
            for joint, angle, (low, high) in rows
            if not low <= angle <= high
        ]
        return ", ".join([*parts, *filter(None, [self._check.worst(pose) if self._check else ""])])

    def clear(self, start: Array, goal: Array) -> bool:
        if self._check is None:
            return True
        low, high = sorted((start.tobytes(), goal.tobytes()))
        key = (low, high)
        if key not in self._clear:
            self.meanwhile()
            self._clear[key] = bool(self._check(self._line(start, goal)).allowed.all())
        return self._clear[key]

    def _line(self, start: Array, goal: Array) -> Array:
        """Poses of a straight line (joints x N)."""
        count = int(np.ceil(np.max(np.abs(goal - start)) / self._step)) + 1
        return np.asarray(start[:, None] + np.linspace(0.0, 1.0, max(count, 2)) * (goal - start)[:, None])

    def find(self, start: Array, goal: Array) -> JointPath | None:
        """A clear path, or None if none was found.

        An arm that stands too near to something, by a board's rounding or after a fault, first goes straight to a pose
        that is clear, on a line that comes nowhere nearer than where the arm stands.
        """
        if self._check is None or self.clear(start, goal):
            return (start, goal)
        if self.allowed(start):
            return self._shortest(np.vstack([start[None], goal[None], self._roadmap]))
        nodes = np.vstack([goal[None], self._roadmap])
        away = np.max(np.abs(nodes - start), axis=1)
        for node in nodes[np.argsort(away, kind="stable")[:_ESCAPES]]:
            if not self.allowed(node):
                continue
            margins = np.minimum(self._check(self._line(start, node)).margins, 0.0)
            if np.all(np.diff(margins, axis=1) >= -_NEARER_M) and (onward := self.find(node, goal)) is not None:
                return (start, *onward)
        return None

    @cached_property
    def _roadmap(self) -> Array:
        from scipy.stats import qmc

        drawn = qmc.Sobol(len(self._limits), rng=self._seed).random(_SPREAD)
        poses = self._limits[:, 0] + drawn * (self._limits[:, 1] - self._limits[:, 0])
        nodes = np.vstack([self._known, poses])
        if self._check is not None:
            nodes = nodes[self._check(np.ascontiguousarray(nodes.T)).allowed]
        return np.unique(nodes, axis=0)

    def _shortest(self, nodes: Array) -> JointPath | None:
        """A* from the first node to the second; the length of a line is that of the joint that turns most."""
        left = np.max(np.abs(nodes - nodes[1]), axis=1)
        best, before, done = {0: 0.0}, {0: 0}, set()
        queue = [(float(left[0]), 0)]
        while queue:
            _, here = heapq.heappop(queue)
            if here == 1:
                path = [here]
                while path[-1] != 0:
                    path.append(before[path[-1]])
                return tuple(nodes[i] for i in reversed(path))
            if here in done:
                continue
            done.add(here)
            away = np.max(np.abs(nodes - nodes[here]), axis=1)
            nearest = [int(i) for i in np.argsort(away, kind="stable")[1 : _TRIED_AT_ONCE + 1]]
            for there in nearest if 1 in nearest else [*nearest, 1]:
                length = best[here] + float(away[there])
                if there in done or length >= best.get(there, np.inf) or not self.clear(nodes[here], nodes[there]):
                    continue
                best[there], before[there] = length, here
                heapq.heappush(queue, (length + float(left[there]), there))
        return None


def travel(path: Sequence[Array]) -> float:
    """How far a path goes: of each leg, the joint that turns most (rad)."""
    return float(sum(np.max(np.abs(b - a)) for a, b in pairwise(path)))
