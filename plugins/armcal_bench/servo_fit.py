"""Pulse tables, backlash and springs from what a tracker, or somebody, saw of each joint's sweep, and their files.

All sweeps are one problem of the arm's model: each joint stands where its table puts the pulse, with corrections at the
table's knots, less half the backlash behind where it came from. The model's axes and springs move with them, every
number near its nominal value: what springs give is computed by the model, and a model whose axes point a few degrees
elsewhere computes it wrong. The corrections move the tables until nothing remains to correct.
"""

import errno
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from armcal.arm.assembly import Arm
from armcal.arm.servo import PulseTable
from armcal.base.arrays import Array, Mask
from armcal.base.config_text import finite
from armcal.base.dataset import Dataset
from armcal.base.poses import NO_TURN
from armcal.base.quaternions import quaternion_of
from armcal.config.servo_file import ServoFile, load_servo_file, servo_file_text
from armcal.errors import NotConvergedError
from armcal.io.plain_files import write_whole, writing
from armcal.measure.rests import mean_rotation
from armcal.run.experiment import Experiment
from scipy.spatial.transform import Rotation

from armcal_bench.joint_check import permuted
from armcal_bench.servo_setup import ANGLE, POSE, KnownServo, ServoCalibrationSettings, next_name, piecewise
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
    silent: Mapping[str, str]  # why a joint's table could not be found, by joint
    compliances: Mapping[str, tuple[float, float]]  # of springs (rad/(N m)), value and deviation, by parameter
    undetermined: tuple[str, ...]  # compliances that the observations do not determine
    keeps_zero: bool  # whether stated zeros were kept
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
        swept = {servo.joint: _sweep_of(entries, servo, rigid, settings) for servo in remaining}
        silent = {joint: sweep for joint, sweep in swept.items() if isinstance(sweep, str)}
        sweeps = {joint: sweep for joint, sweep in swept.items() if isinstance(sweep, _Sweep)}
        by_eye = {joint: sweep for joint, sweep in sweeps.items() if sweep.by == "somebody"}
        keeps_zero = settings.zero == "kept" and not by_eye
        fitted: dict[str, FittedServo] = {}
        unfit: dict[str, str] = {}
        compliances: dict[str, tuple[float, float]] = {}
        spans: dict[str, float] = {}
        for by in ("rotation", "position"):
            if own := {joint: sweep for joint, sweep in sweeps.items() if sweep.by == by}:
                fit = _TableFit(own, rigid, experiment, settings, keeps_zero)
                unfit |= fit.run()
                fitted |= {joint: fit.servo(joint) for joint in own if joint not in unfit}
                compliances |= fit.compliances()
                spans |= fit.sag_spans()
        fitted |= {joint: _by_eye(sweep) for joint, sweep in by_eye.items()}
        worst = max(fitted.values(), key=lambda servo: servo.scatter, default=None)
        if worst is None or worst.scatter <= _MOST_SCATTER:
            break
        left_out[worst.known.joint] = (
            f"the spread of its angles is {math.degrees(worst.scatter):.1f} deg, as if it slipped, or "
            "was too hot and let go"
        )
    if settings.sag != "fitted":
        compliances = {}
    known = {name: change for name, change in compliances.items() if change[1] < _DETERMINED * settings.sag_sd}
    undetermined = tuple(name for name in compliances if name not in known)
    return Outcome(fitted, {**unfit, **silent, **left_out}, known, undetermined, keeps_zero, spans)


def _sweep_of(
    entries: Sequence[Entry], servo: KnownServo, rigid: RigidArm, settings: ServoCalibrationSettings
) -> _Sweep | str:
    joint, tick = servo.joint, servo.clock.tick
    lines = [e for e in entries if e["kind"] == POSE and e["joint"] == joint]
    seen = list({(e["target"], e["came"]): e for e in entries if e["kind"] == ANGLE and e["joint"] == joint}.values())
    stated = servo.pulses_at(servo.angles) / tick
    if not lines and not seen:
        return "nothing was measured"
    if not lines:
        poses, everything = np.tile(np.eye(4), (len(seen), 1, 1)), np.ones(len(seen), dtype=bool)
        sds, nowhere = np.array([line["sd"] for line in seen]), np.zeros((len(seen), 3))
        return _Sweep(servo, seen, "somebody", poses, sds, np.zeros(3), nowhere, stated, everything)
    # Where the joints stood: of the others the median, since each had the same pulse every time.
    names = sorted({name for line in lines for name in line["told"]})
    stood = {n: float(np.median([line["told"][n] for line in lines if n in line["told"]])) for n in names}
    axis, origin = rigid.axes({**stood, joint: 0.0})[joint]
    poses = np.tile(np.eye(4), (len(lines), 1, 1))
    poses[:, :3, 3] = [line["position"] for line in lines]
    by = "position" if any(line["rotation"] is None for line in lines) else "rotation"
    poses[:, :3, :3] = [np.full((3, 3), np.nan) if line["rotation"] is None else line["rotation"] for line in lines]
    deviations = np.array([[d or 0.0 for d in line["deviations"]] for line in lines])
    arms, radius = poses[:, :3, 3] - origin, 1.0
    counts = np.array([line["counts"] for line in lines])
    commanded = np.array([float(servo.table.angle(count * tick)) for count in counts])
    middle = int(np.argmin(np.abs(commanded)))
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


