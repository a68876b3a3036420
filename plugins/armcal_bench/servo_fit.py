"""Pulse tables, backlash and springs from what a tracker, or somebody, saw of each joint's sweep.

All sweeps are one problem of the arm's model: each joint stands where its table puts the pulse, with corrections at the
table's knots, less half the backlash behind where it came from. The model's axes and springs move with them, every
number near its nominal value: what springs give is computed by the model, and a model whose axes point a few degrees
elsewhere computes it wrong. The corrections move the tables until nothing remains to correct.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from armcal.arm.assembly import Arm
from armcal.arm.servo import PulseClock, PulseTable
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.base.poses import NO_TURN
from armcal.base.quaternions import quaternion_of
from armcal.errors import NotConvergedError
from armcal.measure.rests import mean_rotation
from armcal.run.experiment import Experiment
from scipy.spatial.transform import Rotation

from armcal_bench.joint_check import permuted
from armcal_bench.servo_setup import ANGLE, POSE, KnownServo, ServoCalibrationSettings, piecewise
from armcal_bench.tracked_body import (
    BODY,
    TABLES,
    Body,
    BodyFit,
    Corrections,
    RigidArm,
    body_dataset,
    lever,
    turn_of_point,
    twist_angles,
)

Zero = Literal["kept", "measured"]


@dataclass(frozen=True)
class FittedServo:
    known: KnownServo  # as it was stated
    angles: tuple[float, ...]  # knots (rad)
    pulses: tuple[float, ...]  # at the knots (s); the stated one, and no deviation (NaN), where none is determined
    pulse_sds: tuple[float, ...]
    determined: tuple[bool, ...]  # whether the observations determine the pulse of a knot
    lag: float | None  # half the backlash (rad); None where it was not approached from both sides
    lag_sd: float
    scatter: float  # of the observed angles about the fit (rad, root mean square)
    scale: float  # the same in units of the stated deviations; deviations are enlarged by it where it is above 1
    used: int  # how many observations
    outliers: tuple[tuple[int, float], ...]  # those set aside: counts and angle (rad)
    reach: tuple[float, float]  # the lowest and highest angle observed (rad)
    by: str  # what showed the angles: ``rotation``, ``position`` or ``somebody``


@dataclass(frozen=True)
class Outcome:
    servos: Mapping[str, FittedServo]  # by joint
    clocks: Mapping[str, PulseClock]  # by board, as stated when it was measured
    silent: Mapping[str, str]  # why a joint's table could not be found, by joint
    compliances: Mapping[str, tuple[float, float]]  # of springs (rad/(N m)), value and deviation, by parameter
    undetermined: tuple[str, ...]  # compliances that the observations do not determine
    zero: Zero  # whether stated zeros were kept
    sag_span: Mapping[str, float]  # by joint, how much what the springs give varies over its sweep (rad)


Entry = Mapping[str, Any]
WEAK_SD = 0.6
"""How far a table's angle may well be off (rad): what no observation determines stays as stated."""
_ZERO_SD, _ANGLE_SD, _FRAME_SD, _PLAY_SD = 10.0, math.radians(4.0), math.radians(4.0), math.radians(0.15)
_LENGTH_SD_M, _SHIFT_SD_M, _TARGET_SD_M, _FIXED_SD = 0.005, 0.05, 0.1, 1e-6
_LEAST_SEEN_M, _LEAST_TURN = 1e-4, math.radians(1.0)
_OFF_AXIS = 0.5  # Of the turns about the joint's axis: more is another joint's
_ROUNDS, _STEADY = 8, 1e-6
_FAR_OFF = 5.0
_MOST_SCATTER = math.radians(1.0)
_DETERMINED = 0.2  # Of the deviation that was assumed: below it the observations determine the number
_NO_TABLE = "its angles neither rise nor fall with the pulse, as if it slipped, or was too hot and let go"
_CHECK_IT = "is another servo on its channel? Look with armcal servo --check"


