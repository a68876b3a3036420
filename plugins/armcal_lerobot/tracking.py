"""How a joint follows its command: delay, gain, offset, backlash and what a load does, each with a 95 % interval.

The delay comes from frames in motion, the rest from slow ones: y = a + g p(u, b) + c T, with the command u (delayed),
what play p of the width b leaves of it, and gravity's torque T about the joint; the slope of p by b is the side on
which the play rests. Neighbouring frames share their errors, so intervals are by whole stretches of motion: a sandwich
covariance by clusters [Liang1986].
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from armcal.base.arrays import Array, Mask
from armcal.errors import DataError, InputError, Location
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.stats import t as student

from armcal_lerobot.motor_file import MotorFile, Units, is_gripper
from armcal_lerobot.recordings import ACTION, STATE, Frames, Recording

MOST_FRAMES = 100_000  # Of a larger data set every second, third, ... episode is taken, so that memory stays bounded.
_FEWEST = 10
_MOST_PERCENT = 105.0
_RADIANS_MOVED = 0.5
"""An arm whose joints all stay within pi, and that moves by so much: in degrees it would hardly move at all."""


@dataclass(frozen=True)
class Stretch:
    """Frames of one episode without a gap: commands and states (N x motors), in degrees where these are known."""

    episode: int
    commanded: Array
    reached: Array


@dataclass(frozen=True)
class Motion:
    """A data set's motion."""

    motors: tuple[str, ...]  # in the order of the columns
    units: tuple[str, ...]  # of each motor's numbers: deg or %
    fps: float  # frames a second
    stretches: tuple[Stretch, ...]  # without gaps
    frames: int  # how many were taken
    of: int  # how many there are


def read_motion(recording: Recording, units: Units, file: MotorFile | None) -> Motion:
    """Commands and states of a data set.

    Args:
        recording: the data set.
        units: of its numbers; the gripper's are always percent.
        file: the follower's calibration, which percent needs to become degrees.

    Raises:
        DataError: it is damaged, or holds too little.
        InputError: the calibration lacks a motor.
    """
    motors = recording.motors
    factors, shown = zip(*(unit_of(name, units, file) for name in motors), strict=True)
    step = max(1, math.ceil(recording.frames / MOST_FRAMES))
    stretches, taken = [], 0
    columns: list[tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]] = []
    for frames in recording.read((ACTION, STATE)):
        require_percent(frames, recording, units)
        keep = frames.episode % step == 0
        if keep.any() and taken < MOST_FRAMES:
            some = frames.chosen(keep)
            columns.append((some.episode, some.frame, some.vectors[ACTION], some.vectors[STATE]))
            taken += len(some)
    if taken < _FEWEST:
        where = Location(str(recording.folder))
        raise DataError(f"found {taken} frames, expected at least {_FEWEST}.", where=where, hint="Record more.")
    episode, frame, action, state = (np.concatenate(parts) for parts in zip(*columns, strict=True))
    require_degrees(recording, units, state.min(axis=0), state.max(axis=0))
    gaps = np.flatnonzero((np.diff(episode) != 0) | (np.diff(frame) != 1)) + 1
    scale = np.array(factors)
    for start, end in pairwise([0, *gaps.tolist(), len(episode)]):
        if end - start >= _FEWEST:
            stretches.append(Stretch(int(episode[start]), action[start:end] * scale, state[start:end] * scale))
    if not stretches:
        where = Location(str(recording.folder), field="frame_index")
        text = f"found no {_FEWEST} frames in a row of one episode."
        raise DataError(text, where=where, hint="Record episodes without gaps.")
    return Motion(motors, shown, recording.fps, tuple(stretches), taken, recording.frames)


