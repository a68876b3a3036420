"""Tables, oscillators and springs from a record, round by round.

The model's axes put where the tool's turns show them, and the springs as far as those turns determine them.

What springs give is reckoned by the model, and a model whose axes point a few degrees elsewhere reckons it wrong. Turns
of the tool across the axis of the joint that moves have nothing to do with its servo; they determine the
axes, and the compliances. They are fitted by Gauss-Newton steps [Nocedal2006], every number near its nominal value.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Self

import numpy as np
from armcal.arm.servo import PulseTable
from armcal.base.arrays import Array
from scipy.linalg import block_diag
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

from armcal_bench.servo.nominal import (
    By,
    NominalArm,
    NoTurnError,
    Turning,
    mean_angle,
    turning_of_positions,
    turning_of_rotations,
)
from armcal_bench.servo.problem import (
    FitTask,
    FittedServo,
    KnownBoard,
    KnownServo,
    Observation,
    ServoFit,
    SpringRows,
    Zero,
    fit_servos,
    piecewise,
)
from armcal_bench.servo.record import ANGLE, POSE
from armcal_bench.servo.setup import ServoCalibrationSettings
from armcal_bench.servo.trial import permuted

_LEAST_SEEN_M = 1e-4
_FARTHEST_AXIS = math.radians(30.0)
_MOST_OFF_AXIS = math.radians(10.0)  # Springs, and axes that are not as drawn, give less
_CHECK_IT = "is another servo on its channel? Look with armcal servo --check"
Entry = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Sweeps:
    """A joint's lines that show angles, and these angles."""

    lines: tuple[Entry, ...]  # of the record
    angles: Array  # of the joint (rad), what springs give taken out as far as it is known
    sds: Array  # of these (rad)
    by: By | None = None  # what showed them; None: somebody's eyes
    turning: Turning | None = None  # how the tool turned, where a tracker saw it

    @property
    def joint(self) -> str:
        return str(self.lines[0]["joint"])

    @property
    def rotations(self) -> Array:
        """``base_R_body`` as the tracker saw it (N x 3 x 3)."""
        return np.array([line["rotation"] for line in self.lines])

    @property
    def counts(self) -> list[int]:
        return [int(line["counts"]) for line in self.lines]

    @property
    def approaches(self) -> list[int]:
        """From where the angle came: 1 from below."""
        counts = np.array(self.counts)
        falls = len(set(self.counts)) > 1 and np.polyfit(counts - counts.mean(), self.angles, 1)[0] < 0
        return [-int(line["came"]) if falls else int(line["came"]) for line in self.lines]


@dataclass(frozen=True, eq=False)
class Springs:
    """An arm with its springs, and where a joint stood in each line: what they give there can be taken out.

    Attributes:
        seat: ``tool_R_body``, how the tracked body sits on the model's tool (3x3).
    """

    about: NominalArm  # the arm, with the compliances as well as they are known
    angles: tuple[float, ...]  # of the joint (rad), line by line
    seat: Array = field(default_factory=lambda: np.eye(3))

    def given(self, lines: Sequence[Entry]) -> Array:
        """What springs give in each line (N x 4 x 4): a rotation in the body's axes, a translation in the base's."""
        given = self.about.give(self.poses(lines))
        given[:, :3, :3] = self.seat.T @ given[:, :3, :3] @ self.seat
        return given

    def poses(self, lines: Sequence[Entry]) -> list[dict[str, float]]:
        """All joints' angles (rad), line by line."""
        return [{**line["told"], line["joint"]: angle} for line, angle in zip(lines, self.angles, strict=True)]


def sweeps_of(
    entries: Sequence[Entry],
    joint: str,
    nominal: NominalArm,
    settings: ServoCalibrationSettings,
    springs: Springs | None = None,
) -> Sweeps | str:
    """A joint's angles, or why they are not known."""
    poses = [e for e in entries if e["kind"] == POSE and e["joint"] == joint]
    by_eye = list({(e["target"], e["came"]): e for e in entries if e["kind"] == ANGLE and e["joint"] == joint}.values())
    if not poses and not by_eye:
        return "nothing was measured"
    if not poses:
        return Sweeps(tuple(by_eye), np.array([e["angle"] for e in by_eye]), np.array([e["sd"] for e in by_eye]))
    given = np.tile(np.eye(4), (len(poses), 1, 1)) if springs is None else springs.given(poses)
    try:
        return _tracked(poses, joint, nominal, settings, given)
    except NoTurnError as fault:
        return str(fault)


