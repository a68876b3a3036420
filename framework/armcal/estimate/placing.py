"""Which free parameters say where an arm stands and where the target sits on its tool, and their values for a place.

Nothing declares them: a parameter is the base's if it moves all tools as one rigid motion in the base frame, and the
target's if it moves each by the same motion in its own axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from armcal.base import domains
from armcal.base.arrays import Array
from armcal.base.parameters import Parameters
from armcal.errors import NotConvergedError
from armcal.estimate.polish import descended
from armcal.problem.posed import PosedProblem
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.rigid_alignment import Tools
from armcal.problem.sighting import Sighting, shown_instead, tools_of
from armcal.problem.tool_motion import spread_of

_POSES, _STEP = 24, 1e-5
_SAME_MOTION = 0.02
"""Of a parameter's motion of the tool: what may differ from one rigid motion."""
_RANK = 1e-3
_DRAWS, _SEED, _MOST_STEPS, _DAMPING = 12, 5, 30, 1e-4
_REACHED = 1e-3
"""Of the spread of the positions: a place is reached."""


@dataclass(frozen=True)
class _Motion:
    """What a parameter moves as one: the arm, else the target; by each increment (turn times the size, shift)."""

    name: str
    of_base: bool
    twists: tuple[Array, ...]


@dataclass(frozen=True)
class Placing:
    """Free parameters that move the arm as a whole, or the target on its tool.

    Attributes:
        base: names of those that move the arm.
        target: names of those that move the target.
        basis: orthonormal directions in the tool's axes along which these move it (3 x k).
        rank: how many of the six motions the base can make.
        shifts: of each number that only shifts the target, its name and the direction (3, by its increment).
    """

    base: tuple[str, ...]
    target: tuple[str, ...]
    basis: Array
    rank: int
    shifts: tuple[tuple[str, Array], ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.base, *self.target)

    @property
    def stands_anywhere(self) -> bool:
        return self.rank == 6

    @classmethod
    def of(cls, motions: Sequence[_Motion]) -> Placing:
        base = tuple(motion for motion in motions if motion.of_base)
        target = tuple(motion for motion in motions if not motion.of_base)
        shifts = [(m.name, m.twists[0][3:]) for m in target if len(m.twists) == 1 and _shifts_only(m.twists[0])]
        rank = _basis([twist for motion in base for twist in motion.twists], 6).shape[1]
        basis = _basis([shift for _, shift in shifts], 3)
        return cls(tuple(m.name for m in base), tuple(m.name for m in target), basis, rank, tuple(shifts))

    def with_target(self, parameters: Parameters, values: Array, offset: Array) -> Array:
        """Values that have the target moved by an offset in the tool's axes (3, m)."""
        moved = values.copy()
        if self.shifts:
            steps = np.linalg.pinv(np.array([shift for _, shift in self.shifts]).T) @ offset
            for (name, _), step in zip(self.shifts, steps, strict=True):
                moved[parameters.entries_of(name)] += step
        return moved

    def reached(self, problem: Problem, records: Sequence[FactorRecords], sighting: Sighting, shown: Tools) -> Array:
        """The value vector at which the instrument would see ``shown`` in the sighting's records, or nearest to it."""
        few = sighting.thinned(_POSES)
        at = np.searchsorted(sighting.chosen, few.chosen)
        some = [replace(r, weight=0 * r.weight) for r in problem.subset(records, few.chosen)]
        weight = problem.subset(records, few.chosen)[sighting.kernel].weight
        some[sighting.kernel] = replace(
            shown_instead(problem, some[sighting.kernel], sighting.kernel, shown.subset(at)), weight=weight
        )
        own = {name: replace(problem.parameters[name], prior_sd=None) for name in self.names}
        parameters = problem.parameters.replaced(own).with_free(self.names)
        posed = PosedProblem(replace(problem, parameters=parameters, known_ties=()), some)
        seen = replace(
            few, measured=shown.places[:, at], turned=few.turned if few.turned is None else shown.rotations[at]
        )
        best, least, random = problem.parameters.nominal(), np.inf, np.random.default_rng(_SEED)
        for draw in range(_DRAWS):
            try:
                start = posed.x(_turned(parameters, random) if draw else parameters.nominal())
                values = posed.values(descended(posed, start, _MOST_STEPS, _DAMPING, 1e-9))
                off = seen.off(tools_of(posed.problem, values, some[sighting.kernel], sighting.kernel))
            except NotConvergedError:
                continue
            if off < least:
                best, least = values, off
            if off <= _REACHED * sighting.size:
                break
        return best


