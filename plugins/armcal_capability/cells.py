"""Cells of the workspace: the map of all postures, and areas, how much of a box the tool reaches and how well."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from armcal.base.arrays import Array, Indices, Mask
from numpy.typing import NDArray

from armcal_capability.inverse import Pointing, reach_for
from armcal_capability.mechanics import MechanicsFunction
from armcal_capability.quantities import BY_NAME, Postures, Weights, postures_at
from armcal_capability.settings import AreaSettings


@dataclass(frozen=True)
class Voxels:
    """Cells that hold a tool position.

    Attributes:
        size: of a cell's side (m).
        places: whole-number places of the cells (cells x 3); a cell's centre is at (place + 1/2) size.
        counts: postures in each (cells).
        values: by quantity: best, mean and worst (3 x cells; in the quantity's unit).
    """

    size: float
    places: NDArray[np.int64]
    counts: NDArray[np.int64]
    values: Mapping[str, Array]

    @property
    def centres(self) -> Array:
        """Of the cells (cells x 3; m, base frame)."""
        return np.asarray((self.places + 0.5) * self.size)

    def mean(self, name: str) -> Array:
        return np.asarray(self.values[name][1])


def voxels_of(postures: Postures, size: float) -> Voxels:
    places = np.floor(postures.positions / size).astype(np.int64)
    cells, cell, counts = np.unique(places, axis=0, return_inverse=True, return_counts=True)
    values = grouped(postures.values, cell.ravel(), len(cells))
    return Voxels(size, cells.reshape(-1, 3), counts, values)


def grouped(values: Mapping[str, Array], group: Indices, count: int) -> dict[str, Array]:
    """Best, mean and worst (3 x count) of quantities by group; not a number where a group has none."""
    members = np.bincount(group, minlength=count)
    order = np.argsort(group, kind="stable")
    filled = np.flatnonzero(members)
    starts = np.concatenate([[0], np.cumsum(members[filled])[:-1]]).astype(np.intp)
    statistics = {}
    for name, value in values.items():
        rows = np.full((3, count), np.nan)
        if len(filled):
            ordered = value[order]
            low, high = np.minimum.reduceat(ordered, starts), np.maximum.reduceat(ordered, starts)
            best, worst = (low, high) if BY_NAME[name].good == "low" else (high, low)
            rows[:, filled] = best, np.add.reduceat(ordered, starts) / members[filled], worst
        statistics[name] = rows
    return statistics


@dataclass(frozen=True)
class AreaMap:
    """An area, cell by cell.

    Attributes:
        centres: of its cells (cells x 3; m, base frame).
        counts: postures found that bring the tool to the centre (cells).
        held: whether in one of them no servo carries more than it holds (cells); None where that is not stated.
        values: by quantity: best, mean and worst of the postures (3 x cells; not a number where there is none).
    """

    centres: Array
    counts: NDArray[np.int64]
    held: Mask | None
    values: Mapping[str, Array]

    @property
    def reached(self) -> Mask:
        return np.asarray(self.counts > 0)


def cells_of(area: AreaSettings, size: float) -> Array:
    """Centres of equal cells that fill a box, none longer than ``size`` (cells x 3; m)."""
    low, high = np.array(area.low), np.array(area.high)
    numbers = np.maximum(np.ceil((high - low) / size - 1e-9), 1).astype(int)
    axes = [low[i] + (np.arange(n) + 0.5) * (high[i] - low[i]) / n for i, n in enumerate(numbers)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class AreaSearch:
    """Searches areas for one arm.

    Attributes:
        function: the arm's mechanics.
        limits: of the commands (joints x 2).
        allowed: which commands (joints x N) keep their clearance.
        weights: of the quantities.
        sampled: postures spread over joint space, to start from.
    """

    function: MechanicsFunction
    limits: Array
    allowed: Callable[[Array], Mask]
    weights: Weights
    sampled: Postures

    def __call__(self, area: AreaSettings, size: float, most: int) -> AreaMap:
        """An area cut into cells of ``size`` (m), with at ``most`` so many postures sought for each."""
        from scipy.spatial import cKDTree

        centres = cells_of(area, size)
        pointing = Pointing.of(area.tool) if area.tool is not None else None
        # start from the sampled postures nearest to each centre, rad counted as metres by the length
        where, targets = self.sampled.positions, centres
        if pointing is not None:
            away = np.maximum(pointing.angles(self.sampled.rotations) - pointing.within, 0.0) * self.weights.length
            where = np.column_stack([where, away])
            targets = np.column_stack([centres, np.zeros(len(centres))])
        nearest = cKDTree(where).query(targets, k=min(most, len(where)))[1].reshape(-1)
        starts = np.asarray(self.sampled.commands[:, nearest])
        cell = np.repeat(np.arange(len(centres)), starts.shape[1] // len(centres))
        length = self.weights.length
        commands, arrived = reach_for(self.function, centres[cell].T, starts, self.limits, length, pointing)
        good = np.flatnonzero(arrived)
        good = good[self.allowed(commands[:, good])] if len(good) else good
        postures = postures_at(self.function, commands[:, good], self.weights)
        counts = np.bincount(cell[good], minlength=len(centres)).astype(np.int64)
        values = grouped(postures.values, cell[good], len(centres))
        held = None
        if "effort_ratio" in values:
            held = np.asarray(np.nan_to_num(values["effort_ratio"][0], nan=np.inf) <= 1)
        return AreaMap(centres, counts, held, values)