def observations_of(sweeps: Sweeps, nominal: NominalArm, springs: Springs | None) -> list[Observation]:
    """As a fit takes them. Of what springs give, the change of compliances from ``nominal`` is left to the fit."""
    joint = sweeps.joint
    rows = list(zip(sweeps.counts, sweeps.approaches, sweeps.angles.tolist(), sweeps.sds.tolist(), strict=True))
    if springs is None or sweeps.by is None:
        return [Observation(joint, *row) for row in rows]
    about = springs.about
    changes = np.array([about.compliance(name) - nominal.compliance(name) for name in about.compliances])
    slopes = about.slopes(joint, springs.poses(sweeps.lines), sweeps.by)
    return [
        Observation(joint, *row, -float(slope @ changes), dict(zip(about.compliances, slope, strict=True)))
        for row, slope in zip(rows, slopes, strict=True)
    ]


def _tracked(
    poses: Sequence[Entry], joint: str, nominal: NominalArm, settings: ServoCalibrationSettings, given: Array
) -> Sweeps:
    """By the tool's rotations, or its positions where a rotation is missing; ``given`` by springs (N x 4 x 4).

    Raises:
        NoTurnError: the tool did not turn, or not about this joint's axis.
    """
    # Where the other joints stood: the median, since each had the same pulse every time.
    names = sorted({name for e in poses for name in e["told"]} - {joint})
    others = {name: float(np.median([e["told"][name] for e in poses if name in e["told"]])) for name in names}
    axis = nominal.axis(joint, {**others, joint: 0.0})[0]
    deviations = np.array([[d or 0.0 for d in e["deviations"]] for e in poses])
    by: By = "position" if any(e["rotation"] is None for e in poses) else "rotation"
    if by == "rotation":
        rotations = np.array([e["rotation"] for e in poses]) @ np.swapaxes(given[:, :3, :3], 1, 2)
        turning = turning_of_rotations(rotations, axis)
        off_axis = turning.off_axis
        absolute = [nominal.angle_of_rotation(joint, others, rotation) for rotation in rotations]
        sds = np.linalg.norm((turning.axis @ rotations) * deviations[:, 3:], axis=1)
    else:
        positions = np.array([e["position"] for e in poses]) - given[:, :3, 3]
        turning = turning_of_positions(positions, axis, settings.least_radius)
        radius = turning.radius or math.inf
        off_axis = turning.off_axis / radius
        absolute = [nominal.angle_of_position(joint, others, position) for position in positions]
        sds = np.maximum(np.sqrt(np.mean(deviations[:, :3] ** 2, axis=1)), _LEAST_SEEN_M) / radius
    apart = math.acos(min(abs(float(turning.axis @ axis)), 1.0))
    if apart > _FARTHEST_AXIS:
        raise NoTurnError(
            f"the tool turned about an axis that is {math.degrees(apart):.0f} deg from this joint's: {_CHECK_IT}"
        )
    if off_axis > _MOST_OFF_AXIS:
        raise NoTurnError(f"the tool did not turn about one axis (it is {math.degrees(off_axis):.0f} deg off it)")
    angles = turning.angles + mean_angle(np.array(absolute) - turning.angles)
    return Sweeps(tuple(poses), angles, np.hypot(sds, settings.rotation_sd), by, turning)


_ANGLE_SD = math.radians(4.0)
_ZERO_SD = math.radians(2.0)
_FRAME_SD = math.radians(4.0)
_MOST_SDS = 3.0
_PLAY_SD = math.radians(0.1)  # Of where a joint stands from one joint's sweep to another's


@dataclass(frozen=True, eq=False)
class Alignment:
    """Where the tracker's frames are against the model's, ``base_R_model`` and ``tool_R_body``; the model's numbers.

    Attributes:
        numbers: of the model's angles, then the joints' zeros, less their nominal values; then the tilt of ``base`` and
            what ``seat`` was turned by since it was first estimated (3 each, rad).
        base, seat: rotations (3x3).
    """

    numbers: Array
    compliances: Array  # of the springs, less their nominal values (rad/(N m))
    base: Array = field(default_factory=lambda: np.eye(3))
    seat: Array | None = None

    @classmethod
    def of(cls, nominal: NominalArm) -> Self:
        return cls(np.zeros(len(_sds(nominal))), np.zeros(len(nominal.compliances)))

    @property
    def tool_R_body(self) -> Array:  # noqa: N802
        return np.eye(3) if self.seat is None else self.seat


