"""Which few poses would tell most next: greedy D-optimal choice among poses like the recorded ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.units import display_unit, to_unit
from armcal.solve.estimator import Estimate
from armcal.solve.problem import Problem

CANDIDATES = 400
MOST_LEVELS = 12


@dataclass(frozen=True)
class Suggestion:
    """A pose (channel to rad or m), its text, and the mean ratio of standard deviations once it has been measured."""

    commands: dict[str, float]
    text: str
    shrink: float


def suggest(
    problem: Problem, dataset: Dataset, estimate: Estimate, joints: Mapping[str, str], count: int = 3, seed: int = 0
) -> tuple[Suggestion, ...]:
    """The poses that shrink the estimate's uncertainty most, each given those before it. [Fedorov1972]

    Candidates combine recorded levels of each joint (``joints`` names their channels and dimensions), or lie between
    its recorded ends where there are many; load and gravity are those of the middle record. Clearance is not
    considered.
    """
    candidates = _candidates(dataset, tuple(joints), seed)
    rows = _jacobians(problem, estimate.values, candidates)
    covariance = estimate.covariance / estimate.noise_scale**2
    before = np.sqrt(np.diag(covariance))
    chosen: list[Suggestion] = []
    for _ in range(min(count, len(candidates))):
        seen = np.eye(rows.shape[1]) + np.einsum("nri,ij,nsj->nrs", rows, covariance, rows)
        told = np.linalg.slogdet(seen)[1]
        told[[i for i in range(len(told)) if any(_same(candidates, i, s) for s in chosen)]] = -np.inf
        best = int(np.argmax(told))
        gain = rows[best] @ covariance
        covariance = covariance - gain.T @ np.linalg.solve(seen[best], gain)
        known = before > 0
        ratio = np.sqrt(np.maximum(np.diag(covariance)[known], 0)) / before[known]
        commands = {channel: float(candidates.column(channel)[best]) for channel in joints}
        shrink = float(np.mean(ratio)) if known.any() else 1.0
        chosen.append(Suggestion(commands, _text(commands, joints), shrink))
    return tuple(chosen)


def _same(candidates: Dataset, index: int, chosen: Suggestion) -> bool:
    return all(candidates.column(channel)[index] == value for channel, value in chosen.commands.items())


def _text(commands: Mapping[str, float], joints: Mapping[str, str]) -> str:
    units = {channel: display_unit(dimension).name for channel, dimension in joints.items()}
    parts = [f"{to_unit(value, units[channel]):.0f}" for channel, value in commands.items()]
    if len(set(units.values())) > 1:
        parts = [f"{part} {unit}" for part, unit in zip(parts, units.values(), strict=True)]
        return f"({', '.join(parts)})"
    return f"({', '.join(parts)}) {next(iter(units.values()))}"


def _candidates(dataset: Dataset, joints: tuple[str, ...], seed: int) -> Dataset:
    random = np.random.default_rng(seed)
    middle = len(dataset) // 2
    channels = {name: np.full(CANDIDATES, values[middle]) for name, values in dataset.channels.items()}
    for channel in joints:
        levels = np.unique(dataset.column(channel))
        few = len(levels) <= MOST_LEVELS
        channels[channel] = (
            random.choice(levels, CANDIDATES) if few else random.uniform(levels[0], levels[-1], CANDIDATES)
        )
    return Dataset(tuple(str(i) for i in range(CANDIDATES)), channels)


def _jacobians(problem: Problem, values: Array, candidates: Dataset) -> Array:
    """Whitened Jacobians by free canonical entries, all factors stacked (N x n_r x n)."""
    blocks = problem.jacobians(values, problem.records(candidates))
    return np.concatenate([block.transpose(2, 0, 1)[:CANDIDATES] for block in blocks], axis=1)