@dataclass(eq=False)
class _Sweep:
    """What was observed of a joint, and the table that explains it so far."""

    known: KnownServo
    lines: Sequence[Entry]
    by: str
    poses: Array  # base_T_body (N x 4 x 4)
    sds: Array  # of the angle (rad)
    axis: Array  # of the joint, by the model (base frame)
    arms: Array  # from the axis to the body (N x 3, m)
    pulses: Array  # of the table at the servo's knots (counts)
    kept: Mask  # which lines count
    radius: float = 1.0  # by which an angle becomes what is compared: of its circle (m), or one

    @property
    def counts(self) -> Array:
        return np.array([float(line["counts"]) for line in self.lines])

    @property
    def falls(self) -> bool:
        return bool(self.pulses[-1] < self.pulses[0])

    @property
    def approaches(self) -> Array:
        """From where the angle came: 1 from below."""
        return np.array([float(line["came"]) for line in self.lines]) * (-1 if self.falls else 1)

    @property
    def angles(self) -> Array:
        rising = slice(None, None, -1 if self.falls else 1)
        return np.asarray(piecewise(self.pulses[rising], self.known.angles[rising])(self.counts))

    @property
    def is_table(self) -> bool:
        steps = np.diff(self.pulses)
        return bool(np.all(steps > 0) or np.all(steps < 0))

    def corrected(self, at: Array) -> bool:
        """Move the table so that its pulses are those of angles that are ``at`` beyond the knots; whether it is one."""
        angles = self.known.angles + at
        if np.all(np.diff(angles) > 0):
            self.pulses = np.asarray(piecewise(angles, self.pulses)(self.known.angles))
        return bool(np.all(np.diff(angles) > 0)) and self.is_table

    def along(self, residuals: Array) -> Array:
        """What residuals of the body are as turns about the joint's axis (N, rad)."""
        if self.by == "position":
            return np.asarray(np.einsum("ni,in->n", lever(self.arms, self.axis), residuals))
        return np.asarray(np.einsum("nji,j,in->n", self.poses[:, :3, :3], self.axis, residuals))


def outcome_of(
    entries: Sequence[Entry],
    servos: Sequence[KnownServo],
    clocks: Mapping[str, PulseClock],
    experiment: Experiment,
    arm: Arm,
    settings: ServoCalibrationSettings,
) -> Outcome:
    """Fit all that a record holds of some servos.

    One whose angles scatter as no servo's do is left out: it has let go, and would spoil the estimate of the springs.
    """
    rigid = RigidArm(arm, experiment.parameters)
    left_out = permuted(entries, [servo.joint for servo in servos], rigid)
    while True:
        remaining = [servo for servo in servos if servo.joint not in left_out]
        swept = {servo.joint: _sweep_of(entries, servo, clocks, rigid, settings) for servo in remaining}
        silent = {joint: sweep for joint, sweep in swept.items() if isinstance(sweep, str)}
        sweeps = {joint: sweep for joint, sweep in swept.items() if isinstance(sweep, _Sweep)}
        outcome = _fitted(sweeps, clocks, rigid, experiment, arm, settings)
        worst = max(outcome.servos.values(), key=lambda servo: servo.scatter, default=None)
        if worst is None or worst.scatter <= _MOST_SCATTER:
            return replace(outcome, silent={**outcome.silent, **silent, **left_out})
        left_out[worst.known.joint] = (
            f"the spread of its angles is {math.degrees(worst.scatter):.1f} deg, as if it slipped, or "
            "was too hot and let go"
        )


