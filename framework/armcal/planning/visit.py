"""The order in which planned poses are visited: soonest done, or so that no servo runs hot."""

from collections.abc import Callable

import numpy as np

from armcal.base.arrays import Array, Indices

WINDOW = 5  # Poses over which squared torque is averaged: a servo warms and cools over about so many
_MOST_SWAPPED = 300
_MOST_PASSES = 50


def travel_times(joint_angles: Array, speeds: Array) -> Array:
    """Seconds between poses (N x N): the joint that needs longest, at its speed (joints; rad/s or m/s)."""
    scaled = joint_angles / speeds[:, None]
    times = np.zeros((scaled.shape[1],) * 2)
    for joint in scaled:
        np.maximum(times, np.abs(joint[:, None] - joint[None, :]), out=times)
    return times


def path_time(times: Array, order: Indices) -> float:
    return float(times[order[:-1], order[1:]].sum())


def quick_order(times: Array) -> Indices:
    """Nearest neighbour from every start, the best improved by turning stretches round (2-opt)."""
    number = len(times)
    if number < 3:
        return np.arange(number)
    paths = []
    for start in np.unique(np.linspace(0, number - 1, min(number, 50)).astype(int)):
        path, left = [int(start)], np.arange(number) != start
        while left.any():
            path.append(int(np.argmin(np.where(left, times[path[-1]], np.inf))))
            left[path[-1]] = False
        paths.append(np.array(path, dtype=np.intp))
    order = min(paths, key=lambda path: path_time(times, path))
    for _ in range(_MOST_PASSES):
        improved = False
        for i in range(number - 1):
            ends = np.arange(i + 1, number)
            into = times[order[i - 1], order[ends]] - times[order[i - 1], order[i]] if i else np.zeros(len(ends))
            after = times[order[i], order[ends[:-1] + 1]] - times[order[ends[:-1]], order[ends[:-1] + 1]]
            change = into + np.append(after, 0.0)
            best = int(np.argmin(change))
            if change[best] < -1e-9:
                order[i : ends[best] + 1] = order[i : ends[best] + 1][::-1].copy()
                improved = True
        if not improved:
            break
    return order


def heat(efforts: Array) -> Array:
    """Squared effort of each joint beside the largest it has in the plan (joints x N)."""
    largest = np.max(np.abs(efforts), axis=1, keepdims=True)
    return np.asarray((efforts / np.where(largest > 0, largest, 1.0)) ** 2)


def peak(heats: Array, order: Indices, window: int = WINDOW) -> float:
    window = min(window, len(order))
    sums = np.cumsum(np.pad(heats[:, order], ((0, 0), (1, 0))), axis=1)
    return float(np.max(sums[:, window:] - sums[:, :-window]) / window)


def cool_order(heats: Array, times: Array) -> Indices:
    """Hot poses among cool ones: the smallest peak that swaps can reach, then the shortest way with no higher peak."""
    by_heat = np.argsort(-heats.max(axis=0), kind="stable")
    hot, order = (len(by_heat) + 1) // 2, np.empty(len(by_heat), dtype=np.intp)
    order[0::2], order[1::2] = by_heat[:hot], by_heat[hot:][::-1]  # hottest and coolest by turns
    if len(order) < 3 or len(order) > _MOST_SWAPPED:
        return order
    order = _swapped(order, lambda path: peak(heats, path))
    limit = peak(heats, order) * (1 + 1e-9)
    return _swapped(order, lambda path: path_time(times, path) if peak(heats, path) <= limit else np.inf)


def _swapped(order: Indices, cost: Callable[[Indices], float]) -> Indices:
    """Swap pairs while that lowers the cost."""
    here = cost(order)
    for _ in range(_MOST_PASSES):
        before = here
        for i in range(len(order) - 1):
            for j in range(i + 1, len(order)):
                order[i], order[j] = order[j], order[i]
                there = cost(order)
                if there < here * (1 - 1e-12):
                    here = there
                else:
                    order[i], order[j] = order[j], order[i]
        if here >= before:
            break
    return order
