"""How a joint follows its command: delay, gain, offset and backlash, all but the delay with 95 % intervals.

The delay comes from frames in motion, the rest from slow ones: y = a + g p(u, b), with the command u (delayed) and
what play p of the width b leaves of it; the slope of p by b is the side on which the play rests. Neighbouring frames
share their errors, so intervals are by whole stretches of motion: a sandwich covariance by clusters [Liang1986].
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from armcal.arm.servo import teeth_text
from armcal.base.arrays import Array, Mask
from armcal.report.document import Document, Section, Table
from scipy.ndimage import binary_dilation
from scipy.stats import t as student

from armcal_lerobot.motor_files import teeth_of
from armcal_lerobot.recordings import REVERSAL, Recording, sides

SETTLED = 3.0  # deg or %: after so much travel from a reversal any play is taken up
SLOW_A_SECOND, FAST_A_SECOND = 8.0, 10.0
_CLUSTER_S = 3.0
_EARLIEST_S, _LATEST_S = -0.4, 0.6
_FEWEST_CLUSTERS, _FEWEST_SIDES = 6, 3
_LEAST_SPAN = 3.0
_LEAST_GAIN = 0.1
_L1_STEPS, _L1_FLOOR = 10, 1e-3
_OBSTRUCTED, _FAR = 0.5, 9.0  # deg or %, and medians: a joint that is further off did not get where it was sent
_MOST_FREE = 0.98
_STEPS = 3
_SETTLES_S = 0.5  # After a fast motion, until a servo that lags has arrived
_THIRD_OF_A_COUNT, _FINEST_GAIN = 0.03, 0.0005
_CONFIDENCE = 0.975
_SAME_GAIN, _EARLY_S = 0.03, 0.02
LIMITS_OF_DATA = (
    "What a data set cannot show: its unit (degrees are assumed; else --units percent), a wrong zero of leader or "
    "follower (the follower is sent the leader's numbers and answers in its own), and play between a servo's encoder "
    "and the link. Compare two calibration files (armcal lerobot check), or measure the gripper (armcal run)."
)


@dataclass(frozen=True)
class Figure:
    """A number and its 95 % interval."""

    value: float
    low: float
    high: float

    def shown(self, digits: int) -> str:
        """It and half of its interval."""
        return f"{self.value:.{digits}f} ±{(self.high - self.low) / 2:.{digits}f}"

    def no_finer(self, half: float) -> "Figure":
        return Figure(self.value, min(self.low, self.value - half), max(self.high, self.value + half))


@dataclass(frozen=True)
class Tracking:
    """How one motor's state follows its command; None where the data cannot say, and ``doubts`` say why."""

    motor: str  # its name
    unit: str  # deg, or % where degrees are not known
    span: float  # of the command, without its outermost hundredths
    delay_s: float | None = None  # state behind command; below zero the command follows the state
    gain: Figure | None = None  # state over command, at rest
    offset: Figure | None = None  # of the state at rest, in the middle of the motion
    backlash: Figure | None = None  # by how much the command has to come back before the state does
    doubts: tuple[str, ...] = ()  # sentences


def trackings(recording: Recording) -> tuple[Tracking, ...]:
    return tuple(_tracking(recording, index) for index in range(len(recording.motors)))


def delayed(values: Array, frames: float) -> Array:
    """Values (N x k) so many frames later; NaN where they are not known."""
    at = np.arange(len(values))
    return np.column_stack([np.interp(at - frames, at, column, left=np.nan, right=np.nan) for column in values.T])


def played(command: Array, width: float) -> Array:
    """What follows a command (N) through play of a width: it stays until the command has taken the play up."""
    values, now, half = np.empty(len(command)), float(command[0]), width / 2
    for i, value in enumerate(command.tolist()):
        now = min(max(now, value - half), value + half)
        values[i] = now
    return values


def _tracking(recording: Recording, index: int) -> Tracking:
    commands = np.concatenate([stretch.commanded[:, index] for stretch in recording.motion])
    low, high = np.percentile(commands, [1, 99])
    start = Tracking(recording.motors[index], recording.units[index], float(high - low))
    if start.span < _LEAST_SPAN:
        text = f"it moved by {start.span:.1f} {start.unit} only: nothing but its offset can be known"
        start = replace(start, doubts=(text,))
    else:
        delay, doubt = _delay_s(recording, index)
        start = replace(start, delay_s=delay, doubts=(doubt,) if doubt else ())
    width = 0.0
    for _ in range(_STEPS):  # of Gauss and Newton: the backlash
        estimate = _at_rest(recording, index, start, width)
        if estimate.backlash is None:
            break
        width = max(estimate.backlash.value, 0.0)
    return estimate