def placings(problem: Problem, records: Sequence[FactorRecords], sighting: Sighting) -> tuple[Placing, Placing]:
    """Of the free parameters without a prior, and of all free ones."""
    poses = problem.subset(records, sighting.thinned(_POSES).chosen)[sighting.kernel]
    nominal = problem.parameters.nominal()
    here = tools_of(problem, nominal, poses, sighting.kernel)
    size, motions, held = max(spread_of(here.places), 1e-9), list[_Motion](), list[_Motion]()
    for block in problem.parameters.free:
        if block.nuisance or block.unit not in ("m", "rad", "1"):
            continue
        place, moves = problem.parameters.entries_of(block.name), list[Tools]()
        step = _STEP * block.domain.increment_scale(block.scale)
        for unit in np.eye(block.domain.dof):
            moved = nominal.copy()
            moved[place] = block.domain.retract(np.array(block.nominal), step * unit)
            there = tools_of(problem, moved, poses, sighting.kernel)
            moves.append(Tools((there.places - here.places) / step, (there.rotations - here.rotations) / step))
        for of_base, twist_of in ((True, _base_twist), (False, _tool_twist)):
            twists = [twist for twist in (twist_of(here, move, size) for move in moves) if twist is not None]
            along = of_base or sighting.turned is not None or all(map(_shifts_only, twists))
            if len(twists) == len(moves) and along:
                (motions if block.prior_sd is None else held).append(_Motion(block.name, of_base, tuple(twists)))
                break
    return Placing.of(motions), Placing.of([*motions, *held])


def _base_twist(here: Tools, move: Tools, size: float) -> Array | None:
    """The one motion (turn times the size, shift of the middle) of all tools; None if there is none."""
    turns = _turns(move.rotations @ np.swapaxes(here.rotations, 1, 2))
    arm = here.places - here.places.mean(axis=1, keepdims=True)
    turn, shift = turns.mean(axis=0), move.places.mean(axis=1)
    away = move.places - np.cross(turn, arm.T).T - shift[:, None]
    return _one_motion(np.r_[size * turn, shift], np.c_[size * (turns - turn), away.T], move, size)


def _tool_twist(here: Tools, move: Tools, size: float) -> Array | None:
    """The one motion (turn times the size, shift) of each tool in its own axes; None if there is none."""
    turns = _turns(np.swapaxes(here.rotations, 1, 2) @ move.rotations)
    shifts = np.einsum("nji,jn->ni", here.rotations, move.places)
    turn, shift = turns.mean(axis=0), shifts.mean(axis=0)
    return _one_motion(np.r_[size * turn, shift], np.c_[size * (turns - turn), shifts - shift], move, size)


def _one_motion(twist: Array, away: Array, move: Tools, size: float) -> Array | None:
    total = np.sum(move.places**2) + size**2 * np.sum(move.rotations**2) / 2
    return twist if total > 0 and np.sum(away**2) <= _SAME_MOTION**2 * total else None


def _shifts_only(twist: Array) -> bool:
    return float(np.linalg.norm(twist[:3])) <= _SAME_MOTION * float(np.linalg.norm(twist[3:]))


def _turns(skew: Array) -> Array:
    """The vectors (N x 3) of skew matrices (N x 3 x 3)."""
    return (
        np.stack([skew[:, 2, 1] - skew[:, 1, 2], skew[:, 0, 2] - skew[:, 2, 0], skew[:, 1, 0] - skew[:, 0, 1]], 1) / 2
    )


def _basis(columns: Sequence[Array], size: int) -> Array:
    """Orthonormal directions (size x k) that columns make, each column counted alike; axes where they can be."""
    unit = [column / np.linalg.norm(column) for column in columns if np.linalg.norm(column) > 0]
    left, sizes, _ = np.linalg.svd(np.array(unit).reshape(-1, size).T, full_matrices=False)
    left = left[:, sizes > _RANK * sizes.max(initial=0.0)]
    within, directions = left @ left.T, list[Array]()
    for _ in range(left.shape[1]):
        direction = within[:, int(np.argmax(np.diag(within)))]
        directions.append(direction / np.linalg.norm(direction))
        within = within - np.outer(directions[-1], directions[-1] @ within)
    return np.array(directions).reshape(-1, size).T


def _turned(parameters: Parameters, random: np.random.Generator) -> Array:
    values = parameters.nominal()
    for block in parameters.free:
        place = parameters.entries_of(block.name)
        if isinstance(block.domain, domains.Rotation):
            values[place] = Rotation.random(random_state=random).as_quat()[[3, 0, 1, 2]]
        elif isinstance(block.domain, domains.Interval) and block.unit == "rad":
            drawn = random.uniform(-np.pi, np.pi)
            values[place] = np.clip(values[place] + drawn, block.domain.lower, block.domain.upper)
    return values
