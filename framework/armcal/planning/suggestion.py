"""Which few poses to measure next: D-optimal choice among poses like the recorded ones."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from armcal.arm.assembly import shown_joint
from armcal.arm.joints import Limits
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.units import display_unit, to_unit
from armcal.estimate.estimator import Estimate
from armcal.estimate.identifiability import deviations
from armcal.planning.candidates import Candidates, Task, whitened_rows
from armcal.planning.exchange import built_up
from armcal.problem.problem import Problem, triangular

CANDIDATES = 400
LEAST_GAIN = 0.05
MOST_LEVELS = 12


@dataclass(frozen=True)
class Suggestion:
    """A pose (channel to rad or m), its text, and the mean ratio of standard deviations once it has been measured.

    ``beside`` are joints that should be moved too; no limits say how far.
    """

    commands: dict[str, float]
    text: str
    shrink: float
    beside: tuple[str, ...] = ()


def is_worth_measuring(suggestions: Sequence[Suggestion]) -> bool:
    return bool(suggestions) and 1 - suggestions[-1].shrink >= LEAST_GAIN


def in_words(suggestions: Sequence[Suggestion]) -> str:
    beside = list(dict.fromkeys(joint for suggestion in suggestions for joint in suggestion.beside))
    moved = f", each with {' and '.join(beside)} moved as well, which stood still" if beside else ""
    return "; ".join(suggestion.text for suggestion in suggestions) + moved


def suggest(
    problem: Problem,
    dataset: Dataset,
    estimate: Estimate,
    joints: Mapping[str, str],
    count: int = 3,
    seed: int = 0,
    still: Mapping[str, Limits | None] = MappingProxyType({}),
) -> tuple[Suggestion, ...]:
    """The poses that together shrink the estimate's uncertainty most, each adding most to those before it.

    Candidates combine recorded levels of each joint (``joints`` names their channels and dimensions), or lie between
    its recorded ends where there are many, or between its limits if it is ``still`` (channels of joints that hardly
    moved, with limits where they are known). Load and gravity are those of the middle record. Clearance is not
    considered. There are none where the estimate is not finite; poses at which it gives nothing finite are left out.
    """
    ranges = {channel: limits for channel, limits in still.items() if limits is not None}
    arms = problem.blueprint.arms
    beside = tuple(shown_joint(channel, arms) for channel in joints if channel in still and channel not in ranges)
    poses = _candidates(dataset, tuple(joints), seed, ranges)
    base = estimate.square_root_information * estimate.parameters.scales()
    scale = estimate.noise_scale or 1.0
    if any(kernel.points is not None for kernel in problem.kernels):
        scale = _as_these(problem, dataset, estimate, base)
    rows = whitened_rows(problem, estimate.values, poses) / scale
    usable = np.flatnonzero(np.isfinite(rows).all(axis=(0, 2)))
    if not (np.isfinite(base).all() and len(usable)):
        return ()
    rows, poses = rows[:, usable], poses.subset(usable)
    candidates = Candidates(base, rows)
    chosen = built_up(Task(candidates, min(count, len(poses))))
    before = deviations(base)
    known = np.isfinite(before) & (before > 0)
    units = {channel: display_unit(dimension).name for channel, dimension in joints.items()}
    suggestions = []
    for number in range(1, len(chosen) + 1):
        after = deviations(candidates.triangle(chosen[:number]))
        commands = {channel: float(poses.column(channel)[chosen[number - 1]]) for channel in joints}
        shrink = float(np.mean(after[known] / before[known])) if known.any() else 1.0
        suggestions.append(Suggestion(commands, _text(commands, units), shrink, beside))
    return tuple(suggestions)


def _text(commands: Mapping[str, float], units: Mapping[str, str]) -> str:
    parts = [f"{to_unit(value, units[channel]):.0f}" for channel, value in commands.items()]
    if len(set(units.values())) > 1:
        return f"({', '.join(f'{part} {unit}' for part, unit in zip(parts, units.values(), strict=True))})"
    return f"({', '.join(parts)}) {next(iter(units.values()))}"


def _as_these(problem: Problem, dataset: Dataset, estimate: Estimate, base: Array) -> float:
    """How many times the declared noise further records will have, if they are like these (``base``: R of these).

    Points of a record err together, so that many of them say less than as many records would.
    """
    rows = whitened_rows(problem, estimate.values, dataset)
    prior = np.diag(np.sqrt(problem.parameters.prior_information()) * problem.parameters.scales())
    declared = deviations(triangular(np.vstack([prior, rows.reshape(-1, rows.shape[2])])))
    return float(np.median(deviations(base) / np.maximum(declared, 1e-300)))


def _candidates(dataset: Dataset, joints: tuple[str, ...], seed: int, ranges: Mapping[str, Limits]) -> Dataset:
    """Distinct poses; joints with a range may stand anywhere in it."""
    random = np.random.default_rng(seed)
    middle = len(dataset) // 2
    drawn = []
    for channel in joints:
        levels = np.unique(dataset.column(channel))
        few = len(levels) <= MOST_LEVELS and channel not in ranges
        low, high = ranges.get(channel, (levels[0], levels[-1]))
        drawn.append(random.choice(levels, CANDIDATES) if few else random.uniform(low, high, CANDIDATES))
    poses = np.unique(np.array(drawn), axis=1)
    count = poses.shape[1]
    channels = {name: np.full(count, values[middle]) for name, values in dataset.channels.items()}
    return Dataset(tuple(str(i) for i in range(count)), {**channels, **dict(zip(joints, poses, strict=True))})
