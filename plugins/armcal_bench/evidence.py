"""Whether measured poses are the model's in another frame, or come in other units or from a left-handed frame.

Neither the frame of the measurements nor the target's place on the tool has to be known. Relative rotations show how
the frame is turned, whatever its lengths; positions then show how much too large those are, and whether the frame is
left-handed: a reflection reverses lengths along the axes of rotations. So three poses suffice where rotations are
measured; positions alone show the gain by three, and the handedness by five.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import numpy as np
from armcal.base.arrays import Array
from armcal.base.units import length_mistake
from armcal.diagnose.data import FITS, MISSES, MUCH_BETTER
from armcal.problem.rigid_alignment import rigid_fit, spread_of

from armcal_bench.bench import ArrivalSettings
from armcal_bench.tracker_monitor import Stand, StopRequested, pose_of

FEWEST = 3  # Poses: fewer show neither a gain nor a reflection
_MOST = 30
_FEWEST_FOR_TARGET = 5
_ROUNDS = 12
_TARGET_WEIGHT = 0.2
"""A metre that the target lies off its place on the model's tool counts as much as this many that are left over."""
_MOST_TARGET_M = 0.3
_LEVER_M = 0.1
_GAIN_OFF, _LEAST_GAIN = 2.0, 1e-6
_ROUGHLY = 3.0  # A gain shows in each distance, a reflection in all of them together
_LEAST_MOTION, _FAR_MOTION = 0.05, 0.5
"""Of the reach: sag, play, the target's place and axes that are not as drawn are no gain where the model moves the tool
by less, and the target moves by less."""
_TINY = 1e-9


@dataclass(frozen=True)
class MeasuredFrame:
    """How measured poses lie to the model's: ``p = gain turn mirror (e + R_e target) + shift``."""

    gain: float  # measured lengths, in lengths of the model
    is_mirrored: bool  # whether the frame is left-handed; ``mirror`` is -1 then, else 1
    with_rotations: bool  # whether the measured rotations agree with the model's in this frame; False where none are
    left: float  # what is not explained (root mean square by degrees of freedom, m of the model's lengths)


@dataclass(frozen=True)
class FrameMistake:
    sentence: str  # what is off, by how much, and by how many poses, without its full stop
    mend: str  # what to do, a full sentence
    frame: MeasuredFrame  # that explains the poses


def frame_mistake(expected: Array, seen: Array) -> FrameMistake | None:
    """What is wrong with the units or the handedness of poses as they were seen in any frame; None where nothing is."""
    if len(seen) < FEWEST:
        return None
    some = np.unique(np.linspace(0, len(seen) - 1, _MOST).astype(int))  # the last alone may hardly move the tool
    expected, seen = expected[some], seen[some]
    spread, reach = spread_of(expected[:, :3, 3].T), float(np.linalg.norm(expected[:, :3, 3], axis=1).max())
    moved = spread_of(seen[:, :3, 3].T)
    shows_gain = spread > _LEAST_MOTION * reach or moved > _FAR_MOTION * reach
    straight = {rotations: _fitted(expected, seen, 1.0, 1.0, rotations) for rotations in (True, False)}
    if straight[True].left <= MISSES * spread:
        return None
    fitting, are_measured = list[MeasuredFrame](), not bool(np.isnan(seen[:, 0, 0]).any())
    for gain, mirror, rotations in product((None, 1.0), (1.0, -1.0), (True, False)):
        # Without rotations three points lie in one plane, four almost: they show no reflection.
        shows_mirror = (rotations and are_measured) or len(seen) >= _FEWEST_FOR_TARGET
        if (gain and mirror > 0) or (mirror < 0 and not shows_mirror):
            continue
        other = _fitted(expected, seen, gain, mirror, rotations)
        enough = min(FITS * spread, straight[rotations].left / MUCH_BETTER)
        gains = (other.gain, moved / spread if spread else np.inf)
        is_gain = other.gain > _LEAST_GAIN and not any(1 / _GAIN_OFF < ratio < _GAIN_OFF for ratio in gains)
        if gain is None and not (shows_gain and is_gain):
            continue
        if other.left <= enough * (1 if other.is_mirrored else _ROUGHLY):
            fitting.append(other)
    if not fitting:
        return None
    fitting.sort(key=lambda other: other.left)
    plain = next((other for other in fitting if not other.is_mirrored), fitting[0])
    best = fitting[0] if fitting[0].left < plain.left / MUCH_BETTER else plain
    return _mistake(best, len(seen))