def require_percent(frames: Frames, recording: Recording, units: Units) -> None:
    """Raise DataError if states that should be percent are more than their ranges let them be."""
    beyond = np.argwhere(np.abs(frames.vectors[STATE]) > _MOST_PERCENT)
    if units == "percent" and len(beyond):
        row, column = beyond[0]
        text = f"found {frames.vectors[STATE][row, column]:.1f} of {recording.motors[column]}, expected percent."
        hint = "Its numbers are degrees: leave --units percent out."
        raise DataError(text, where=Location(str(frames.file), field=STATE), hint=hint)


def require_degrees(recording: Recording, units: Units, lowest: Array, highest: Array) -> None:
    """Raise DataError if states that should be degrees look like radians, by their ends (motors)."""
    turning = [i for i, name in enumerate(recording.motors) if not is_gripper(name)]
    low, high = lowest[turning], highest[turning]
    widest = float(np.max(high - low, initial=0.0))
    if units == "degrees" and widest > _RADIANS_MOVED and np.max(np.abs([low, high])) <= np.pi:
        text = f"found {low.min():.2f} to {high.max():.2f} in all joints, expected degrees: they look like radians."
        hint = "Multiply joint states and actions by 57.29578, as LeRobot records degrees or percent."
        raise DataError(text, where=Location(str(recording.folder), field=STATE), hint=hint)


def require_motors(file: MotorFile, motors: Sequence[str]) -> None:
    """Raise InputError if a calibration file lacks one of the motors."""
    missing = [name for name in motors if name not in file.motors]
    if missing:
        text = f"found no motor {missing[0]}; it has {', '.join(file.motors)}."
        hint = "Give the calibration file of the arm that the data set was recorded with."
        raise InputError(text, where=Location(str(file.path)), hint=hint)


def unit_of(name: str, units: Units, file: MotorFile | None) -> tuple[float, str]:
    """What turns a motor's numbers into degrees, and the unit that they then have."""
    if is_gripper(name) or (units == "percent" and file is None):
        return 1.0, "%"
    if units == "degrees" or file is None:
        return 1.0, "deg"
    require_motors(file, [name])
    return file.motors[name].degrees_in(units), "deg"


Torque = Callable[[Array], Array]
"""Gravity about the joints of the motors (N x motors; N m) for commands (N x motors); NaN for a motor without joint."""
REVERSAL = 0.35  # deg or %: a command that comes back by less has not reversed; a servo's count is 0.09 deg
SETTLED = 3.0  # deg or %: after so much travel from a reversal any play is taken up
SLOW_A_SECOND, FAST_A_SECOND = 8.0, 10.0
_CLUSTER_S = 3.0
_EARLIEST_S, _LATEST_S, _FINEST = -0.4, 0.6, 0.25
_FEWEST_CLUSTERS, _FEWEST_SIDES = 6, 3
_LEAST_SPAN = 3.0
_LEAST_TORQUE = 0.02
_LEAST_GAIN = 0.1
_L1_STEPS, _L1_FLOOR = 10, 1e-3
_OBSTRUCTED, _FAR = 0.5, 9.0  # deg or %, and medians: a joint that is further off did not get where it was sent
_MOST_FREE = 0.98
_STEPS = 3
_SETTLES_S = 0.5  # After a fast motion, until a servo that lags has arrived
_THIRD_OF_A_COUNT, _FINEST_GAIN = 0.03, 0.0005
_CONFIDENCE = 0.975


@dataclass(frozen=True)
class Figure:
    """A number and its 95 % interval."""

    value: float
    low: float
    high: float

    def times(self, factor: float) -> Figure:
        ends = sorted((self.low * factor, self.high * factor))
        return Figure(self.value * factor, *ends)

    def plus(self, number: float) -> Figure:
        return Figure(self.value + number, self.low + number, self.high + number)

    def no_finer(self, half: float) -> Figure:
        return Figure(self.value, min(self.low, self.value - half), max(self.high, self.value + half))