def shifted(nominal: NominalArm, alignment: Alignment) -> NominalArm:
    values, place = {}, 0
    for name in nominal.angles:
        stated = nominal.parameters[name].nominal
        values[name] = tuple(float(v + d) for v, d in zip(stated, alignment.numbers[place:], strict=False))
        place += len(stated)
    zeros = dict(zip(nominal.joints, alignment.numbers[place:].tolist(), strict=False))
    springs = zip(nominal.compliances, alignment.compliances.tolist(), strict=True)
    values |= {name: (nominal.compliance(name) + change,) for name, change in springs}
    return nominal.with_values(values, zeros)


def aligned(
    alignment: Alignment,
    nominal: NominalArm,
    sweeps: Mapping[str, Sweeps],
    springs: Mapping[str, Springs],
    compliance_sd: float,
) -> tuple[Alignment, SpringRows | None]:
    """One step better; and what the turns determine of the changes of compliances from ``nominal``.

    None where no rotations were seen. Without a ``compliance_sd`` (rad/(N m)) compliances stay.
    """
    tracked = {joint: sweep for joint, sweep in sweeps.items() if sweep.by == "rotation"}
    if not tracked:
        return alignment, None
    if alignment.seat is None:
        alignment = replace(alignment, seat=_mean_seat(alignment.base, tracked, springs))
    rows = [_rows(alignment, sweep, springs[joint]) for joint, sweep in tracked.items()]
    by_springs, by_others, by_plays, offs = (list(part) for part in zip(*rows, strict=True))
    sds = np.concatenate([_sds(nominal), np.full(len(rows) * len(nominal.joints), _PLAY_SD)])
    others = np.vstack([np.hstack([np.concatenate(by_others), block_diag(*by_plays)]), np.diag(1 / sds)])
    slopes = np.vstack([np.concatenate(by_springs), np.zeros((len(sds), len(alignment.compliances)))])
    count = len(alignment.numbers)
    sizes = np.concatenate([*offs, -alignment.numbers / sds[:count], np.zeros(len(sds) - count)])
    changes, step = _step(slopes, others, sizes, alignment, nominal, compliance_sd)
    residuals = sizes - slopes @ changes - others @ step
    freedom = max(len(sizes) - len(sds) - len(changes), 1)
    scale = max(1.0, float(np.linalg.norm(residuals)) / math.sqrt(freedom))
    better = Alignment(
        alignment.numbers + step[:count],
        alignment.compliances + changes,
        Rotation.from_rotvec(step[count - 6 : count - 3]).as_matrix() @ alignment.base,
        alignment.tool_R_body @ Rotation.from_rotvec(step[count - 3 : count]).as_matrix(),
    )
    # The rows with everything but the compliances taken out, as few as there are compliances.
    free = np.linalg.qr(others, mode="complete")[0][:, others.shape[1] :].T
    q, r = np.linalg.qr(free @ slopes)
    return better, SpringRows(r / scale, q.T @ (free @ (sizes + slopes @ alignment.compliances)) / scale)


def _step(
    slopes: Array, others: Array, sizes: Array, alignment: Alignment, nominal: NominalArm, compliance_sd: float
) -> tuple[Array, Array]:
    """The changes of the compliances, none of which falls below zero, and of everything else."""
    now = alignment.compliances
    if not compliance_sd:
        return np.zeros(len(now)), np.asarray(np.linalg.lstsq(others, sizes, rcond=None)[0])
    weak = np.hstack([np.eye(len(now)) / compliance_sd, np.zeros((len(now), others.shape[1]))])
    lowest = -now - np.array([nominal.compliance(name) for name in nominal.compliances])
    low = np.concatenate([np.minimum(lowest, 0.0), np.full(others.shape[1], -np.inf)])
    whole = np.vstack([np.hstack([slopes, others]), weak])
    # Springs much softer than that have no equilibrium, and are what a servo that has let go looks like.
    most = np.maximum(lowest + _MOST_SDS * compliance_sd, low[: len(now)] + 1e-9)
    high = np.concatenate([most, np.full(others.shape[1], np.inf)])
    solution = lsq_linear(whole, np.concatenate([sizes, -now / compliance_sd]), (low, high), tol=1e-12).x
    return solution[: len(now)], solution[len(now) :]