def _fitted(expected: Array, seen: Array, stated: float | None, mirror: float, with_rotations: bool) -> MeasuredFrame:
    """Turn, shift, target and gain (where none is stated) by turns, each the least squares of all others."""
    places, goals, count = expected[:, :3, 3], seen[:, :3, 3], len(seen)
    has_rotations = with_rotations and not bool(np.isnan(seen[:, 0, 0]).any())
    pairs = list(combinations(range(count), 2)) if has_rotations else []
    fits_target = has_rotations or count >= _FEWEST_FOR_TARGET
    axes, seen_axes = _sines(expected, pairs), _sines(seen, pairs)
    lever, gain, target = spread_of(places.T), stated or 1.0, np.zeros(3)
    turn, shift, points = np.eye(3), np.zeros(3), places
    for _ in range(_ROUNDS):
        before = target
        centred, seen_centred = points - points.mean(axis=0), goals - goals.mean(axis=0)
        size = max(spread_of(goals.T), _TINY)
        both = np.vstack([mirror * lever * centred, lever**2 * axes]).T
        others = np.vstack([lever * seen_centred * (spread_of(points.T) / size), lever**2 * seen_axes]).T
        # With their opposites vectors have the origin as their middle.
        turn = rigid_fit(*(np.hstack([vectors, -vectors]) for vectors in (both, others)))[0]
        moved = mirror * centred @ turn.T
        if stated is None:
            gain = max(float(np.sum(moved * seen_centred) / max(np.sum(moved**2), _TINY**2)), _TINY)
        shift = goals.mean(axis=0) - gain * mirror * turn @ points.mean(axis=0)
        if not fits_target:
            break
        target = _target(expected, mirror * (goals / gain) @ turn)
        points = places + expected[:, :3, :3] @ target
        if np.linalg.norm(target - before) < _TINY:
            break
    off = (goals - shift) / gain - mirror * points @ turn.T
    squares, equations = float(np.sum(off**2)), 3 * count - (6 + (stated is None) + 3 * fits_target)
    if pairs:
        one, other = (np.array([pair[i] for pair in pairs]) for i in (0, 1))
        shown, measured = ((p[other, :3, :3] @ np.swapaxes(p[one, :3, :3], 1, 2)) for p in (expected, seen))
        traces = np.einsum("nij,nij->n", turn @ shown @ turn.T, measured)
        angles = np.arccos(np.clip((traces - 1) / 2, -1.0, 1.0))
        # as many independent rotations as poses but one, shared among the pairs
        squares += _LEVER_M**2 * float(np.mean(angles**2)) * 3 * (count - 1)
        equations += 3 * (count - 1)
    return MeasuredFrame(gain, mirror < 0, has_rotations, float(np.sqrt(3 * squares / max(equations, 1))))


def _sines(poses: Array, pairs: Sequence[tuple[int, int]]) -> Array:
    """The axis of the rotation from one pose to another times the sine of its angle (pairs x 3): near half a turn no
    direction is known, and there it is zero."""
    if not pairs:
        return np.zeros((0, 3))
    one, other = (poses[[pair[i] for pair in pairs], :3, :3] for i in (0, 1))
    relative = other @ np.swapaxes(one, 1, 2)
    skew = (relative - np.swapaxes(relative, 1, 2)) / 2
    return np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)