@dataclass(frozen=True)
class Tracking:
    """How one motor's state follows its command; None where the data cannot say, and ``doubts`` say why."""

    motor: str  # its name
    unit: str  # deg, or % where degrees are not known
    span: float  # of the command, without its outermost hundredths
    delay_s: Figure | None = None  # state behind command; below zero the command follows the state
    gain: Figure | None = None  # state over command, at rest
    offset: Figure | None = None  # of the state at rest, in the middle of the motion
    backlash: Figure | None = None  # by how much the command has to come back before the state does
    load: Figure | None = None  # per N m of gravity about the joint
    doubts: tuple[str, ...] = ()  # sentences


def trackings(motion: Motion, torque: Torque | None = None) -> tuple[Tracking, ...]:
    return tuple(_tracking(motion, index, torque) for index in range(len(motion.motors)))


def delayed(values: Array, frames: float) -> Array:
    """Values (N) so many frames later; NaN where they are not known."""
    at = np.arange(len(values)) - frames
    return np.asarray(np.interp(at, np.arange(len(values)), values, left=np.nan, right=np.nan))


def sides(command: Array) -> tuple[Array, Array]:
    """Which way a command moved last (N; -1, 1, or 0 before its first motion), and how far since it reversed."""
    side, way = np.zeros(len(command)), np.zeros(len(command))
    now, turned, extreme = 0.0, command[0], command[0]
    for i, value in enumerate(command.tolist()):
        if now == 0.0:
            if abs(value - turned) > REVERSAL:
                now, extreme = (1.0 if value > turned else -1.0), value
        elif (value - extreme) * now > 0:
            extreme = value
        elif abs(value - extreme) > REVERSAL:
            now, turned, extreme = -now, extreme, value
        side[i], way[i] = now, abs(extreme - turned)
    return side, way


def played(command: Array, width: float) -> Array:
    """What follows a command (N) through play of a width: it stays until the command has taken the play up."""
    values, now, half = np.empty(len(command)), float(command[0]), width / 2
    for i, value in enumerate(command.tolist()):
        now = min(max(now, value - half), value + half)
        values[i] = now
    return values


def _tracking(motion: Motion, index: int, torque: Torque | None) -> Tracking:
    commands = np.concatenate([stretch.commanded[:, index] for stretch in motion.stretches])
    low, high = np.percentile(commands, [1, 99])
    known = Tracking(motion.motors[index], motion.units[index], float(high - low))
    if known.span < _LEAST_SPAN:
        text = f"it moved by {known.span:.1f} {known.unit} only: nothing but its offset can be known"
        known = replace(known, doubts=(text,))
    else:
        delay, doubt = _delay(motion, index)
        known = replace(known, delay_s=delay, doubts=(doubt,) if doubt else ())
    width = 0.0
    for _ in range(_STEPS):  # of Gauss and Newton: the backlash
        estimate = _at_rest(motion, index, known, torque, width)
        if estimate.backlash is None:
            break
        width = max(estimate.backlash.value, 0.0)
    return estimate


