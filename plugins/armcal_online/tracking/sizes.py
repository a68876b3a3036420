"""How large a change is that a belief has followed: as a number, and in words."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from armcal.base.domains import Array

from armcal_online.tracking.belief import Belief
from armcal_online.tracking.directions import Steps
from armcal_online.tracking.hypotheses import Hypothesis
from armcal_online.tracking.state_space import StateSpace

_UNITS = {
    "angle": ("deg", math.degrees(1.0)),
    "length": ("mm", 1000.0),
    "mass": ("g", 1000.0),
    "angle a day": ("deg a day", math.degrees(1.0)),
    "length a day": ("mm a day", 1000.0),
}
_DIMENSIONS = {"rad": "angle", "m": "length"}
_CLEAR = 3.0
"""So many standard deviations from zero a number is worth saying."""


@dataclass(frozen=True)
class Size:
    """Of a change, and its standard deviation (rad, m or kg by ``dimension``); in words."""

    value: float
    deviation: float
    dimension: str
    shown: str


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
        return Size(0.0, 0.0, "", "")
    along = change.step / float(change.step @ change.step)
    dimension = next((joint.dimension for joint in steps.joints if joint.joint == change.subject), "")
    if change.kind == "payload_changed":
        return _with_centre(space, moved, covariance, _sized(*_along(along, moved, covariance), "mass"))
    return _sized(*_along(along, moved, covariance), dimension) if dimension else Size(0.0, 0.0, "", "")


def rate_of(steps: Steps, change: Hypothesis, size: Array, covariance: Array) -> Size:
    """How fast a gradual change goes on, by its size and covariance in standard deviations (k, k x k)."""
    rates = np.array(change.rates)
    moved, own = size * rates, covariance * np.outer(rates, rates)
    sliding = {joint.joint for joint in steps.joints if joint.dimension == "length"}
    is_length = change.kind == "sensor_drifting" or change.subject in sliding
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
    units = [block.unit for block in space.parameters.free for _ in range(block.domain.dof)]
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
    """The length of a motion along a direction, and its standard deviation."""
    return float(along @ moved), math.sqrt(max(float(along @ covariance @ along), 0.0))


def _sized(value: float, deviation: float, dimension: str) -> Size:
    unit, factor = _UNITS[dimension]
    digits = 0 if dimension == "mass" else 2
    shown = f"{factor * value:+.{digits}f} {unit} (sd {factor * deviation:.{digits}f} {unit})"
    return Size(value, deviation, dimension, shown)