def _target(expected: Array, goals: Array) -> Array:
    """Where the target is on the tool (3, m), by positions in the base's axes (N x 3, m) up to one shift."""
    rotations, off = expected[:, :3, :3], goals - expected[:, :3, 3]
    rows = (rotations - rotations.mean(axis=0)).reshape(-1, 3)
    sizes = (off - off.mean(axis=0)).ravel()
    weak = _TARGET_WEIGHT * np.eye(3)
    target = np.linalg.lstsq(np.vstack([rows, weak]), np.concatenate([sizes, np.zeros(3)]), rcond=None)[0]
    return np.asarray(target * min(1.0, _MOST_TARGET_M / max(float(np.linalg.norm(target)), _TINY)))


def _mistake(frame: MeasuredFrame, count: int) -> FrameMistake:
    parts, mends = [], []
    if not 1 / _GAIN_OFF < frame.gain < _GAIN_OFF:
        names = length_mistake(frame.gain)
        unit = f", as if {names[0]} came where {names[1]} are expected" if names else ", which is no usual unit"
        parts.append(f"measured distances are {frame.gain:.4g} times those of the model{unit}")
        mends.append("State the unit in which the tracker gives positions, or let it give the expected one.")
    if frame.is_mirrored:
        of = "positions and rotations are" if frame.with_rotations else "positions are"
        parts.append(
            f"measured {of} mirrored: the frame is left-handed (one axis points the other way, or two are exchanged)"
        )
        mends.append("Reverse one axis of the tracker's frame, or exchange two, so that it is right-handed.")
    return FrameMistake(f"{', and '.join(parts)} (by {count} poses)", " ".join(mends), frame)


_ENOUGH = 5
_SURE, _FEWEST_STANDS = 2.5, 3  # Standard deviations, in each of most stands
_MINUTE = 60.0
_LEAST_SPEED = 0.001 / _MINUTE  # m/s: a servo that comes to rest moves so much


@dataclass(frozen=True)
class Arrival:
    """Compares how far apart the target stood in two poses, and by how much it was turned, with the nominal arm.

    Neither depends on where the tracker's frame, the base body and the tool body are. What is not known of the arm, and
    a target that is not at its nominal place, make them differ as well: the limits have to be generous.
    """

    expected: Array  # ``base_T_tool`` of the nominal, rigid arm in each pose of the plan (N x 4 x 4, m)
    settings: ArrivalSettings  # the limits

    def doubt(self, pose: int, measured: Array, others: Mapping[int, Array]) -> str:
        places = [place for place in others if place != pose]
        if not places:
            return ""
        before, expected = np.array([others[place] for place in places]), self.expected[places]
        seen, modelled = _apart(before, measured), _apart(expected, self.expected[pose])
        far, turned = _worst(seen[0] - modelled[0]), _worst(seen[1] - modelled[1])
        if far <= self.settings.astray and not turned > self.settings.astray_turned:
            return ""
        degrees = "" if np.isnan(turned) else f" and {np.rad2deg(turned):.0f} deg"
        return (
            f"the arm is not where it was commanded to be: measured {1000 * far:.0f} mm{degrees} off, as seen from "
            f"other poses (allowed: {1000 * self.settings.astray:.0f} mm, "
            f"{np.rad2deg(self.settings.astray_turned):.0f} deg)"
        )

    def mistake(self, measured: Mapping[int, Array]) -> FrameMistake | None:
        poses = list(measured)
        return frame_mistake(self.expected[poses], np.array([measured[pose] for pose in poses]).reshape(-1, 4, 4))


def _apart(poses: Array, pose: Array) -> tuple[Array, Array]:
    """How far each is from one (m), and by which angle it is turned (rad), whatever frames they are given in."""
    cosines = (np.einsum("nij,ij->n", poses[:, :3, :3], pose[:3, :3]) - 1) / 2
    return np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1), np.arccos(np.clip(cosines, -1.0, 1.0))