def _delay_s(recording: Recording, index: int) -> tuple[float | None, str]:
    """The delay at which a line through command and side leaves least of the states in motion; or why there is none.

    The side counts, since backlash looks like a delay where motion has one speed. A parabola goes between frames.
    """
    fps, moving = recording.fps, []
    for stretch in recording.motion:
        command = stretch.commanded[:, index]
        fast = binary_dilation(np.abs(np.gradient(command)) * fps > FAST_A_SECOND, iterations=round(_LATEST_S * fps))
        side, way = sides(command)
        moving.append(
            (np.array([command, side, np.where(fast & (way > SETTLED), 1.0, np.nan)]).T, stretch.reached[:, index])
        )
    lags = range(round(_EARLIEST_S * fps), round(_LATEST_S * fps) + 1)
    errors, gains = [], []
    for lag in lags:
        rows = np.vstack([np.column_stack([delayed(columns, lag), state]) for columns, state in moving])
        rows = rows[np.isfinite(rows).all(axis=1)]
        if len(rows) < 3 * fps:
            return None, "it hardly moves fast: its delay cannot be known"
        solution = np.linalg.lstsq(rows[:, :3], rows[:, 3], rcond=None)[0]
        errors.append(float(np.mean((rows[:, 3] - rows[:, :3] @ solution) ** 2)))
        gains.append(solution[0])
    best = int(np.argmin(errors))
    if abs(gains[best]) < _LEAST_GAIN:
        return None, "its state does not follow its command"
    if best in (0, len(lags) - 1):
        return None, f"its delay is beyond {lags[best] / fps:+.1f} s"
    before, least, after = errors[best - 1 : best + 2]
    return (lags[best] + (before - after) / (before - 2 * least + after) / 2) / fps, ""


def _at_rest(recording: Recording, index: int, start: Tracking, width: float) -> Tracking:
    """Gain, offset and backlash from slow frames: the linear fit about one width of the play."""
    rows = _slow_rows(recording, index, (start.delay_s or 0.0) * recording.fps, width)
    if len(np.unique(rows[-1])) < 2:
        text = "it hardly stands or moves slowly: only its delay can be known"
        return replace(start, doubts=(*start.doubts, text))
    command, state, speed, side, cluster = rows
    doubts, middle = list(start.doubts), float(command.mean())
    columns = {"offset": np.ones(len(command))}
    if start.span >= _LEAST_SPAN and np.ptp(command) >= _LEAST_SPAN:
        columns |= {"gain": command - middle, "speed": speed}
        visits = [len(np.unique(cluster[side == one])) for one in (-1, 1)]
        if min(visits) >= _FEWEST_SIDES:
            columns["backlash"] = -side / 2
        else:
            doubts.append(f"it comes to rest {visits[1]} times from below and {visits[0]} from above: no backlash")
    matrix, target = np.column_stack(list(columns.values())), state - (middle if "gain" in columns else command)
    free = _unobstructed(matrix, target)
    if np.mean(free) < _MOST_FREE:
        text = f"in {100 - 100 * np.mean(free):.0f} % of its frames at rest it is far from where the others let expect"
        doubts.append(f"{text}: a limit or an obstacle stopped it; they are left out")
    fit = _fit(matrix[free], target[free], cluster[free])
    if fit is None:
        return replace(start, doubts=(*doubts, "too few separate rests for intervals: record more episodes"))
    figures = dict(zip(columns, fit, strict=True))
    gain, backlash = figures.get("gain"), figures.get("backlash")
    if gain and backlash and abs(gain.value) > _LEAST_GAIN:
        ends = sorted(end / gain.value + width for end in (backlash.low, backlash.high))
        backlash = Figure(backlash.value / gain.value + width, *ends).no_finer(_THIRD_OF_A_COUNT)
    gain = gain.no_finer(_FINEST_GAIN) if gain else None
    return replace(start, gain=gain, offset=figures["offset"], backlash=backlash, doubts=tuple(doubts))


