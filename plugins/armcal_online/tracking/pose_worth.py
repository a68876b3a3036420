"""How much one more record at each of some poses would tell, from a calibration alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from armcal.base.dataset import Dataset
from armcal.errors import ConfigError, NotConvergedError
from armcal.estimate.online import Linearised

from armcal_online.tracking.observer import Seen
from armcal_online.tracking.start import FilterSetup
from armcal_online.tracking.what_if import Worth, of_errors, worth


@dataclass(frozen=True)
class PoseWorth:
    """A pose (its index among the commands) and what a record there would tell."""

    place: int
    worth: Worth


def ranked(setup: FilterSetup, commands: Dataset) -> tuple[tuple[PoseWorth, ...], tuple[int, ...]]:
    """All poses, the one that would tell most first, and those at which the arm finds no equilibrium.

    Each is seen by itself: a second record at the best pose tells less. The error that the calibration's residuals
    had counts as noise; ``deviation`` is of what errors count: of a position, where directions are read beside it.

    Raises:
        ConfigError: no measurement reads a single pose.
    """
    pose_worths, lost = [], []
    for place in range(len(commands)):
        try:
            seen, counted = _seen(setup, {name: float(values[place]) for name, values in commands.channels.items()})
        except NotConvergedError:
            lost.append(place)
            continue
        own = worth(setup.space, setup.belief, seen)
        deviation = worth(setup.space, setup.belief, counted).deviation
        pose_worths.append(PoseWorth(place, replace(own, deviation=deviation)))
    return tuple(sorted(pose_worths, key=lambda each: -each.worth.bits)), tuple(lost)


def _seen(setup: FilterSetup, channels: dict[str, float]) -> tuple[Linearised, Linearised]:
    """A record with these commands that reads what the calibration predicts, and the part of it that errors count."""
    observer, belief = setup.observer, setup.belief
    known = {name: value for name, value in channels.items() if np.isfinite(value)}
    readings = observer.predicted(belief.origin, known)
    if not readings:
        raise ConfigError(
            "no measurement of the calibration reads a single pose.",
            hint="Only instruments foretell what they would tell; give a calibration that was made with one.",
        )
    noise = observer.joint_noise(belief.origin, readings)
    mean = belief.gaussian.mean
    seen = Seen(observer, belief.origin, mean, readings, noise).at(mean)
    return seen, of_errors(setup.problem, readings, seen)
