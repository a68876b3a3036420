"""Why a combination is undetermined: no poses determine it, these poses do not, or only not at these values.

A model is analytic, so its rank is the same almost everywhere; random poses at a point near the values at hand show
it with probability one, and what is undetermined there is a gauge.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from armcal.base.arrays import Array
from armcal.base.parameters import Parameters
from armcal.errors import NotConvergedError, ProblemError
from armcal.estimate.combination import Combination, named
from armcal.estimate.identifiability import POOR_CONDITION, RANK_TOLERANCE, Identifiability, analyse, measures_of
from armcal.estimate.null_space import null_rows, sparse_basis
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.projection import approach_channels, factor_at_zero, fits, joint_channels, projected
from armcal.problem.tool_motion import along, apart_from, tools, unseen_motions

Cause = Literal["gauge", "values", "poses", "unknown"]
CAUSES: dict[Cause, str] = {
    "gauge": "a gauge: no poses determine it",
    "values": "not seen at these values, only away from them",
    "poses": "these poses do not determine it, others would",
    "unknown": "it could not be found out whether other poses would determine it",
}
_AWAY = 0.1
"""How far from the values at hand a point lies where the rank is taken, in typical scales."""
_HARDLY_AWAY = 1e-3
"""And one where undetermined directions are taken: they turn along with the values."""
_BEYOND = 0.7
"""rad, or m: how far random poses go beyond the recorded ones."""
_WITHIN = 1e-2
"""Sine of the angle within which a direction is the one that is undetermined there."""
_NAMED = 1e-4
UNSEEN_SCALE = "scale is not observable: the same arm, larger or smaller with all it touches, fits as well"
GIVE_A_LENGTH = "give one length: a known distance, a tracker's record, or a dimension of the arm that is held"
_GROWTH_LEFT = 1e-4
"""Of the size of the workspace: what may be left of a growth of all tool positions in proportion."""
_POSES = 60
MOST_LISTED = 5
"""So many undetermined combinations are listed in one message."""
FEW_HELD = 2
"""Combinations under priors that are listed in full: they do no harm, and more of them bury the rest."""


@dataclass(frozen=True)
class Undetermined:
    """A combination that the records do not determine, why, and the priors that take part in it."""

    combination: Combination
    cause: Cause
    priors: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.combination}: {CAUSES[self.cause]}"


def identify(problem: Problem, values: Array, records: Sequence[FactorRecords]) -> Identifiability:
    return identify_from(factor_at_zero(problem, values, records), problem.parameters)


def identify_from(triangle: Array, parameters: Parameters) -> Identifiability:
    return analyse(triangle, parameters.scales(), parameters.coordinate_names, measures_of(parameters))


def explain(
    problem: Problem, values: Array, records: Sequence[FactorRecords], known: Identifiability
) -> tuple[Undetermined, ...]:
    """Every undetermined combination with its cause: gauges first, as few parameters in each as possible."""
    null = known.null
    if not len(null):
        return ()
    held = problem.parameters.prior_information() > 0
    priors = {name for name, has in zip(known.names, held, strict=True) if has}
    causes: list[Cause] = ["unknown"] * len(null)
    nested: tuple[Array, ...] = ()
    with suppress(NotConvergedError):
        if all(record.count for record in records):
            poses, parameters = random_records(problem, records), problem.parameters
            at = _scaled(problem, values, poses)
            here = null_rows(at @ null.T, 1e3 * RANK_TOLERANCE * _largest(at)) @ null  # no poses show these here
            away = _scaled(problem, nearby(parameters, values), poses)
            count = len(null_rows(away, RANK_TOLERANCE * _largest(away)))
            near = _scaled(problem, nearby(parameters, values, _HARDLY_AWAY), poses)
            anywhere = np.linalg.svd(near)[2][len(near.T) - count :]
            turn, cosines, _ = np.linalg.svd(here @ anywhere.T)
            gauge = turn.T[: int(np.sum(cosines > np.sqrt(1 - _WITHIN**2)))] @ here
            nested, causes = (gauge, here), ["gauge"] * len(gauge)
            causes += ["values"] * (len(here) - len(gauge))
            causes += ["poses"] * (len(null) - len(here))
    vectors = sparse_basis(null, nested, _WITHIN)
    combinations = [named(vector, known.names, known.measures, _NAMED) for vector in vectors]
    return tuple(
        Undetermined(combination, cause, tuple(name for name in combination.names if name in priors))
        for combination, cause in zip(combinations, causes, strict=True)
    )


def held_by_nothing(parameters: Parameters, known: Identifiability) -> tuple[Combination, ...]:
    """Undetermined combinations that priors do not hold either."""
    null = known.null
    if not len(null):
        return ()
    strength = np.sqrt(parameters.prior_information()) * parameters.scales()
    free = null_rows((null * strength).T, RANK_TOLERANCE * max(float(strength.max()), 1e-300)) @ null
    return tuple(named(vector, known.names, known.measures, _NAMED) for vector in sparse_basis(free))


def nearby(parameters: Parameters, values: Array, away: float = _AWAY, seed: int = 0) -> Array:
    random = np.random.default_rng(seed)
    at, scale = parameters.local(values), parameters.increment_scales()
    lower, upper = parameters.increment_bounds()
    step = away * scale * random.uniform(0.5, 1.0, len(scale)) * random.choice([-1.0, 1.0], len(scale))
    step = np.where((at + step < lower) | (at + step > upper), -step, step)
    return parameters.retract(np.clip(at + step, lower, upper))


def random_records(problem: Problem, records: Sequence[FactorRecords], seed: int = 0) -> tuple[FactorRecords, ...]:
    """Random poses about the recorded ones and beyond them, under the recorded loads, from either side."""
    count = int(np.clip(3 * problem.increments, 60, 600))
    result = []
    for kernel, factor_records in zip(problem.kernels, records, strict=True):
        random = np.random.default_rng(seed)
        rows = np.flatnonzero(factor_records.weight[: factor_records.count])
        chosen = random.choice(rows if len(rows) else np.arange(factor_records.count), count)
        (drawn,) = Problem.subset([factor_records], chosen.astype(np.intp))
        record, joints = drawn.record.copy(), list(joint_channels(kernel.factor))
        seen, approaches = factor_records.record[joints, : factor_records.count], list(approach_channels(kernel.factor))
        lowest, highest = seen.min(axis=1) - _BEYOND, seen.max(axis=1) + _BEYOND
        record[joints] = random.uniform(lowest[:, None], highest[:, None], (len(joints), record.shape[1]))
        record[approaches] = random.choice([-1.0, 1.0], (len(approaches), record.shape[1]))
        weight = (np.arange(record.shape[1]) < count).astype(float)
        result.append(replace(drawn, record=record, weight=weight, state=np.zeros_like(drawn.state)))
    return tuple(result)


def _scaled(problem: Problem, values: Array, poses: Sequence[FactorRecords]) -> Array:
    fitting = projected(problem, values, poses)
    can = fits(problem, values, fitting)
    weighed = []
    for factor_records, mask in zip(fitting, can, strict=True):
        weight = factor_records.weight.copy()
        weight[: factor_records.count] *= mask
        weighed.append(replace(factor_records, weight=weight))
    return problem.triangular_factor(values, weighed) * problem.parameters.scales()


def _largest(matrix: Array) -> float:
    return float(np.linalg.norm(matrix, 2)) if matrix.size else 0.0


def scale_is_unseen(problem: Problem, values: Array, records: Sequence[FactorRecords], known: Identifiability) -> bool:
    """Whether some undetermined combination makes all tools' positions grow in proportion.

    Contacts fit a smaller arm in a smaller world just as well. The tools decide, not the parameters: which numbers
    take part in a growth differs from model to model. A growth may go along with a motion of everything, and with
    another point of a tool being the one that is meant.
    """
    if not len(known.null):
        return False
    poses = problem.subset(random_records(problem, records), np.arange(_POSES, dtype=np.intp))
    at, axes = tools(problem, values, poses)
    moves = [along(problem, values, poses, direction) for direction in known.null]
    growth = (at - at.mean(axis=(0, 2), keepdims=True)).ravel()
    left = apart_from(np.array([move.ravel() for move in moves] + unseen_motions(at, axes)).T, growth[:, None])
    return bool(np.linalg.norm(left) < _GROWTH_LEFT * np.linalg.norm(growth))


def require_solvable(problem: Problem, records: Sequence[FactorRecords], start: Array) -> tuple[str, ...]:
    """Refuse a problem whose answer would be invented.

    Returns:
        warnings: what priors alone hold, and a poor condition.

    Raises:
        ProblemError: fewer equations than parameters, or undetermined combinations, without priors on them.
    """
    parameters = problem.parameters
    count = problem.equations(records)
    unknown = problem.increments
    has_prior = parameters.prior_information() > 0
    warnings = []
    if count < unknown:
        poses = max((record.count for record in records), default=0)
        text = f"{count} equations ({poses} records) for {unknown} free parameters"
        if not has_prior.all():
            raise ProblemError(f"{text}.", hint="Measure more poses, fix parameters, or give every one a prior.")
        warnings.append(f"{text}: what the data does not determine comes from the priors.")
    known = identify(problem, start, records)
    if known.undetermined:
        explained = explain(problem, start, records, known)
        listed = "; ".join(str(undetermined) for undetermined in explained[:MOST_LISTED])
        more = len(explained) - MOST_LISTED
        listed += f"; and {more} more, which armcal identify lists" if more > 0 else ""
        text = f"the data does not determine {len(explained)} combinations"
        unseen_scale = scale_is_unseen(problem, start, records, known)
        if held_by_nothing(parameters, known):
            first, mend = (f"{UNSEEN_SCALE}; ", f"{GIVE_A_LENGTH}. ") if unseen_scale else ("", "")
            raise ProblemError(f"{first}{text}: {listed}.", hint=_sentence(f"{mend}{_mend(explained)}"))
        if unseen_scale:
            warnings.append(f"{UNSEEN_SCALE}; its priors hold it. To know it, {GIVE_A_LENGTH}.")
        listed = listed if len(explained) <= FEW_HELD else "armcal identify lists them"
        warnings.append(
            f"at the nominal values {text}; their priors hold them: {listed}. The verdict counts at the answer."
        )
    if known.condition > POOR_CONDITION and not has_prior.all():
        warnings.append(f"the scaled condition is {known.condition:.1e}: {known.weakest} is hardly determined.")
    return tuple(warnings)


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


def _mend(undetermined: Sequence[Undetermined]) -> str:
    causes = {combination.cause for combination in undetermined}
    advice = ["fix one parameter of each", "give it a prior"]
    if "values" in causes:
        advice.append("start from other values")
    if causes & {"poses", "unknown"}:
        advice.append("measure poses that separate them")
    return _sentence(f"{', '.join(advice[:-1])}, or {advice[-1]}.")