def _rows(alignment: Alignment, sweeps: Sweeps, springs: Springs) -> tuple[Array, Array, Array, Array]:
    """One joint's weighted turns across its axis, in the base's axes, two rows a line.

    Slopes by the compliances, by the numbers of an alignment, and by where the joints stand; and what is off.
    """
    tool, by_angles, by_joints, by_springs = springs.about.turns(springs.poses(sweeps.lines))
    seen = sweeps.rotations
    predicted = alignment.base @ tool @ alignment.tool_R_body
    off = Rotation.from_matrix(seen @ np.swapaxes(predicted, 1, 2)).as_rotvec()
    axes = by_joints[:, :, springs.about.joints.index(sweeps.joint)] @ alignment.base.T
    across = np.linalg.svd(axes[:, None])[2][:, 1:] / sweeps.sds[:, None, None]
    known = across @ alignment.base
    by_numbers = np.concatenate([known @ by_angles, known @ by_joints, across, across @ seen], axis=2)
    count = 2 * len(seen)
    by_compliances, by_plays = (known @ by_springs).reshape(count, -1), (known @ by_joints).reshape(count, -1)
    return by_compliances, by_numbers.reshape(count, -1), by_plays, (across @ off[:, :, None]).ravel()


def _mean_seat(base: Array, sweeps: Mapping[str, Sweeps], springs: Mapping[str, Springs]) -> Array:
    """How the tracked body sits on the model's tool, on the average (3x3)."""
    seats = []
    for joint, sweep in sweeps.items():
        tools = springs[joint].about.tools(springs[joint].poses(sweep.lines))
        seats.append(np.swapaxes(base @ tools[:, :3, :3], 1, 2) @ sweep.rotations)
    return np.asarray(Rotation.from_matrix(np.concatenate(seats)).mean().as_matrix())


def _sds(nominal: NominalArm) -> Array:
    """A priori, of ``Alignment.numbers``."""
    count = sum(nominal.parameters[name].size for name in nominal.angles)
    return np.concatenate([np.full(count, _ANGLE_SD), np.full(len(nominal.joints), _ZERO_SD), np.full(6, _FRAME_SD)])


_ROUNDS = 10
_STEADY_S = 2e-8
_MOST_SCATTER = math.radians(1.0)


@dataclass(frozen=True)
class Outcome:
    """A fit and where it came from.

    Attributes:
        compliances: of the arm's springs (rad/(N m)) by parameter, value and deviation, where they were fitted.
    """

    fit: ServoFit  # tables, lags, oscillators
    task: FitTask  # that was fitted
    sweeps: Mapping[str, Sweeps]  # by joint
    silent: Mapping[str, str]  # why a joint's table could not be found, by joint
    compliances: Mapping[str, tuple[float, float]]
    zero: Zero  # whether stated zeros were kept
    sag_span: Mapping[str, float]  # by joint, how much what the springs give varies over its sweep (rad)


def outcome_of(
    entries: Sequence[Entry],
    servos: Sequence[KnownServo],
    boards: Mapping[str, KnownBoard],
    nominal: NominalArm,
    settings: ServoCalibrationSettings,
) -> Outcome:
    """Fit all that a record holds of some servos.

    One whose angles scatter as no servo's do is left out: it has let go, and would spoil the estimate of the springs.
    """
    left_out = permuted(entries, [servo.joint for servo in servos], nominal)
    while True:
        fitted = _fitted(entries, [s for s in servos if s.joint not in left_out], boards, nominal, settings)
        worst = max(fitted.fit.servos.values(), key=lambda servo: servo.scatter, default=None)
        if worst is None or worst.scatter <= _MOST_SCATTER:
            return replace(fitted, silent={**fitted.silent, **left_out})
        left_out[worst.known.joint] = (
            f"the spread of its angles is {math.degrees(worst.scatter):.1f} deg, as if it slipped, or "
            "was too hot and let go"
        )