def _sweep_of(
    entries: Sequence[Entry],
    servo: KnownServo,
    clocks: Mapping[str, PulseClock],
    rigid: RigidArm,
    settings: ServoCalibrationSettings,
) -> _Sweep | str:
    joint, tick = servo.joint, clocks[servo.board].tick
    lines = [e for e in entries if e["kind"] == POSE and e["joint"] == joint]
    seen = list({(e["target"], e["came"]): e for e in entries if e["kind"] == ANGLE and e["joint"] == joint}.values())
    stated = servo.pulses_at(servo.angles) / tick
    if not lines and not seen:
        return "nothing was measured"
    if not lines:
        poses, everything = np.tile(np.eye(4), (len(seen), 1, 1)), np.ones(len(seen), dtype=bool)
        sds, nowhere = np.array([line["sd"] for line in seen]), np.zeros((len(seen), 3))
        return _Sweep(servo, seen, "somebody", poses, sds, np.zeros(3), nowhere, stated, everything)
    others = _others(lines, joint)
    axis, origin = rigid.axis(joint, {**others, joint: 0.0})
    poses = np.tile(np.eye(4), (len(lines), 1, 1))
    poses[:, :3, 3] = [line["position"] for line in lines]
    by = "position" if any(line["rotation"] is None for line in lines) else "rotation"
    poses[:, :3, :3] = [np.full((3, 3), np.nan) if line["rotation"] is None else line["rotation"] for line in lines]
    deviations = np.array([[d or 0.0 for d in line["deviations"]] for line in lines])
    arms, radius = poses[:, :3, 3] - origin, 1.0
    counts = np.array([line["counts"] for line in lines])
    table = PulseTable(servo.table.angles, servo.table.pulses)
    commanded = np.array([float(table.angle(count * tick)) for count in counts])
    middle = int(np.argmin(np.abs(commanded - others.get(joint, 0.0))))
    if by == "rotation":
        turns = Rotation.from_matrix(poses[:, :3, :3] @ poses[middle, :3, :3].T)
        turned = twist_angles(turns, axis)
        off = (turns * Rotation.from_rotvec(-np.outer(turned, axis))).magnitude()
        if np.ptp(turned) < _LEAST_TURN and np.ptp(turns.magnitude()) < _LEAST_TURN:
            return f"the tool turned by {math.degrees(np.ptp(turned)):.2f} deg in all"
        if np.sqrt(np.mean(off**2)) > _OFF_AXIS * np.sqrt(np.mean(turned**2)):
            return f"the tool did not turn about this joint's axis: {_CHECK_IT}"
        sds = np.linalg.norm(np.einsum("nji,j->ni", poses[:, :3, :3], axis) * deviations[:, 3:], axis=1)
    else:
        radius = float(np.median(np.linalg.norm(arms - np.outer(arms @ axis, axis), axis=1)))
        if radius < settings.least_radius:
            return f"the target moves on a circle of {1000 * radius:.1f} mm about this joint's axis"
        turned = np.array([turn_of_point(arms[middle], place, axis) for place in arms])
        sds = np.maximum(np.sqrt(np.mean(deviations[:, :3] ** 2, axis=1)), _LEAST_SEEN_M) / radius
    sds = np.hypot(sds, settings.rotation_sd)
    # Least squares through the angles, near the stated table where none is.
    knots, weight = servo.angles, 1e-3
    hats = piecewise(knots, np.eye(len(knots)))(commanded[middle] + turned).reshape(-1, len(knots))
    rows, right = np.vstack([hats, weight * np.eye(len(knots))]), np.concatenate([counts, weight * stated])
    first = np.linalg.lstsq(rows, right, rcond=None)[0]
    sweep = _Sweep(servo, lines, by, poses, sds, axis, arms, first, np.ones(len(lines), dtype=bool), radius)
    return sweep if sweep.is_table else _NO_TABLE


def _others(lines: Sequence[Entry], joint: str) -> dict[str, float]:
    """Where the other joints stood: the median, since each had the same pulse every time."""
    names = sorted({name for line in lines for name in line["told"]})
    return {n: float(np.median([line["told"][n] for line in lines if n in line["told"]])) for n in names if n != joint}


