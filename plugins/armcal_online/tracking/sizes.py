"""How large a change is that a belief has followed, in numbers and words, and how far off the tip was before it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from armcal.base.arrays import Array
from armcal.errors import ArmcalError
from armcal.estimate.online import log_density
from armcal.estimate.validation import error_dimension, error_unit

from armcal_online.tracking.belief import Belief
from armcal_online.tracking.hypotheses import Hypothesis, Recent, Steps
from armcal_online.tracking.observer import Observer
from armcal_online.tracking.state_space import StateSpace

SHOWN = {
    "angle": ("size_deg", "deg", math.degrees(1.0)),
    "length": ("size_mm", "mm", 1000.0),
    "mass": ("size_g", "g", 1000.0),
    "angle a day": ("rate_deg_per_day", "deg a day", math.degrees(1.0)),
    "length a day": ("rate_mm_per_day", "mm a day", 1000.0),
}
"""By dimension: the key in an event, the unit, and how many of it make one in SI."""
_DIMENSIONS = {"rad": "angle", "m": "length"}
_CLEAR = 3.0  # so many standard deviations from zero a number is worth saying


@dataclass(frozen=True)
class Size:
    """Of a change, and its standard deviation (rad, m or kg by ``dimension``, empty where it has none); in words."""

    value: float = 0.0
    deviation: float = 0.0
    dimension: str = ""
    shown: str = ""


def size_of(space: StateSpace, steps: Steps, before: Belief, after: Belief, change: Hypothesis) -> Size:
    """How far a change moved the mean; of an instrument or of everything it has no single number."""
    n = len(space.scales)
    moved = space.between(before.values(space), after.values(space))
    covariance = after.gaussian.covariance[:n, :n]
    if change.kind == "link_bent":
        return _of_link(space, steps, moved, covariance, change.subject)
    if change.kind == "gravity_tilted":
        at = list(next(cause.coordinates for cause in steps.causes if cause.subject == change.subject))
        turn = moved[at] * space.scales[at]
        along = np.zeros(n)
        along[at] = turn / max(float(np.linalg.norm(turn)), 1e-12) * space.scales[at]
        return _sized(*_along(along, moved, covariance), "angle")
    if not change.step.any():
        return Size()
    along = change.step / float(change.step @ change.step)
    dimension = steps.dimension(change.subject)
    if change.kind == "payload_changed":
        return _with_centre(space, moved, covariance, _sized(*_along(along, moved, covariance), "mass"))
    return _sized(*_along(along, moved, covariance), dimension) if dimension else Size()


def rate_of(steps: Steps, change: Hypothesis, size: Array, covariance: Array) -> Size:
    rates = np.array(change.rates)
    moved, own = size * rates, covariance * np.outer(rates, rates)
    is_length = change.kind == "sensor_drifting" or steps.dimension(change.subject) == "length"
    fast = float(moved[0]) if len(moved) == 1 else float(np.linalg.norm(moved))
    along = moved / (fast or 1.0)
    return _sized(fast, math.sqrt(float(along @ own @ along)), "length a day" if is_length else "angle a day")


def _with_centre(space: StateSpace, moved: Array, covariance: Array, mass: Size) -> Size:
    """A payload with its centre in the tool frame, where the mass and the centre are known."""
    if abs(mass.value) < _CLEAR * mass.deviation:
        return mass
    at = [space.names.index(f"statics.payload_moment_{axis}") for axis in "xyz"]
    centre = moved[at] * space.scales[at] / mass.value
    deviation = np.sqrt(covariance[at, at]) * space.scales[at] / abs(mass.value)
    shown = ", ".join(f"{1000 * c:+.0f} (sd {1000 * d:.0f})" for c, d in zip(centre, deviation, strict=True))
    return Size(mass.value, mass.deviation, mass.dimension, f"{mass.shown}, its centre at {shown} mm in the tool frame")


def _of_link(space: StateSpace, steps: Steps, moved: Array, covariance: Array, subject: str) -> Size:
    """The numbers of a link that changed clearly, the clearest first; the clearest is its size."""
    at = next(cause.coordinates for cause in steps.causes if cause.subject == subject)
    units = [block.unit for block in space.parameters.coordinate_blocks]
    sizes = []
    for i in at:
        value, deviation = (float(x * space.scales[i]) for x in (moved[i], math.sqrt(max(covariance[i, i], 0.0))))
        sizes.append(
            (abs(value) / max(deviation, 1e-12), space.names[i], _sized(value, deviation, _DIMENSIONS[units[i]]))
        )
    sizes.sort(key=lambda clear: -clear[0])
    clearest = sizes[0][2]
    said = [(name, size) for clear, name, size in sizes if clear >= _CLEAR] or [sizes[0][1:]]
    shown = ", ".join(f"{name} by {size.shown}" for name, size in said)
    return Size(clearest.value, clearest.deviation, clearest.dimension, shown)


def _along(along: Array, moved: Array, covariance: Array) -> tuple[float, float]:
    return float(along @ moved), math.sqrt(max(float(along @ covariance @ along), 0.0))


def _sized(value: float, deviation: float, dimension: str) -> Size:
    _, unit, factor = SHOWN[dimension]
    digits = 0 if dimension == "mass" else 2
    shown = f"{factor * value:+.{digits}f} {unit} (sd {factor * deviation:.{digits}f} {unit})"
    return Size(value, deviation, dimension, shown)


@dataclass(frozen=True)
class TipError:
    """The median size of an error, in thousandths of SI; how it was found, as words to go after it.

    ``unit`` is mm, or mrad where nothing measured is a length.
    """

    size: float
    unit: str
    source: str


def tip_error(
    observer: Observer, recent: Sequence[Recent], since: int, before: Belief, after: Belief
) -> TipError | None:
    """The error of the predicted readings before a decision.

    Where the decision explains the records by a move of the estimate, it is how far the predictions move at the last
    recorded poses, free of noise. Where it does not, nothing better is known than how far the readings since lie from
    their predictions.

    Args:
        observer: of the recalibration.
        recent: the last records, in order.
        since: the number of the first record that the decision affects.
        before: the belief without the decision.
        after: the belief that explains the records; the one before where nothing does.

    Returns:
        None where no reading has a length (or an angle, where nothing measured is a length), or none is predictable.
    """
    space = observer.space
    old, new = (space.inside(belief.values(space)) for belief in (before, after))
    if not np.array_equal(old, new):
        sizes = [size for record in recent for size in _sizes(observer, record, old, new)]
        source = f"median move of the prediction at the last {len(recent)} recorded poses"
    else:
        late = [record for record in recent if record.sequence >= since]
        sizes = [size for record in late for size in _sizes(observer, record, old, None)]
        source = f"median distance of the last {len(late)} readings from their predictions"
    return TipError(1000 * float(np.median(sizes)), error_unit(observer.problem), source) if sizes else None


def _sizes(observer: Observer, record: Recent, old: Array, new: Array | None) -> list[float]:
    """Of each reading of a record, how far its prediction moves from old values to new, or lies from it without new."""
    counted, sizes = error_dimension(observer.problem), []
    for reading in record.readings:
        dimensions = observer.problem.kernels[reading.factor].factor.dimensions
        rows = [i for i, dimension in enumerate(dimensions) if dimension == counted]
        if not rows:
            continue
        try:
            miss = observer.linearise(old, reading)[0]
            if new is not None:
                miss = miss - observer.linearise(new, reading)[0]
        except ArmcalError:
            continue
        sizes.append(float(np.linalg.norm(miss[rows])))
    return sizes


@dataclass(frozen=True)
class ModelError:
    """The covariance of what a model itself errs by (n_r x n_r), and degrees of freedom with which it is known."""

    covariance: Array
    freedom: float


def in_model_errors(
    observer: Observer, errors: Mapping[str, ModelError], records: Sequence[Recent], before: Belief, after: Belief
) -> tuple[float, float]:
    """How far predictions of records move between beliefs, in standard deviations of what was open before.

    That is the model's own error, and what its parameters leave.

    Returns:
        the root mean square, and the log density of an error as large against that of none; infinitely far where the
        model has no error of its own.
    """
    space, squares, densities = observer.space, [], []
    n = len(space.scales)
    own = before.gaussian.covariance[:n, :n]
    old, new = (space.inside(belief.values(space)) for belief in (before, after))
    for reading in (reading for record in records for reading in record.readings):
        error = errors.get(observer.problem.kernels[reading.factor].factor.name)
        if error is None:
            return math.inf, -math.inf
        try:
            innovation, slope = observer.linearise(old, reading)
            moved = innovation - observer.linearise(new, reading)[0]
        except ArmcalError:
            continue
        covariance = error.covariance + slope @ own @ slope.T
        square, about = float(moved @ np.linalg.solve(covariance, moved)), (0.0, len(moved), error.freedom)
        squares.append(square)
        densities.append(log_density(square, *about) - log_density(0.0, *about))
    return (math.sqrt(np.mean(squares)), float(np.mean(densities))) if squares else (math.inf, -math.inf)
