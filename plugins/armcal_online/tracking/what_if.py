"""How much one more record would determine, before it is taken."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from armcal.base.dataset import Dataset
from armcal.errors import DataError, NotConvergedError
from armcal.estimate.online import Linearised
from armcal.estimate.validation import error_dimension

from armcal_online.tracking.belief import Belief
from armcal_online.tracking.observer import Observer
from armcal_online.tracking.start import FilterSetup
from armcal_online.tracking.state_space import StateSpace

_MOST = 3


@dataclass(frozen=True)
class Worth:
    """What a record is expected to determine.

    Attributes:
        bits: mutual information of record and parameters, log2 [Lindley1956].
        deviation: of the prediction before it: root of the largest eigenvalue (m or rad).
        tells_most: parameters whose standard deviations shrink most, with the factors by which they do.
    """

    bits: float
    deviation: float
    tells_most: tuple[tuple[str, float], ...]


def ranked(setup: FilterSetup, commands: Dataset) -> tuple[list[tuple[int, Worth]], list[int]]:
    """Places of all poses, the one whose record is worth most first, and of those without an elastic equilibrium.

    Each is taken by itself: a second record at the best pose is worth less. The error that the calibration's residuals
    had counts as noise.

    Raises:
        DataError: no measurement reads a single pose.
    """
    worths, lost = [], []
    for place in range(len(commands)):
        channels = {name: float(values[place]) for name, values in commands.channels.items()}
        known = {name: value for name, value in channels.items() if np.isfinite(value)}
        try:
            worths.append((place, worth_of_record(setup.observer, setup.belief, known)))
        except NotConvergedError:
            lost.append(place)
    return sorted(worths, key=lambda placed: -placed[1].bits), lost


def worth_of_record(observer: Observer, belief: Belief, channels: Mapping[str, float]) -> Worth:
    """Of a record with these commands (by channel, SI) whose readings are as the belief predicts them.

    ``deviation`` is of the readings that errors count: those of the first measurement with any in ``error_unit``,
    and of these a position without the directions beside it.

    Raises:
        DataError: no measurement reads a single pose.
        NotConvergedError: the arm has no elastic equilibrium there.
    """
    readings = observer.predicted(belief.origin, channels)
    if not readings:
        raise DataError(
            "no measurement of the calibration reads a single pose.",
            hint="Only an instrument's readings can be predicted; take a calibration that was made with one.",
        )
    noise = observer.joint_noise(belief.origin, readings)
    record = observer.observation(belief, readings, noise).at(belief.gaussian.mean)
    worth = _worth(observer.space, belief, record)
    counted, start = error_dimension(observer.problem), 0
    for reading in readings:
        dimensions = observer.problem.kernels[reading.factor].factor.dimensions
        rows = [start + i for i, dimension in enumerate(dimensions) if dimension == counted]
        if rows:
            part = Linearised(record.innovation[rows], record.slope[rows], record.noise[np.ix_(rows, rows)])
            return replace(worth, deviation=_worth(observer.space, belief, part).deviation)
        start += len(dimensions)
    return worth


def _worth(space: StateSpace, belief: Belief, record: Linearised) -> Worth:
    covariance = belief.gaussian.covariance
    across = covariance @ record.slope.T
    forecast = record.slope @ across
    expected = forecast + record.noise
    _, wider = np.linalg.slogdet(expected)
    _, own = np.linalg.slogdet(record.noise)
    n = len(space.scales)
    gain = np.sum(np.linalg.solve(expected, across.T).T * across, axis=1)[:n]
    before = np.diag(covariance)[:n]
    left = np.sqrt(np.clip(1 - gain / np.where(before > 0, before, 1.0), 0.0, 1.0))
    order = np.argsort(left, kind="stable")[:_MOST]
    return Worth(
        0.5 * float(wider - own) / math.log(2),
        float(np.sqrt(max(np.linalg.eigvalsh(forecast)[-1], 0.0))),
        tuple((space.names[i], float(left[i])) for i in order),
    )
