"""How far the clock of a measurement is ahead of that of the joints, from the motions between rests.

In each motion the measured path is that of the nominal tool, delayed, up to an affine map, which takes up where base
and target are and most of what the nominal arm is wrong by. Each motion gives an offset, their scatter the interval.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from armcal.base.arrays import Array
from scipy.interpolate import CubicSpline
from scipy.special import stdtrit

from armcal_ros2.samples import JointRest

_BESIDE_S = 0.3  # So much of the rests before and after a motion belongs to it
_SEARCHED_S, _COARSE_S, _FINE_S = 1.0, 0.02, 0.004
_FINE_STEPS = 15
_LEAST_MOTION_M = 0.02
_MOST_MOTIONS, _FEWEST_MOTIONS, _FEWEST_SAMPLES = 80, 5, 12
_LONGEST_MOTION_S = 20.0
_PLAY = np.deg2rad(3.0)
"""More than joints have play: until each has turned by so much, the tool comes late, whatever the clocks say."""
_WORST_MISFIT = 0.02  # Of the variance of the measured path
_WIDEST_S = 0.02
_FAR, _SURE = 4.0, 4.0


@dataclass(frozen=True)
class ClockOffset:
    """How far a clock is ahead."""

    seconds: float  # the mean (s)
    half_width: float  # of its 95 % interval (s)
    motions: int  # from how many it is known
    drift: float  # by how much it grew during the recording (s); 0 if that is not sure


@dataclass(frozen=True)
class _Motion:
    """Times (s) and places (m) of the nominal tool in a motion, and from when to when it is compared."""

    times: Array
    places: Array
    begin: float
    end: float

    @cached_property
    def _spline(self) -> CubicSpline:
        """Chords between thinned states would come late where the tool slows down."""
        return CubicSpline(self.times, self.places)

    def misfit(self, seen_at: Array, seen: Array, offset: float, near: float) -> float:
        """The part of the variance of the measured path that the delayed nominal one leaves; NaN if it is not seen.

        ``near``: an offset (s) that chooses the measured samples; offsets that are compared finely must share them.
        """
        first, last = np.searchsorted(seen_at, (self.begin + near, self.end + near))
        if last - first < _FEWEST_SAMPLES:
            return float("nan")
        at, path = seen_at[first:last] - offset, seen[first:last]
        design = self._spline(np.clip(at, self.times[0], self.times[-1]))
        design, path = design - design.mean(axis=0), path - path.mean(axis=0)
        left = path - design @ np.linalg.lstsq(design, path, rcond=1e-3)[0]
        return float((left**2).sum() / max((path**2).sum(), 1e-12))


def estimated_offset(
    rests: Sequence[JointRest],
    path: tuple[Array, Array],
    seen: tuple[Array, Array],
    tool: Callable[[Array], Array],
    guess: float,
) -> ClockOffset | str:
    """The offset, or why it cannot be known: a sentence.

    Args:
        rests: of the joints, in order.
        path: times (N, s) and joints (N x joints) between them.
        seen: times (M, s, by the clock in question) and measured positions (M x 3, m).
        tool: positions of the nominal tool (N x 3, m) at joints (N x joints).
        guess: about where the offset is (s).
    """
    motions = _motions(rests, path, tool)
    if len(motions) < _FEWEST_MOTIONS:
        text = f"found {len(motions)} motions of more than {1000 * _LEAST_MOTION_M:g} mm between rests"
        return f"{text}, at least {_FEWEST_MOTIONS} needed"
    steps = guess + np.arange(-_SEARCHED_S, _SEARCHED_S + _COARSE_S / 2, _COARSE_S)
    costs = np.array([[motion.misfit(*seen, offset, offset) for offset in steps] for motion in motions])
    seen_there = np.isfinite(costs).all(axis=1)
    if seen_there.sum() < _FEWEST_MOTIONS:
        return f"the measurement saw {seen_there.sum()} motions of {len(motions)}, at least {_FEWEST_MOTIONS} needed"
    motions = [motion for motion, is_seen in zip(motions, seen_there, strict=True) if is_seen]
    total = np.median(costs[seen_there], axis=0)
    best = int(np.argmin(total))
    if best in (0, len(steps) - 1):
        return f"no offset within {_SEARCHED_S:g} s of {guess:.3f} s fits"
    if total[best] > _WORST_MISFIT:
        return f"the measured path does not follow the joints: {100 * total[best]:.1f} % of its variance are left"
    offsets = np.array([_finest(motion, seen, float(steps[best])) for motion in motions])
    return _combined(np.array([motion.begin for motion in motions]), offsets)


def _combined(times: Array, offsets: Array) -> ClockOffset | str:
    """The mean of those that are not far off, with its interval, and its change from the first motion to the last."""
    away = np.abs(offsets - np.nanmedian(offsets))
    kept = away <= _FAR * max(1.4826 * float(np.nanmedian(away)), 1e-4)
    count, times, offsets = int(kept.sum()), times[kept], offsets[kept]
    if count < max(_FEWEST_MOTIONS, len(kept) / 2):
        return f"motions disagree: {count} of {len(kept)} have about the same offset"
    mean, spread = float(offsets.mean()), float(offsets.std(ddof=1))
    half_width = float(stdtrit(count - 1, 0.975)) * spread / np.sqrt(count)
    if half_width > _WIDEST_S:
        return f"motions disagree: {1000 * mean:.0f} +- {1000 * half_width:.0f} ms"
    since = times - times.mean()
    rate = float(since @ offsets / (since @ since))
    doubt = float(np.std(offsets - mean - rate * since, ddof=2) / np.sqrt(since @ since))
    drift = rate * float(np.ptp(times))
    return ClockOffset(mean, half_width, count, drift if abs(rate) > _SURE * doubt else 0.0)


def _motions(rests: Sequence[JointRest], path: tuple[Array, Array], tool: Callable[[Array], Array]) -> list[_Motion]:
    times, joints = path
    motions: list[_Motion] = []
    pairs = [*pairwise(rests)]
    for before, after in pairs[:: 1 + len(pairs) // _MOST_MOTIONS]:
        begin, end = before.end - _BESIDE_S, after.begin + _BESIDE_S
        first, last = np.searchsorted(times, (begin, end))
        if last - first < _FEWEST_SAMPLES or end - begin > _LONGEST_MOTION_S:
            continue
        turned = np.abs(joints[first:last] - joints[first])
        start = first + int(np.argmax(np.all((turned > _PLAY) | (turned[-1] <= _PLAY), axis=1)))
        if last - start < _FEWEST_SAMPLES:
            continue
        places = tool(joints[first:last])
        if np.linalg.norm(places[-1] - places[start - first]) > _LEAST_MOTION_M:
            motions.append(_Motion(times[first:last], places, times[start], end))
    return motions


def _finest(motion: _Motion, seen: tuple[Array, Array], near: float) -> float:
    """The offset at which a motion fits best (s), the vertex of a parabola through the best three; NaN at an edge."""
    offsets = near + _FINE_S * np.arange(-_FINE_STEPS, _FINE_STEPS + 1)
    costs = np.array([motion.misfit(*seen, offset, near) for offset in offsets])
    if not np.isfinite(costs).all() or (best := int(np.argmin(costs))) in (0, len(costs) - 1):
        return float("nan")
    before, here, after = costs[best - 1 : best + 2]
    bend = before - 2 * here + after
    return float(offsets[best] + (_FINE_S * (before - after) / (2 * bend) if bend > 0 else 0.0))