def _slow_rows(recording: Recording, index: int, late_by: float, width: float) -> list[Array]:
    """Command through the play, state, speed, side and cluster of slow frames whose play is taken up."""
    parts = []
    for number, stretch in enumerate(recording.motion):
        late = delayed(stretch.commanded[:, [index]], late_by)[:, 0]
        there = np.isfinite(late)
        if there.sum() < 3:
            continue
        command, state = late[there], stretch.reached[there, index]
        speed = np.gradient(command) * recording.fps
        quick = np.abs(speed) > SLOW_A_SECOND
        for frames in range(1, round(_SETTLES_S * recording.fps) + 1):
            quick[frames:] |= np.abs(speed[:-frames]) > SLOW_A_SECOND
        side, way = sides(command)
        # A motor that never left its place has no side, and its offset counts all the same.
        keep = ~quick & ((way > SETTLED) if np.ptp(command) > REVERSAL else np.ones(len(command), dtype=bool))
        turns = np.cumsum(np.abs(np.diff(side, prepend=side[0])) > 0)
        blocks = np.arange(len(command)) // max(1, round(_CLUSTER_S * recording.fps))
        cluster = number * 10**10 + turns * 10**5 + blocks
        parts.append(np.array([played(command, width), state, speed, side, cluster])[:, keep])
    return list(np.hstack(parts)) if parts else [np.empty(0)] * 5


def _unobstructed(rows: Array, y: Array) -> Mask:
    """Frames that agree with the least sum of absolute residuals: the rest was stopped on its way, or pushed."""
    weight = np.ones(len(y))
    for _ in range(_L1_STEPS):
        root = np.sqrt(weight)[:, None]
        solution = np.linalg.lstsq(rows * root, y * root[:, 0], rcond=None)[0]
        residual = np.abs(y - rows @ solution)
        weight = 1 / np.maximum(residual, _L1_FLOOR)
    return np.asarray(residual <= max(_OBSTRUCTED, _FAR * float(np.median(residual))))


def _fit(rows: Array, y: Array, cluster: Array) -> list[Figure] | None:
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


def compared(recording: Recording) -> Document:
    """A row a motor, what is wrong, and what the data cannot say."""
    followed = trackings(recording)
    content: dict[str, Any] = {
        "data": str(recording.folder),
        "frames": sum(len(stretch.frame) for stretch in recording.stretches),
        "motors": {t.motor: asdict(t) for t in followed},
        "findings": findings_of(followed),
        "cannot_show": LIMITS_OF_DATA,
    }
    if is_copy(recording):
        text = "Every state is a command: one was copied from the other, and nothing was measured of the arm."
        content["findings"].insert(0, text)
    texts = [*content["findings"], *(f"{t.motor}: {doubt}." for t in followed for doubt in t.doubts)]
    rows = []
    for t in followed:
        cells = [
            figure.shown(digits) if figure else "-" for figure, digits in ((t.gain, 3), (t.offset, 2), (t.backlash, 2))
        ]
        delay = "-" if t.delay_s is None else f"{1000 * t.delay_s:.0f}"
        rows.append([t.motor if t.unit == "deg" else f"{t.motor}, %", *cells, delay])
    headings = ("motor", "gain", "offset", "backlash", "delay, ms")
    table = Table("State against command (deg, or %), 95 % intervals", headings, rows)
    title = f"Leader and follower: {recording.folder.name}"
    section = Section("Motors", parts=[table], level="always")
    return Document(title, title, [section], summary=[*texts, LIMITS_OF_DATA], data=content)


def is_copy(recording: Recording) -> bool:
    """Whether states are the commands of the same frame, or of the one before."""
    frames = [(s.commanded, s.reached) for s in recording.motion if np.ptp(s.reached, axis=0).any()]
    return bool(frames) and (
        all(np.array_equal(command, state) for command, state in frames)
        or all(np.array_equal(command[:-1], state[1:]) for command, state in frames)
    )


def findings_of(followed: Sequence[Tracking]) -> list[str]:
    """What is wrong between command and state, a sentence each."""
    delays = [t.delay_s for t in followed if t.delay_s is not None]
    early = [-delay for delay in delays if delay < -_EARLY_S]
    texts = []
    if 2 * len(early) > len(delays):
        texts.append(
            f"Leader and follower are exchanged: the commands follow the states, by {1000 * np.median(early):.0f} ms, "
            f"in {len(early)} of {len(delays)} motors. action should be the leader's joints, observation.state the "
            "follower's."
        )
    for t in followed:
        if t.gain and t.gain.high < 0:
            texts.append(f"{t.motor} is inverted: its state moves {t.gain.value:+.2f} times as far as its command.")
        elif t.gain and (t.gain.low > 1 + _SAME_GAIN or t.gain.high < 1 - _SAME_GAIN):
            texts.append(
                f"{t.motor} moves {t.gain.value:.3f} times as far as commanded: ranges that differ between leader and "
                "follower, or something that stops it."
            )
        if t.offset and t.unit == "deg" and (teeth := teeth_of(t.offset.value)) and not (t.gain and t.gain.high < 0):
            off = f"{t.offset.value:+.1f} deg from its command"
            texts.append(f"{t.motor} stands {off}: {teeth_text(teeth)} would explain that.")
    return texts