def _by_eye(sweep: _Sweep) -> FittedServo:
    """A table of straight lines through the pulses at which somebody saw angles."""
    knots, targets = sweep.known.angles, np.array([line["target"] for line in sweep.lines])
    stated, hats = sweep.known.pulses_at(knots), piecewise(knots, np.eye(len(knots)))
    steep = piecewise(knots, stated).derivative()(targets)
    came = np.array([float(line["came"]) for line in sweep.lines]) * np.sign(stated[-1] - stated[0])
    has_lag = len(np.unique(came)) > 1
    columns = np.column_stack([hats(targets), *([steep * came] if has_lag else [])])
    weak = np.eye(len(knots), columns.shape[1]) / (WEAK_SD * np.abs(np.gradient(stated, knots)))[:, None]
    pulses, kept = sweep.counts * sweep.known.clock.tick, sweep.kept
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
    def __init__(
        self,
        sweeps: dict[str, _Sweep],
        rigid: RigidArm,
        experiment: Experiment,
        settings: ServoCalibrationSettings,
        keeps_zero: bool,
    ) -> None:
        self._sweeps, self._settings, self._keeps_zero = sweeps, settings, keeps_zero
        self._arm = arm = rigid.arm
        self._by = next(iter(sweeps.values())).by
        self._numbers = {joint: arm.joint_names.index(joint) + 1 for joint in sweeps}
        lags = [self._numbers[j] for j, s in sweeps.items() if len(np.unique(s.approaches)) > 1]
        self._lags = {joint for joint, number in self._numbers.items() if number in lags}
        knots = {self._numbers[joint]: sweep.known.angles.tolist() for joint, sweep in sweeps.items()}
        corrections = Corrections(knots, list(self._numbers.values()), lags)
        by: Literal["rotation", "position"] = "position" if self._by == "position" else "rotation"
        seat: tuple[float, ...] = NO_TURN
        if self._by == "rotation":  # on the nominal tool, the mean of all lines
            seats = [
                rigid.tool({**line["told"], joint: angle})[:3, :3].T @ pose[:3, :3]
                for joint, sweep in sweeps.items()
                for line, angle, pose in zip(sweep.lines, sweep.angles, sweep.poses, strict=True)
            ]
            seat = quaternion_of(mean_rotation(np.array(seats)))
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
        stated = float(sweep.known.pulses_at(np.zeros(1))[0]) / sweep.known.clock.tick
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
        tick = sweep.known.clock.tick
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


_FAR_CHANGE = 0.1
_SAG_WORTH = math.radians(0.1)


def is_usable(servo: FittedServo) -> bool:
    try:
        PulseTable(servo.angles, servo.pulses)
    except ValueError:
        return False
    return True


def findings(outcome: Outcome) -> list[str]:
    texts = [f"{joint}: the table is left as it was: {why}." for joint, why in outcome.silent.items()]
    texts += [text for servo in outcome.servos.values() for text in _of_servo(servo)]
    if outcome.keeps_zero:
        texts.append("zeros: each servo's pulse at 0 deg was kept; the angles were measured from one another.")
    if all(servo.by == "somebody" for servo in outcome.servos.values()):
        return texts
    worst = max(outcome.sag_span, key=lambda joint: outcome.sag_span[joint], default="")
    if not worst or not outcome.sag_span[worst]:
        texts.append(
            "springs: the model has no deflection of the arm under its weight; the tables contain it. Give the springs "
            "their compliances, or bench.servo.sag: fitted."
        )
    elif outcome.sag_span[worst] >= _SAG_WORTH:
        how = "found with the tables" if outcome.compliances or outcome.undetermined else "the model's"
        texts.append(
            f"springs: over a sweep they turn the tool by up to {math.degrees(outcome.sag_span[worst]):.1f} deg "
            f"({worst}); that is taken out by compliances that are {how}."
        )
    return texts