def _fitted(
    entries: Sequence[Entry],
    servos: Sequence[KnownServo],
    boards: Mapping[str, KnownBoard],
    nominal: NominalArm,
    settings: ServoCalibrationSettings,
) -> Outcome:
    sweeps, silent = _swept(entries, servos, nominal, settings, {})
    seen = tuple(servo for servo in servos if servo.joint in sweeps)
    zero: Zero = "kept" if settings.zero == "kept" and all(s.by is not None for s in sweeps.values()) else "measured"
    task = FitTask(seen, dict(boards), (), zero, settings.sag_sd)
    now = _Round(sweeps, task, fit_servos(task), Alignment.of(nominal), {})
    has_springs = settings.sag != "none" and bool(nominal.compliances)
    for _ in range(_ROUNDS if has_springs else 1):
        before = now
        now = _better(before, entries, nominal, settings, "bending" if has_springs else "stiff")
        scatter = max((servo.scatter for servo in now.fit.servos.values()), default=0.0)
        former = before.fit.servos
        is_steady = all(
            joint in former and np.allclose(former[joint].pulses, servo.pulses, rtol=0, atol=_STEADY_S)
            for joint, servo in now.fit.servos.items()
        )
        if is_steady or (before.springs and scatter > _MOST_SCATTER):
            break
    values = {name: (nominal.compliance(name) + change, sd) for name, (change, sd) in now.fit.compliances.items()}
    spans = dict.fromkeys(now.sweeps, 0.0)
    for joint, bent in now.springs.items():
        if by := now.sweeps[joint].by:
            spans[joint] = float(np.ptp(bent.about.sag(joint, bent.poses(now.sweeps[joint].lines), by)))
    return Outcome(now.fit, now.task, now.sweeps, silent, values, zero, spans)


@dataclass(frozen=True, eq=False)
class _Round:
    """What is known after a round."""

    sweeps: Mapping[str, Sweeps]
    task: FitTask
    fit: ServoFit
    alignment: Alignment
    springs: Mapping[str, Springs]


def _better(
    now: _Round,
    entries: Sequence[Entry],
    nominal: NominalArm,
    settings: ServoCalibrationSettings,
    arm: Literal["stiff", "bending"],
) -> _Round:
    """One round: where the joints stood, what the springs gave there, the angles without it, the fit to those."""
    task, alignment = now.task, now.alignment
    springs: dict[str, Springs] = {}
    rows = None
    if arm == "bending":
        about = shifted(nominal, alignment)
        stood = {s.joint: Springs(about, _stood(s, now)) for s in task.servos}
        sd = settings.sag_sd if settings.sag == "fitted" else 0.0
        alignment, rows = aligned(alignment, nominal, now.sweeps, stood, sd)
        about = shifted(nominal, alignment)
        springs = {joint: Springs(about, bent.angles, alignment.tool_R_body) for joint, bent in stood.items()}
    sweeps = {**now.sweeps, **_swept(entries, task.servos, nominal, settings, springs)[0]}
    observations = [
        observation
        for servo in task.servos
        for observation in observations_of(sweeps[servo.joint], nominal, springs.get(servo.joint))
    ]
    if settings.sag != "fitted":
        observations, rows = [replace(o, sag=0.0, sag_slopes={}) for o in observations], None
    task = replace(task, observations=tuple(observations), springs=rows)
    return _Round(sweeps, task, fit_servos(task), alignment, springs)


def _stood(servo: KnownServo, now: _Round) -> tuple[float, ...]:
    """Where the joint stood in each line (rad), by its fitted table, or the stated one."""
    sweeps, fitted = now.sweeps[servo.joint], now.fit.servos.get(servo.joint)
    table: FittedServo | PulseTable = fitted or servo.table
    clock = now.fit.clocks[servo.board] if fitted else now.task.boards[servo.board].clock
    lag = (fitted.lag or 0.0) if fitted else 0.0
    angles, pulses = np.array(table.angles), np.array(table.pulses)
    order = np.argsort(pulses)
    by_table = piecewise(pulses[order], angles[order])(np.array(sweeps.counts) * clock.tick)
    return tuple((by_table - lag * np.array(sweeps.approaches)).tolist())


def _swept(
    entries: Sequence[Entry],
    servos: Sequence[KnownServo],
    nominal: NominalArm,
    settings: ServoCalibrationSettings,
    springs: Mapping[str, Springs],
) -> tuple[dict[str, Sweeps], dict[str, str]]:
    swept = {s.joint: sweeps_of(entries, s.joint, nominal, settings, springs.get(s.joint)) for s in servos}
    sweeps = {joint: sweep for joint, sweep in swept.items() if isinstance(sweep, Sweeps)}
    return sweeps, {joint: why for joint, why in swept.items() if isinstance(why, str)}
