"""The nominal arm where the records have it: what places it is fitted to records that train, all else is nominal."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from armcal.base.arrays import Array
from armcal.diagnose.gross import only_places, thinned, unconfigured
from armcal.errors import NotConvergedError
from armcal.estimate.nuisance import restricted, settled, untrained, with_free
from armcal.estimate.polish import descended
from armcal.estimate.start import BETTER
from armcal.estimate.validation import Split, errors_and_turns
from armcal.estimate.weighing import WeighedFit
from armcal.problem.posed import PosedProblem
from armcal.problem.problem import FactorRecords, Problem
from armcal.run.prepare import Prepared

_POSES, _MOST_STEPS, _DAMPING, _ENOUGH = 60, 30, 1e-9, 1e-9


@dataclass(frozen=True)
class FittedRecords(Prepared):
    """A prepared problem, and the fit to its training records."""

    fitted: WeighedFit = field(kw_only=True)


@dataclass(frozen=True)
class NominalErrors:
    """Errors of the nominal arm (N each, in dataset order; m).

    Attributes:
        errors: as it is shown: where the configuration has it, or placed by the training records where nobody
            configured where it stands, or what it carries.
        crossed: the same, what is cross-validated by the placement of the fold that did not train on it.
        rival: what a calibration is compared with, placed by the records that train, of records that do not; nan of
            others, and of all where nothing is free but what places the arm.
        turns: those three of orientations (rad); None where none are measured.
        residual: of the arm as it is shown (n_r x N).
    """

    errors: Array
    crossed: Array
    rival: Array
    turns: tuple[Array, Array, Array] | None
    residual: Sequence[Array]


def placing_names(problem: Problem, records: Sequence[FactorRecords]) -> set[str]:
    """Free parameters that only say where base and tool point are, and those of measurements."""
    some = problem.subset(records, thinned(np.arange(records[0].count), _POSES))
    blocks, nominal = problem.parameters.coordinate_blocks, problem.parameters.nominal()
    moving = {b.name for i, b in enumerate(blocks) if not b.nuisance and not only_places(problem, nominal, some, i)}
    return {block.name for block in problem.parameters.free if not block.nuisance} - moving


def nominal_errors(run: FittedRecords, splits: Sequence[Split]) -> NominalErrors:
    """Of the nominal arm; ``splits`` are folds of the training records."""
    problem, train, held = run.problem, run.split.train, run.split.holdout
    acting = problem.weighted(run.fitted.records, run.fitted.weights)
    names = placing_names(problem, acting)
    shown, values = _placed(problem, names, acting, problem.parameters.nominal())
    errors, turns = errors_and_turns(shown, values, run.records)
    rival, rival_turns = np.full((2, len(run.dataset)), np.nan)
    rival[held], rival_turns[held] = errors[held], np.nan if turns is None else turns[held]
    for split in splits:
        fold, there = _placed(problem, names, problem.subset(acting, split.train), values)
        judged = train[split.holdout]
        off, turned = errors_and_turns(fold, there, problem.subset(run.records, judged))
        rival[judged], rival_turns[judged] = off, np.nan if turned is None else turned
    crossed: tuple[Array, Array | None] = rival, rival_turns
    if not _found(run, names, errors):
        shown, values = untrained(problem), problem.parameters.nominal()
        errors, turns = crossed = errors_and_turns(shown, values, run.records)
    residual = problem.residuals(settled(shown, values, run.records), run.records)
    if {block.name for block in problem.parameters.free if not block.nuisance} == names:
        rival, rival_turns = np.full((2, len(rival)), np.nan)
    both = None if turns is None or crossed[1] is None else (turns, crossed[1], rival_turns)
    return NominalErrors(errors, crossed[0], rival, both, residual)


def _placed(problem: Problem, names: set[str], records: Sequence[FactorRecords], start: Array) -> tuple[Problem, Array]:
    groups = {block.name for block in problem.parameters.free if block.nuisance}
    own = restricted(with_free(problem, names | groups), records)
    if not own.parameters.free:
        return own, start
    try:
        posed = PosedProblem(own, records)
        return own, posed.values(descended(posed, posed.x(start), _MOST_STEPS, _DAMPING, _ENOUGH))
    except NotConvergedError:
        return own, start


def _found(run: FittedRecords, names: set[str], placed: Array) -> bool:
    """Whether the records say where the arm stands, or what it carries, since nobody configured it."""
    problem = run.problem
    if run.start.taken or not any(unconfigured(problem, name) for name in names):
        return run.start.taken
    configured = errors_and_turns(untrained(problem), problem.parameters.nominal(), run.records)[0]
    return bool(np.nanmedian(placed) * BETTER < np.nanmedian(configured))