def _of_servo(servo: FittedServo) -> Iterator[str]:
    joint = servo.known.joint
    if not is_usable(servo):
        yield (
            f"{joint}: the pulses found neither rise nor fall with the angle: the table is left as it was. "
            "Look at its linkage."
        )
        return
    before, after = (np.sign(pulses[-1] - pulses[0]) for pulses in (servo.known.table.pulses, servo.pulses))
    if before != after:
        yield (
            f"{joint}: the servo turns the other way than its table said, or the tracker's frame is left-handed: "
            "look which way it turns."
        )
    for angle, is_determined in zip(servo.angles, servo.determined, strict=True):
        beyond = max(servo.reach[0] - angle, angle - servo.reach[1])
        if not is_determined:
            yield f"{joint}: no measurement determines the pulse at {math.degrees(angle):g} deg; it is the stated one."
        elif beyond > math.radians(15):
            yield (
                f"{joint}: the pulse at {math.degrees(angle):g} deg is extrapolated linearly from "
                "the measured range, "
                f"{math.degrees(servo.reach[0]):.0f} to {math.degrees(servo.reach[1]):.0f} deg."
            )
    stated = servo.known.pulses_at(np.array(servo.angles))
    change = float(np.max(np.abs(np.diff(servo.pulses) / np.diff(stated) - 1.0)))
    if before == after and change > _FAR_CHANGE:
        yield (
            f"{joint}: its pulses a degree differ from the stated ones by {100 * change:.0f} %: is it the "
            "servo that was meant, and does the tracker follow this arm's tool?"
        )
    if servo.lag is None:
        yield f"{joint}: it was approached from one side only, so its backlash is not known."
    elif servo.lag < -3 * servo.lag_sd and servo.lag < -math.radians(0.05):
        over = -math.degrees(servo.lag)
        yield f"{joint}: it overshoots by {over:.2f} deg rather than lags: does it stand before it is measured?"
    if servo.scale > 3:
        yield (
            f"{joint}: the spread of the angles is {math.degrees(servo.scatter):.2f} deg, {servo.scale:.0f} times the "
            "stated one; the deviations are enlarged by that."
        )
    for counts, angle in servo.outliers:
        yield f"{joint}: the angle at {counts} counts ({math.degrees(angle):.1f} deg) lies far off and was set aside."


RESULTS = "servo.json"
_APART = math.radians(0.5)  # Knots that are nearer to the end of a shortened table add nothing


def improved(file: ServoFile, outcome: Outcome, adapter: str = "") -> ServoFile:
    """The servo file with the fitted tables, within pulse ranges; boards without an adapter get that of the record."""
    stated = {"id": adapter}
    boards = {name: board if board.id else board.model_copy(update=stated) for name, board in file.boards.items()}
    servos = dict(file.servos)
    for joint, servo in file.servos.items():
        if joint in outcome.servos and (table := _table(outcome, joint, file)) is not None:
            servos[joint] = servo.model_copy(update={"angles": table.angles, "pulses": table.pulses})
    return ServoFile(boards, servos)


def _table(outcome: Outcome, joint: str, file: ServoFile) -> PulseTable | None:
    """The part of a fitted table whose pulses (s) servo and board allow; None where nothing is left."""
    fitted, servo = outcome.servos[joint], file.servos[joint]
    if not is_usable(fitted):
        return None
    # Counts stay what they are: the file's board may have another oscillator than that of the record.
    same = fitted.known.clock.oscillator_hz / file.boards[servo.board].oscillator_hz
    table = PulseTable(fitted.angles, tuple(round(pulse * same, 9) for pulse in fitted.pulses))
    allowed, longest = servo.pulse_range, file.boards[servo.board].clock.longest_pulse
    low, high = max(allowed[0], min(table.pulses)), min(allowed[1], longest, max(table.pulses))
    if (low, high) == (min(table.pulses), max(table.pulses)):
        return table
    if not low < high:
        return None
    ends = sorted((float(table.angle(pulse)), pulse) for pulse in (low, high))
    pairs = list(zip(table.angles, table.pulses, strict=True))
    inner = [(a, p) for a, p in pairs if low < p < high and ends[0][0] + _APART < a < ends[1][0] - _APART]
    return PulseTable(*map(tuple, zip(ends[0], *inner, ends[1], strict=True)))