def _fitted(
    sweeps: Mapping[str, _Sweep],
    clocks: Mapping[str, PulseClock],
    rigid: RigidArm,
    experiment: Experiment,
    arm: Arm,
    settings: ServoCalibrationSettings,
) -> Outcome:
    """Sweeps of a tracker's rotations have a problem, and those of its positions; what somebody saw needs no model."""
    tracked = all(sweep.by != "somebody" for sweep in sweeps.values())
    zero: Zero = "kept" if settings.zero == "kept" and tracked else "measured"
    servos: dict[str, FittedServo] = {}
    silent: dict[str, str] = {}
    compliances: dict[str, tuple[float, float]] = {}
    spans: dict[str, float] = {}
    for by in ("rotation", "position"):
        if own := {joint: sweep for joint, sweep in sweeps.items() if sweep.by == by}:
            fit = _TableFit(own, rigid, experiment, arm, settings, zero, clocks)
            silent |= fit.run()
            servos |= {joint: fit.servo(joint) for joint in own if joint not in silent}
            compliances |= fit.compliances()
            spans |= fit.sag_spans()
    by_eye = {joint: sweep for joint, sweep in sweeps.items() if sweep.by == "somebody"}
    servos |= {joint: _by_eye(sweep, clocks[sweep.known.board].tick) for joint, sweep in by_eye.items()}
    known = {name: change for name, change in compliances.items() if change[1] < _DETERMINED * settings.sag_sd}
    fitted = settings.sag == "fitted"
    undetermined = tuple(name for name in compliances if name not in known and fitted)
    return Outcome(servos, clocks, silent, known if fitted else {}, undetermined, zero, spans)


def _by_eye(sweep: _Sweep, tick: float) -> FittedServo:
    """A table of straight lines through the pulses at which somebody saw angles (``tick`` in s)."""
    knots, targets = sweep.known.angles, np.array([line["target"] for line in sweep.lines])
    stated, hats = sweep.known.pulses_at(knots), piecewise(knots, np.eye(len(knots)))
    steep = piecewise(knots, stated).derivative()(targets)
    came = np.array([float(line["came"]) for line in sweep.lines]) * np.sign(stated[-1] - stated[0])
    has_lag = len(np.unique(came)) > 1
    columns = np.column_stack([hats(targets), *([steep * came] if has_lag else [])])
    weak = np.eye(len(knots), columns.shape[1]) / (WEAK_SD * np.abs(np.gradient(stated, knots)))[:, None]
    pulses, kept, scale = sweep.counts * tick, sweep.kept, 1.0
    for _ in range(3):
        weights = kept / (sweep.sds * np.abs(steep))
        rows = np.vstack([columns * weights[:, None], weak])
        right = np.concatenate([pulses * weights, weak[:, : len(knots)] @ stated])
        solution = np.linalg.lstsq(rows, right, rcond=None)[0]
        off = (pulses - columns @ solution) / steep
        kept = np.abs(off / sweep.sds) <= _FAR_OFF * max(1.0, 1.4826 * float(np.median(np.abs(off / sweep.sds))))
    sizes, freedom = (off / sweep.sds)[kept], int(kept.sum()) - columns.shape[1]
    scale = float(np.sqrt(sizes @ sizes / freedom)) if freedom > 0 else 1.0
    sds = np.sqrt(np.diag(np.linalg.pinv(rows.T @ rows, hermitian=True))) * max(1.0, scale)
    sweep.kept = kept
    lag = (float(solution[-1]), float(sds[-1])) if has_lag else (None, math.nan)
    return _fitted_servo(sweep, solution[: len(knots)], sds[: len(knots)], lag, off, scale, targets)