def _worst(differences: Array) -> float:
    """The largest, or the next where there are enough; NaN where nothing is known."""
    finite = np.sort(np.abs(differences[~np.isnan(differences)]))[::-1]
    return float(finite[1 if len(finite) >= _ENOUGH else 0]) if len(finite) else np.nan


@dataclass(frozen=True)
class Drift:
    speed: float  # root mean square (m/s)
    poses: int  # in how many it was seen

    @classmethod
    def of(cls, stands: Sequence[Stand]) -> "Drift | None":
        if len(stands) < _FEWEST_STANDS:
            return None
        rates, sds = (np.array([getattr(stand, name) for stand in stands]) for name in ("rates", "sds"))
        moving = int(np.sum(np.sqrt(np.mean((rates / sds) ** 2, axis=1)) > _SURE))
        speed = float(np.sqrt(np.mean(np.sum(rates**2, axis=1))))
        return cls(speed, moving) if 2 * moving > len(stands) and speed > _LEAST_SPEED else None

    @property
    def sentence(self) -> str:
        speed = _MINUTE * 1000 * self.speed
        return (
            f"the target moves by {speed:.{1 if speed < 10 else 0}f} mm/min while the arm should stand (in "
            f"{self.poses} poses): a joint gives way. Look at the screws of the horns, at gears and supply; a servo "
            "that is too weak for its load gives way as well: measure poses in which it carries less"
        )

    @property
    def content(self) -> dict[str, Any]:
        return {"mm_per_min": _MINUTE * 1000 * self.speed, "poses": self.poses, "what": f"{self.sentence}."}


class Evidence:
    """Everything that was measured, of poses that count and of others."""

    def __init__(
        self,
        arrival: Arrival,
        is_tolerated: Callable[[FrameMistake], bool] = lambda mistake: False,
        fewest: int = FEWEST,
        *,
        restless_ends: bool = False,
    ) -> None:
        self.doubted: dict[int, Mapping[str, Any]] = {}  # what was recorded of poses that do not count, by their index
        self.arrival, self._is_tolerated = arrival, is_tolerated
        self._fewest, self._restless_ends = fewest, restless_ends
        self._stands: list[tuple[int, Stand]] = []
        self._failed = 0

    def stood(self, pose: int, stand: Stand | None) -> None:
        if stand is not None:
            self._stands.append((pose, stand))

    def succeeded(self, pose: int) -> None:
        self._failed = 0
        self.doubted.pop(pose, None)

    def failed(self, why: str) -> None:
        self._failed += 1
        if self._failed < self.arrival.settings.in_a_row:
            return
        if (drift := self.drift(self._failed)) is not None:
            raise StopRequested(drift.sentence, how="failed")
        if self._restless_ends:
            text = f"the arm did not come to stand {self._failed} times in a row ({why})"
            raise StopRequested(f"{text}: does a servo stall, or let go?", how="failed")

    def drift(self, last: int = 0) -> Drift | None:
        return Drift.of([stand for _, stand in self._stands[-last:]])

    def mistake(self, measured: Mapping[int, Array]) -> FrameMistake | None:
        """What is wrong with the tracker's units or handedness, by ``base_T_target`` of measured poses and others."""
        glimpsed = {pose: stand.base_T_target for pose, stand in self._stands}
        doubted = {pose: pose_of(record) for pose, record in self.doubted.items()}
        seen = {**glimpsed, **measured, **doubted}
        return self.arrival.mistake(seen) if len(seen) >= self._fewest else None

    def refusal(self, measured: Mapping[int, Array]) -> str:
        """Why the run cannot go on with a mistake of units or frame; empty if it can. See ``mistake``."""
        mistake = self.mistake(measured)
        if mistake is None or self._is_tolerated(mistake):
            return ""
        return f"{mistake.sentence}. {mistake.mend} The poses that were measured are kept as they came"