def _delay(motion: Motion, index: int) -> tuple[Figure | None, str]:
    """From frames in motion: the delay that leaves least, then one step of Gauss and Newton for its interval."""
    pairs = [(stretch.commanded[:, index], stretch.reached[:, index]) for stretch in motion.stretches]
    fps = motion.fps
    grid = np.arange(_EARLIEST_S * fps, _LATEST_S * fps + _FINEST, _FINEST)
    speeds = [np.gradient(command) * fps for command, _ in pairs]
    moving = [binary_dilation(np.abs(speed) > FAST_A_SECOND, iterations=round(_LATEST_S * fps)) for speed in speeds]
    if sum(int(mask.sum()) for mask in moving) < 3 * fps:
        return None, "it hardly moves fast: its delay cannot be known"
    best = min(grid, key=lambda frames: _left(pairs, moving, frames))
    rows, y, cluster = [], [], []
    for number, ((command, state), speed, mask) in enumerate(zip(pairs, speeds, moving, strict=True)):
        late, rate = delayed(command, best), delayed(speed, best)
        side, way = sides(np.where(np.isfinite(late), late, command[0] if best > 0 else command[-1]))
        keep = mask & np.isfinite(late) & (way > SETTLED)  # backlash looks like a delay where motion has one speed
        rows.append(np.column_stack([np.ones(keep.sum()), late[keep], -rate[keep], -side[keep]]))
        y.append(state[keep])
        cluster.append(number * 1_000_000 + np.flatnonzero(keep) // max(1, round(_CLUSTER_S * fps)))
    fit = _fit(np.concatenate(rows), np.concatenate(y), np.concatenate(cluster))
    if fit is None:
        return None, "too few motions: its delay cannot be known"
    gain, seconds = fit[1].value, fit[2]
    if abs(gain) < _LEAST_GAIN:
        return None, "its state does not follow its command"
    late_s = seconds.times(1 / gain)
    if best in (grid[0], grid[-1]):
        return None, f"its delay is beyond {best / fps:+.1f} s"
    return late_s.plus(best / fps).no_finer(_FINEST / fps / 2), ""


def _left(pairs: Sequence[tuple[Array, Array]], moving: Sequence[Mask], frames: float) -> float:
    """What a line leaves of the states at a delay, over all stretches."""
    late, state = [], []
    for (command, reached), mask in zip(pairs, moving, strict=True):
        shifted = delayed(command, frames)
        keep = mask & np.isfinite(shifted)
        late.append(shifted[keep])
        state.append(reached[keep])
    x, y = np.concatenate(late), np.concatenate(state)
    if len(x) < 3 or not np.ptp(x):
        return np.inf
    slope, level = np.polyfit(x, y, 1)
    return float(np.mean((y - slope * x - level) ** 2))


def _at_rest(motion: Motion, index: int, known: Tracking, torque: Torque | None, width: float) -> Tracking:
    """Gain, offset, backlash and load from slow frames: the linear fit about one width of the play."""
    delay = (known.delay_s.value if known.delay_s else 0.0) * motion.fps
    rows = _slow_rows(motion, index, delay, width, torque)
    if rows is None:
        return replace(known, doubts=(*known.doubts, "it hardly stands or moves slowly: only its delay can be known"))
    command, state, speed, side, load, cluster = rows
    doubts, middle = list(known.doubts), float(command.mean())
    columns = {"offset": np.ones(len(command))}
    if known.span >= _LEAST_SPAN and np.ptp(command) >= _LEAST_SPAN:
        columns |= {"gain": command - middle, "speed": speed}
        visits = [len(np.unique(cluster[side == one])) for one in (-1, 1)]
        if min(visits) >= _FEWEST_SIDES:
            columns["backlash"] = -side / 2
        else:
            doubts.append(f"it comes to rest {visits[1]} times from below and {visits[0]} from above: no backlash")
    if np.isfinite(load).all() and np.ptp(load) > _LEAST_TORQUE and "gain" in columns:
        columns["load"] = load - load.mean()
    target = state - (middle if "gain" in columns else command)
    matrix = np.column_stack(list(columns.values()))
    free = _unobstructed(matrix, target)
    if np.mean(free) < _MOST_FREE:
        text = f"in {100 - 100 * np.mean(free):.0f} % of its frames at rest it is far from where the others let expect"
        doubts.append(f"{text}: a limit or an obstacle stopped it; they are left out")
    fit = _fit(matrix[free], target[free], cluster[free])
    if fit is None:
        return replace(known, doubts=(*doubts, "too few separate rests for intervals: record more episodes"))
    figures = dict(zip(columns, fit, strict=True))
    gain, backlash = figures.get("gain"), figures.get("backlash")
    if backlash is not None and gain is not None and abs(gain.value) > _LEAST_GAIN:
        backlash = backlash.times(1 / gain.value).plus(width).no_finer(_THIRD_OF_A_COUNT)
    gain = gain.no_finer(_FINEST_GAIN) if gain else None
    return replace(
        known, gain=gain, offset=figures["offset"], backlash=backlash, load=figures.get("load"), doubts=tuple(doubts)
    )


def _slow_rows(
    motion: Motion, index: int, delay: float, width: float, torque: Torque | None
) -> tuple[Array, Array, Array, Array, Array, NDArray[np.int64]] | None:
    """Command through the play, state, speed, side, torque and cluster of slow frames whose play is taken up."""
    parts: list[tuple[Array, Array, Array, Array, Array, NDArray[np.int64]]] = []
    for number, stretch in enumerate(motion.stretches):
        late = np.column_stack([delayed(column, delay) for column in stretch.commanded.T])
        known = np.flatnonzero(np.isfinite(late).all(axis=1))
        if len(known) < 3:
            continue
        late = late[known]
        command, state = late[:, index], stretch.reached[known, index]
        speed = np.gradient(command) * motion.fps
        quick = np.abs(speed) > SLOW_A_SECOND
        for frames in range(1, round(_SETTLES_S * motion.fps) + 1):
            quick[frames:] |= np.abs(speed[:-frames]) > SLOW_A_SECOND
        side, way = sides(command)
        # A motor that never left its place has no side, and its offset counts all the same.
        keep = ~quick & ((way > SETTLED) if np.ptp(command) > REVERSAL else np.ones(len(command), dtype=bool))
        load = torque(late[keep])[:, index] if torque else np.full(int(keep.sum()), np.nan)
        turns = np.cumsum(np.abs(np.diff(side, prepend=side[0])) > 0)
        blocks = np.arange(len(command)) // max(1, round(_CLUSTER_S * motion.fps))
        cluster = (number * 10**10 + turns * 10**5 + blocks)[keep]
        parts.append((played(command, width)[keep], state[keep], speed[keep], side[keep], load, cluster))
    if len({int(cluster) for part in parts for cluster in part[5]}) < 2:
        return None
    command, state, speed, side, load, cluster = (np.concatenate(column) for column in zip(*parts, strict=True))
    return command, state, speed, side, load, cluster


def _unobstructed(rows: Array, y: Array) -> Mask:
    """Frames that agree with the least sum of absolute residuals: the rest was stopped on its way, or pushed."""
    weight = np.ones(len(y))
    for _ in range(_L1_STEPS):
        root = np.sqrt(weight)[:, None]
        solution = np.linalg.lstsq(rows * root, y * root[:, 0], rcond=None)[0]
        residual = np.abs(y - rows @ solution)
        weight = 1 / np.maximum(residual, _L1_FLOOR)
    return np.asarray(residual <= max(_OBSTRUCTED, _FAR * float(np.median(residual))))


def _fit(rows: Array, y: Array, cluster: NDArray[np.int64]) -> list[Figure] | None:
    """Least squares with intervals by clusters of frames; None where clusters are few or a column says nothing."""
    groups, place = np.unique(cluster, return_inverse=True)
    count, size = len(groups), rows.shape[1]
    scale = np.linalg.norm(rows, axis=0)
    if count < max(_FEWEST_CLUSTERS, size + 2) or not scale.all():
        return None
    scaled = rows / scale
    if np.linalg.matrix_rank(scaled, tol=1e-6) < size:
        return None
    solution = np.linalg.lstsq(scaled, y, rcond=None)[0]
    scores = np.zeros((count, size))
    np.add.at(scores, place, scaled * (y - scaled @ solution)[:, None])
    inverse = np.linalg.inv(scaled.T @ scaled)
    covariance = inverse @ (scores.T @ scores) @ inverse * count / (count - 1) * len(y) / max(1, len(y) - size)
    half = student.ppf(_CONFIDENCE, count - size) * np.sqrt(np.diag(covariance)) / scale
    values = solution / scale
    return [Figure(float(v), float(v - h), float(v + h)) for v, h in zip(values, half, strict=True)]