def _fitted_servo(
    sweep: _Sweep,
    pulses: Array,
    sds: Array,
    lag: tuple[float | None, float],
    off: Array,
    scale: float,
    angles: Array,
) -> FittedServo:
    """Pulses at the knots and their deviations (s), half the backlash with its own, what is left (rad), and angles."""
    known, kept = sweep.known, sweep.kept
    stated = known.pulses_at(known.angles)
    determined = sds < _DETERMINED * WEAK_SD * np.abs(np.gradient(pulses, known.angles))
    return FittedServo(
        known=known,
        angles=tuple(known.angles.tolist()),
        pulses=tuple(np.where(determined, pulses, stated).tolist()),
        pulse_sds=tuple(np.where(determined, sds, np.nan).tolist()),
        determined=tuple(determined.tolist()),
        lag=lag[0],
        lag_sd=lag[1],
        scatter=float(np.sqrt(np.mean(off[kept] ** 2))) if kept.any() else 0.0,
        scale=scale,
        used=int(kept.sum()),
        outliers=tuple((int(sweep.counts[i]), float(angles[i] + off[i])) for i in np.flatnonzero(~kept)),
        reach=(float(angles[kept].min()), float(angles[kept].max())) if kept.any() else (0.0, 0.0),
        by=sweep.by,
    )