def write_servo_file(path: Path, file: ServoFile) -> Path | None:
    """Put a servo file in place whole, and keep the one before, whose place is given; None if nothing changed.

    Of a part that stands on one line, as armcal writes it, only that line changes, up to its comment. Where a part
    stands otherwise, the whole file is written anew.
    """
    path = path.resolve()  # of a link, what it leads to
    with writing(path, "Make it writable and give the command again: nothing measured is lost."):
        before = path.read_bytes()
        if not path.stat().st_mode & 0o222:
            raise PermissionError(errno.EACCES, "it is read-only")
        stated = load_servo_file(path)
        if stated == file:
            return None
        kept = next_name(path)
        write_whole(kept, before)
        write_whole(path, _text_of(before.decode(), stated, file).encode())
    return kept


def _text_of(text: str, stated: ServoFile, file: ServoFile) -> str:
    was, now = servo_file_text(stated).splitlines(), servo_file_text(file).splitlines()
    for before, after in zip(was, now, strict=True):
        if before != after:
            name = re.escape(after.partition(": {")[0])
            places = list(re.finditer(rf"(?m)^{name}: \{{[^{{}}&*\n]*\}}(?=[ \t]*(#.*)?$)", text))
            if len(places) != 1:
                return servo_file_text(file)
            text = f"{text[: places[0].start()]}{after}{text[places[0].end() :]}"
    return text


def results(outcome: Outcome, changed: ServoFile) -> dict[str, Any]:
    written = {joint: _table(outcome, joint, changed) is not None for joint in outcome.servos}
    texts = findings(outcome)
    for joint, fitted in outcome.servos.items():
        servo, stated = changed.servos[joint], fitted.known.table.angles
        meant = min(stated[0], fitted.angles[0]), max(stated[-1], fitted.angles[-1])
        if not written[joint]:
            if is_usable(fitted):
                texts.append(
                    f"{joint}: the table is left as it was: no pulse that was found is in the servo's pulse_range."
                )
        elif servo.angles[0] > meant[0] + _APART or servo.angles[-1] < meant[1] - _APART:
            low, high = (1e6 * pulse for pulse in servo.pulse_range)
            shortened = (fitted.angles[0], fitted.angles[-1]) != (servo.angles[0], servo.angles[-1])
            why = f"the servo's pulse_range is {low:g} to {high:g} us" if shortened else "bench.servo.knots ends there"
            texts.append(
                f"{joint}: its table reaches from {math.degrees(servo.angles[0]):.1f} to "
                f"{math.degrees(servo.angles[-1]):.1f} deg, not from {math.degrees(meant[0]):.1f} to "
                f"{math.degrees(meant[1]):.1f} deg: {why}."
            )
    return {
        "servos": {joint: {**_servo(servo), "written": written[joint]} for joint, servo in outcome.servos.items()},
        "compliances_rad_per_Nm": {name: {"value": v, "sd": sd} for name, (v, sd) in outcome.compliances.items()},
        "not_told": {"servos": dict(outcome.silent), "compliances": list(outcome.undetermined)},
        "findings": texts,
    }


def write_results(folder: Path, summary: Mapping[str, Any]) -> None:
    with writing(folder, "Give another --out."):
        write_whole(folder / RESULTS, (json.dumps(summary, indent=2, allow_nan=False) + "\n").encode())


def _servo(servo: FittedServo) -> dict[str, Any]:
    stated = servo.known.pulses_at(np.array(servo.angles))
    slopes = np.gradient(np.array(servo.pulses), np.array(servo.angles))  # by a knot's neighbours (s/rad)
    slopes[np.abs(slopes) <= 1e-9] = math.nan
    columns = (servo.angles, servo.pulses, servo.pulse_sds, servo.determined, stated.tolist(), slopes.tolist())
    return {
        "board": servo.known.board,
        "knots": [
            {
                "angle_deg": math.degrees(angle),
                "pulse_us": 1e6 * pulse,
                "sd_us": finite(1e6 * sd),
                "told": is_determined,
                "before_us": 1e6 * before,
                "change_us": 1e6 * (pulse - before),
                "change_deg": math.degrees((before - pulse) / slope),
            }
            for angle, pulse, sd, is_determined, before, slope in zip(*columns, strict=True)
        ],
        "backlash_deg": None if servo.lag is None else 2 * math.degrees(servo.lag),
        "backlash_sd_deg": finite(2 * math.degrees(servo.lag_sd)),
        "scatter_deg": math.degrees(servo.scatter),
        "observations": servo.used,
        "set_aside": len(servo.outliers),
        "seen_by": servo.by,
    }
