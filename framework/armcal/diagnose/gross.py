"""How a calibrated arm differs from the nominal one as a whole, and what of it contradicts what was known before."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import casadi as ca
import numpy as np
from scipy.special import stdtr

from armcal.base.arrays import Array, Indices
from armcal.base.domains import Pose, ScrewAxis
from armcal.base.poses import NO_TURN
from armcal.errors import NotConvergedError
from armcal.estimate.estimator import Estimate
from armcal.estimate.identifiability import Measure, at_random_poses
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.rigid_alignment import along, apart_from, rigid_fit, spread_of, tools, unseen_motions

BEYOND, FAR_BEYOND = 4.0, 20.0
"""Standard deviations of a prior, or typical corrections where there is none: what is worth a look, what is gross."""
MOST_RECORDS = 300
_POSES = 60
_FEWEST_LENGTHS = 3
AS_MUCH, BY_SHARES = 0.01, 0.05
"""Levels at which lengths are off in proportion: against each off by as much, and each by a share of its own."""
_SAME_MOTION = 0.02  # Of a parameter's motion of the tool: what may differ from that of the base or of the tool's point


@dataclass(frozen=True)
class Displaced:
    """A parameter far from its nominal value."""

    name: str  # of its coordinate
    amount: float  # how far, in ``unit``
    unit: str  # that people are shown
    times: float  # how many standard deviations of its prior, or typical corrections
    by_prior: bool  # whether it has a prior
    placement: bool  # whether it only moves where the base stands or which point of the tool is meant


@dataclass(frozen=True)
class Proportion:
    """By how much lengths of the arm are longer than nominal, all in proportion, as a scale that is off makes them.

    Attributes:
        freedoms: all lengths less one, and as many as carry the share, less one: one long one that is off is no scale.
    """

    count: int  # how many lengths
    share: float  # of each length, by which it is longer
    sd: float  # of the share: lengths that differ from nominal each by its own, and how well they are known
    freedoms: tuple[float, float]

    @classmethod
    def of(cls, lengths: Array, values: Array, covariance: Array) -> Self:
        """Regression of what lengths are off on their nominal values (n each, m; n x n, m^2)."""
        squares = lengths**2
        weights, count = lengths / squares.sum(), len(lengths)
        share = float(weights @ values) - 1
        own = float(np.sum((values - (1 + share) * lengths) ** 2) / (count - 1) / squares.sum())
        # Kish's effective number: lengths that are off by a share of their own pull by their squares.
        carrying = float(squares.sum() ** 2 / np.sum(squares**2))
        sd = float(np.sqrt(own + weights @ covariance @ weights))
        return cls(count, share, sd, (count - 1.0, carrying - 1.0))

    @property
    def is_clear(self) -> bool:
        t, levels = -abs(self.share) / max(self.sd, 1e-300), (AS_MUCH, BY_SHARES)
        return all(2 * stdtr(freedom, t) < level for freedom, level in zip(self.freedoms, levels, strict=True))


@dataclass(frozen=True)
class Figure:
    """The calibrated arm beside the nominal one.

    Attributes:
        size: extent of the calibrated tool positions by that with nominal lengths and all else calibrated: a joint's
            wrong zero is no size; nan where they do not move.
        moved_mm, turned_deg: how the calibrated arm as a whole stands away from where the configuration has it.
    """

    reach_mm: float  # largest distance of the nominal tool from the first joint, over the poses
    size: float
    moved_mm: float
    turned_deg: float
    displaced: tuple[Displaced, ...]  # parameters beyond what their priors say, the farthest first
    proportion: Proportion | None = None  # of its free lengths; None where they are too few


def thinned(chosen: Indices, most: int) -> Indices:
    return chosen[:: max(1, -(-len(chosen) // most))]


def figure_of(problem: Problem, estimate: Estimate, records: Sequence[FactorRecords]) -> Figure:
    """Of the first tool of all, at random poses about the recorded ones: what touches a socket hardly moves in them."""
    poses = at_random_poses(problem.with_records(records)).subset(np.arange(_POSES, dtype=np.intp)).records
    try:
        nominal, calibrated, bent = _places(problem, estimate, poses)
    except NotConvergedError:
        poses = tuple(records)
        nominal, calibrated, bent = _places(problem, estimate, poses)
    arm = problem.blueprint.arms[problem.blueprint.measurements[problem.kernels[0].factor.name].arms[0]]
    chain = arm.nominal_chain
    first = np.array(ca.evalf((chain.base_T_mount @ chain.joints[0].parent_T_joint).translation)).ravel()
    extent, turn, shift = spread_of(bent), *rigid_fit(nominal, calibrated)
    return Figure(
        reach_mm=float(np.max(np.linalg.norm(nominal - first[:, None], axis=0))) * 1000.0,
        size=spread_of(calibrated) / extent if extent > 0 else float("nan"),
        moved_mm=float(np.linalg.norm(turn @ first + shift - first)) * 1000.0,
        turned_deg=float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1.0, 1.0)))),
        displaced=displaced(problem, estimate, poses),
        proportion=proportion(problem, estimate, poses),
    )


def _places(problem: Problem, estimate: Estimate, poses: Sequence[FactorRecords]) -> tuple[Array, Array, Array]:
    """Places of the first tool (3 x N, m): as configured, calibrated, and calibrated but for its lengths."""
    parameters, configured = problem.parameters, problem.blueprint.parameters.nominal()
    bent = estimate.values.copy()
    for block in parameters.free:
        if block.unit == "m" or isinstance(block.domain, ScrewAxis | Pose):
            own = parameters.entries_of(block.name)
            bent[own] = configured[own]
    nominal, calibrated, bent_places = (
        tools(problem.with_records(poses), values)[0][0] for values in (configured, estimate.values, bent)
    )
    return nominal, calibrated, bent_places


def displaced(problem: Problem, estimate: Estimate, records: Sequence[FactorRecords]) -> tuple[Displaced, ...]:
    """Coordinates of geometry that are more than ``BEYOND`` prior standard deviations from their nominal values.

    What nobody configured is nowhere far from.
    """
    parameters = problem.parameters
    moved = parameters.coordinates(parameters.local(estimate.values))
    blocks = parameters.coordinate_blocks
    # By its prior, else by a typical correction of a length or angle; of others nothing is known.
    typical = [b.scale if b.unit in ("m", "rad") and not b.nuisance else np.inf for b in blocks]
    sizes = np.array([t if b.prior_sd is None else b.prior_sd for b, t in zip(blocks, typical, strict=True)])
    far = []
    for i in np.flatnonzero(np.abs(moved) > BEYOND * sizes):
        block = blocks[i]
        if unconfigured(problem, block.name):
            continue
        amount, unit = Measure(block.unit, 1.0).shown(float(moved[i]))
        placement = only_places(problem, estimate.values, records, int(i))
        times, name = abs(float(moved[i])) / sizes[i], parameters.coordinate_names[i]
        far.append(Displaced(name, amount, unit, float(times), block.prior_sd is not None, placement))
    return tuple(sorted(far, key=lambda coordinate: -coordinate.times))


def proportion(problem: Problem, estimate: Estimate, records: Sequence[FactorRecords]) -> Proportion | None:
    """By how much free lengths of an arm are longer than nominal in proportion; None where they are too few."""
    parameters, nominal = problem.parameters, problem.blueprint.parameters.nominal()
    chosen = [
        problem.free_names.index(block.name)
        for i, block in enumerate(parameters.coordinate_blocks)
        if block.unit == "m"
        and block.domain.dof == 1
        and nominal[parameters.entries_of(block.name)].all()
        and not only_places(problem, estimate.values, records, i)
    ]
    if len(chosen) < _FEWEST_LENGTHS:
        return None
    entries = np.array(parameters.free_entries)[chosen]
    return Proportion.of(nominal[entries], estimate.values[entries], estimate.covariance[np.ix_(chosen, chosen)])


def only_places(problem: Problem, values: Array, records: Sequence[FactorRecords], coordinate: int) -> bool:
    """Whether a coordinate only moves where the base stands or which point of the tool is meant; or no tool at all."""
    names = problem.parameters.coordinate_names
    if names[coordinate].partition(".")[0] not in problem.blueprint.arms:
        return True
    at, axes = tools(problem.with_records(records), values)
    moves = along(problem.with_records(records), values, np.eye(len(names))[coordinate]).reshape(-1, 1)
    left = np.linalg.norm(apart_from(np.array(unseen_motions(at, axes)).T, moves))
    return bool(left <= _SAME_MOTION * np.linalg.norm(moves))


def unconfigured(problem: Problem, name: str) -> bool:
    """Whether a parameter of a measurement has no prior, and is left where a configuration that says nothing has it."""
    block = problem.blueprint.parameters[name]
    if block.name.partition(".")[0] in problem.blueprint.arms or block.prior_sd is not None:
        return False
    return tuple(block.nominal) in ((0.0,) * block.size, NO_TURN, (*NO_TURN, 0.0, 0.0, 0.0))