class _TableFit:
    """Sweeps that the same of the body shows, fitted together."""

    def __init__(
        self,
        sweeps: dict[str, _Sweep],
        rigid: RigidArm,
        experiment: Experiment,
        arm: Arm,
        settings: ServoCalibrationSettings,
        zero: Zero,
        clocks: Mapping[str, PulseClock],
    ) -> None:
        self._ticks = {joint: clocks[sweep.known.board].tick for joint, sweep in sweeps.items()}
        self._sweeps, self._rigid, self._arm, self._settings = sweeps, rigid, arm, settings
        self._by = next(iter(sweeps.values())).by
        self._keeps_zero = zero == "kept"
        self._numbers = {joint: arm.joint_names.index(joint) + 1 for joint in sweeps}
        lags = [self._numbers[j] for j, s in sweeps.items() if len(np.unique(s.approaches)) > 1]
        self._lags = {joint for joint, number in self._numbers.items() if number in lags}
        knots = {self._numbers[joint]: sweep.known.angles.tolist() for joint, sweep in sweeps.items()}
        corrections = Corrections(knots, list(self._numbers.values()), lags)
        by: Literal["rotation", "position"] = "position" if self._by == "position" else "rotation"
        seat = quaternion_of(mean_rotation(self._seats())) if self._by == "rotation" else NO_TURN
        body = Body((arm.name,), by, seat, sweeps=len(sweeps))
        has_springs = settings.sag != "none"
        free = self._free(experiment, body, corrections, has_springs)
        self._fit = BodyFit(experiment, arm, corrections, body, free, self._seen(), springs=has_springs)
        for joint in sweeps:
            self._fit.move(self._zero(joint), self._zeroed(joint))
        names = [block.name for block in self._fit.parameters.blocks if block.unit == "rad_per_Nm" and block.size == 1]
        self._compliances = [name for name in free if name.startswith(f"{arm.name}.") and name in names]

    def _zeroed(self, joint: str) -> float:
        """How far a first table's angles are beyond those by which its zero is kept (rad); it is moved by that."""
        sweep = self._sweeps[joint]
        if not self._keeps_zero:
            return 0.0
        knots, rising = sweep.known.angles, slice(None, None, -1 if sweep.falls else 1)
        stated = float(sweep.known.pulses_at(np.zeros(1))[0]) / self._ticks[joint]
        beyond = float(piecewise(sweep.pulses[rising], knots[rising])(stated))
        sweep.pulses = np.asarray(piecewise(knots - beyond, sweep.pulses)(knots))
        return beyond

    def _free(
        self, experiment: Experiment, body: Body, corrections: Corrections, springs: bool
    ) -> dict[str, float | None]:
        arm, settings = self._arm, self._settings
        own = {block.name: block.name.rpartition(".")[2] for block in arm.parameters()}
        free: dict[str, float | None] = {}
        for block in corrections.parameters():
            sd = _ZERO_SD if block.name.startswith("zero") else None if block.name.startswith("lag") else WEAK_SD
            free[f"{arm.name}.{TABLES}.{block.name}"] = sd
        scope = f"{arm.name}.{arm.model_name}."
        nominal = {block.name: block for block in experiment.parameters.blocks if block.name in own}
        springy = {f"{arm.name}.{name}." for name in arm.effects} if springs else set()
        for name, block in nominal.items():
            if block.size == 1 and block.unit == "rad" and name.startswith(scope):
                free[name] = _ANGLE_SD
            elif block.unit == "m" and block.size == 1 and name.startswith(scope) and self._by == "position":
                free[name] = _LENGTH_SD_M
            elif block.unit == "rad_per_Nm" and block.size == 1 and any(name.startswith(s) for s in springy):
                free[name] = settings.sag_sd if settings.sag == "fitted" else _FIXED_SD
        frame = {"tilt": _FRAME_SD, "before": _PLAY_SD, "behind": _PLAY_SD}
        if self._by == "position":
            frame |= {"shift": _SHIFT_SD_M}
        for block in body.parameters():
            kind = block.name.rstrip("0123456789_xyz")
            if kind in frame:
                free[f"{BODY}.{block.name}"] = frame[kind]
            elif kind == "seat" and self._by == "position":
                free[f"{BODY}.{block.name}"] = _TARGET_SD_M
        if self._by == "rotation":
            free[f"{BODY}.seat_rotation"] = None
        return free

    def _seats(self) -> Array:
        return np.array(
            [
                self._rigid.tool({**line["told"], joint: angle})[:3, :3].T @ pose[:3, :3]
                for joint, sweep in self._sweeps.items()
                for line, angle, pose in zip(sweep.lines, sweep.angles, sweep.poses, strict=True)
            ]
        )

    def _seen(self) -> Dataset:
        joints = list(self._arm.commanded)
        rows: dict[str, list[Array]] = {joint: [] for joint in joints}
        sides: dict[str, list[Array]] = {joint: [] for joint in joints}
        for joint, sweep in self._sweeps.items():
            for other in joints:
                own = other == joint
                stood = np.array([float(line["told"].get(other, 0.0)) for line in sweep.lines])
                rows[other].append(sweep.angles if own else stood)
                sides[other].append(sweep.approaches if own else np.zeros(len(stood)))
        sweeps = list(self._sweeps.values())
        noise = np.concatenate([s.sds * s.radius for s in sweeps])
        numbers = np.repeat(np.arange(len(sweeps), dtype=float), [len(s.lines) for s in sweeps])
        angles, approaches = ({j: np.concatenate(parts) for j, parts in of.items()} for of in (rows, sides))
        poses = np.concatenate([s.poses for s in sweeps])
        return body_dataset(self._arm.name, angles, poses, (noise, noise), approaches, numbers)

    def _parts(self, rows: Array) -> dict[str, Array]:
        ends = np.cumsum([len(sweep.lines) for sweep in self._sweeps.values()])[:-1]
        return dict(zip(self._sweeps, np.split(rows, ends, axis=-1), strict=True))

    def run(self) -> dict[str, str]:
        """Until the tables are steady; why some joints have none."""
        silent: dict[str, str] = {}
        for _ in range(_ROUNDS):
            for _ in range(2):  # without what lies far off, and with what does so no longer
                try:
                    self._fit.fit(self._seen(), np.concatenate([s.kept for s in self._sweeps.values()]).astype(float))
                except NotConvergedError as fault:
                    return dict.fromkeys(self._sweeps, fault.message.rstrip("."))
                before = [sweep.kept for sweep in self._sweeps.values()]
                for sweep, off in zip(self._sweeps.values(), self._off().values(), strict=True):
                    limit = _FAR_OFF * max(1.0, 1.4826 * float(np.median(np.abs(off / sweep.sds))))
                    sweep.kept = np.abs(off / sweep.sds) <= limit
                if all(np.array_equal(a, s.kept) for a, s in zip(before, self._sweeps.values(), strict=True)):
                    break
            largest = 0.0
            for joint, sweep in self._sweeps.items():
                names = self._names(joint)
                at = np.array([self._fit.value(name) for name in names])
                at = at - self._pinned(joint) @ at
                largest = max(largest, float(np.abs(at).max()))
                if not sweep.corrected(at):
                    silent[joint] = _NO_TABLE
                else:
                    moved = self._fit.value(names[0]) - at[0]
                    self._fit.move(self._zero(joint), self._fit.value(self._zero(joint)) + moved)
                for name in names:
                    self._fit.move(name, 0.0)
            if largest < _STEADY:
                break
        return silent

    def _names(self, joint: str) -> list[str]:
        scope, number = f"{self._arm.name}.{TABLES}.", self._numbers[joint]
        return [f"{scope}at{number}_{k}" for k in range(len(self._sweeps[joint].known.angles))]

    def _zero(self, joint: str) -> str:
        return f"{self._arm.name}.{TABLES}.zero{self._numbers[joint]}"

    def _pinned(self, joint: str) -> Array:
        """What of the corrections at the knots is the joint's zero instead: that at zero, or their mean."""
        sweep = self._sweeps[joint]
        hats = piecewise(sweep.known.angles, np.eye(len(sweep.known.angles)))
        return np.asarray(hats(0.0) if self._keeps_zero else hats(sweep.angles).mean(axis=0))

    def _off(self) -> dict[str, Array]:
        parts = self._parts(self._fit.residuals())
        return {joint: sweep.along(parts[joint]) for joint, sweep in self._sweeps.items()}

    def servo(self, joint: str) -> FittedServo:
        sweep, names, off = self._sweeps[joint], self._names(joint), self._off()[joint]
        sizes = (off / sweep.sds)[sweep.kept]
        freedom = len(sizes) - len(names) - (joint in self._lags) - 1
        scale = float(np.sqrt(sizes @ sizes / freedom)) if freedom > 0 else 1.0
        slopes, shift = np.abs(np.gradient(sweep.pulses, sweep.known.angles)), self._absolute(joint)
        rows = np.eye(len(names)) - self._pinned(joint)
        sds = slopes * self._fit.deviations(names, rows) * max(1.0, scale)
        pulses = np.asarray(piecewise(sweep.known.angles + shift, sweep.pulses)(sweep.known.angles))
        lag: tuple[float | None, float] = (None, math.nan)
        if joint in self._lags:
            name = f"{self._arm.name}.{TABLES}.lag{self._numbers[joint]}"
            lag = self._fit.value(name), float(self._fit.deviations([name])[0]) * max(1.0, scale)
        angles = sweep.angles + shift - (lag[0] or 0.0) * sweep.approaches
        tick = self._ticks[joint]
        return _fitted_servo(sweep, pulses * tick, sds * tick, lag, off, scale, angles)

    def _absolute(self, joint: str) -> float:
        """What is to be added to the table's angles for them to be absolute, by the stated model and base."""
        if self._keeps_zero:
            return 0.0
        parameters, fitted = self._fit.parameters, (*self._compliances, *self._names(joint))
        lags = f"{self._arm.name}.{TABLES}.lag"
        stated = {b.name: b.nominal for b in parameters.free if b.name not in fitted and not b.name.startswith(lags)}
        stated |= {f"{BODY}.seat_rotation": NO_TURN} if self._by == "rotation" else {}
        sweep = self._sweeps[joint]
        return float(np.mean(sweep.along(self._parts(self._fit.residuals(stated))[joint])[sweep.kept]))

    def compliances(self) -> dict[str, tuple[float, float]]:
        if not self._compliances:
            return {}
        sds = (self._fit.deviations(self._compliances) * self._fit.noise_scale).tolist()
        return {n: (self._fit.value(n), sd) for n, sd in zip(self._compliances, sds, strict=True)}

    def sag_spans(self) -> dict[str, float]:
        """How much what the springs give varies over each sweep (rad)."""
        stiff = self._fit.residuals(dict.fromkeys(self._compliances, 0.0)) - self._fit.residuals()
        parts = self._parts(stiff)
        return {joint: float(np.ptp(sweep.along(parts[joint]))) for joint, sweep in self._sweeps.items()}
