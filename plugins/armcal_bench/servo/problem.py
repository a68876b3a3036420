"""The least-squares problem of a servo fit: its unknowns, and the residuals of observations and priors.

Pulse tables, backlash and oscillators fitted to angles observed at pulses, with standard deviations.

A servo's angle is that of its table at the pulse, less the lag behind the direction it came from; the table is linear
between its knots. Weighted least squares; observations far off are set aside and named.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import casadi as ca
import numpy as np
from armcal.arm.servo import PulseClock, PulseTable, piecewise_linear
from armcal.base.arrays import Array
from scipy.interpolate import BSpline, make_interp_spline
from scipy.optimize import OptimizeResult, least_squares

Zero = Literal["kept", "measured"]
US = 1e-6
WEAK_PULSE_SD = 300.0 * US
"""How far a table's pulse may well be from the stated one: what no observation determines stays there."""
WEAK_ZERO_SD = 1.0
_KEPT_SD = 1e-3 * US
_LEAST_SLOPE = 50 * US


@dataclass(frozen=True)
class KnownServo:
    """A servo as its table states it."""

    joint: str  # that it turns
    board: str  # that drives it
    table: PulseTable  # as stated; pulses by the board's stated oscillator
    trusted_sd: float | None = None  # of the table's pulses (s), where the table is believed; None: it is to be fitted
    knots: tuple[float, ...] = ()  # angles (rad) that the table is to be given at; empty: those of the stated one

    def pulses_at(self, angles: Array) -> Array:
        """The stated table's pulses (s) at angles (rad)."""
        return np.asarray(piecewise(np.array(self.table.angles), np.array(self.table.pulses))(angles))


@dataclass(frozen=True)
class MeasuredPulse:
    """A pulse measured at a board's pin, with an oscilloscope for example: counts, length (s), its deviation (s)."""

    counts: int
    length: float
    sd: float


@dataclass(frozen=True)
class KnownBoard:
    """A board: its stated oscillator and prescale, and pulses measured at its pins."""

    clock: PulseClock
    measured: tuple[MeasuredPulse, ...] = ()


@dataclass(frozen=True)
class Observation:
    """An angle measured at a pulse.

    Attributes:
        sag_slopes: how much more it would be, by compliance (rad per rad/(N m)): each is a parameter of the arm.
    """

    joint: str  # whose
    counts: int  # of the pulse
    approach: int  # from where the joint came: 1 from below, -1 from above, 0 not known
    angle: float  # as measured (rad)
    sd: float  # of that (rad)
    sag: float = 0.0  # how much of it is what the arm's springs give, by its model (rad)
    sag_slopes: Mapping[str, float] = field(default_factory=dict)


def piecewise(at: Array, values: Array) -> BSpline:
    """Linear between points (``at`` rises), and beyond the ends as before them."""
    return make_interp_spline(at, values, k=1)


@dataclass(frozen=True, eq=False)
class SpringRows:
    """What else is known of changes of compliances, in their order: ``slopes @ changes = sizes``, of unit deviation."""

    slopes: Array
    sizes: Array


@dataclass(frozen=True)
class FitTask:
    """What is to be fitted to what.

    Attributes:
        servos, boards: as known before; boards by name.
    """

    servos: tuple[KnownServo, ...]
    boards: dict[str, KnownBoard]
    observations: tuple[Observation, ...]  # of any of the servos
    zero: Zero  # ``measured`` angles are absolute; ``kept``: each servo's pulse at zero stays the stated one
    compliance_sd: float = 0.2  # how far the arm's compliances may well be from the model's (rad/(N m))
    springs: SpringRows | None = None  # what else is known of them

    def of(self, joint: str) -> tuple[Observation, ...]:
        return tuple(observation for observation in self.observations if observation.joint == joint)

    def knots_of(self, servo: KnownServo) -> Array:
        return np.array((servo.trusted_sd is None and servo.knots) or servo.table.angles)


class Unknowns:
    """Where each unknown is in the vector; pulses are in units of 1 us there, the rest in rad and rad/(N m)."""

    def __init__(self, task: FitTask) -> None:
        self.task = task
        self.names: list[tuple[str, str]] = []
        for servo in task.servos:
            self.names += [(servo.joint, f"pulse{k}") for k in range(len(task.knots_of(servo)))]
            if task.zero == "kept":
                self.names.append((servo.joint, "zero"))
            if {-1, 1} <= {observation.approach for observation in task.of(servo.joint)}:
                self.names.append((servo.joint, "lag"))
        for name, board in task.boards.items():
            trusted = {servo.joint for servo in task.servos if servo.board == name and servo.trusted_sd is not None}
            if board.measured or any(observation.joint in trusted for observation in task.observations):
                self.names.append((name, "clock"))
        self.names += [(name, "compliance") for name in self.compliances]
        self.place = {name: i for i, name in enumerate(self.names)}

    @cached_property
    def compliances(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for observation in self.task.observations for name in observation.sag_slopes))

    def pulses(self, x: Any, servo: KnownServo) -> Any:
        first = self.place[servo.joint, "pulse0"]
        return x[first : first + len(self.task.knots_of(servo))] * US

    def one(self, x: Any, owner: str, name: str) -> Any:
        """A number of a vector (floats or symbols), or 0 if it is not looked for."""
        place = self.place.get((owner, name))
        return 0.0 if place is None else x[place]

    def clock(self, x: Array, board: str) -> PulseClock:
        stated = self.task.boards[board].clock
        return PulseClock(stated.oscillator_hz * float(1.0 + self.one(x, board, "clock")), stated.prescale)

    def start(self) -> Array:
        """As stated, the tables by a straight line of least squares through what was observed."""
        x = np.zeros(len(self.names))
        for servo in self.task.servos:
            knots = self.task.knots_of(servo)
            stated = servo.pulses_at(knots)
            observations = self.task.of(servo.joint)
            tick = self.task.boards[servo.board].clock.tick
            angles = np.array([o.angle - o.sag for o in observations])
            hats = piecewise(knots, np.eye(len(knots)))(angles)
            weight = 10.0 if servo.trusted_sd is not None else 1e-3
            rows = np.vstack([hats.reshape(-1, len(knots)), weight * np.eye(len(knots))])
            right = np.concatenate([[o.counts * tick for o in observations], weight * stated])
            first = self.place[servo.joint, "pulse0"]
            x[first : first + len(knots)] = np.linalg.lstsq(rows, right, rcond=None)[0] / US
        return x


class Residuals:
    """Weighted residuals of a vector of unknowns: the observations', in their order by servo, then the priors'.

    One expression gives values and exact derivatives.

    Args:
        unknowns: what is looked for.
        kept: which observations count.
        scales: of the deviations, by joint.
        about: the vector at which deviations of angles are made deviations of pulses, by the slopes of the tables.
    """

    def __init__(self, unknowns: Unknowns, kept: Sequence[bool], scales: Mapping[str, float], about: Array) -> None:
        self._unknowns = unknowns
        self._counts: dict[str, int] = {}
        task, x = unknowns.task, ca.SX.sym("x", len(unknowns.names))
        rows: list[Any] = []
        for servo in task.servos:
            used = zip(task.observations, kept, strict=True)
            observations = [o for o, keep in used if keep and o.joint == servo.joint]
            self._counts[servo.joint] = len(observations)
            if not observations:
                continue
            knots = task.knots_of(servo)
            here = np.asarray(ca.DM(self._angles(about, servo, observations))).ravel()
            steep = np.abs(piecewise(knots, unknowns.pulses(about, servo)).derivative()(here))
            sds = np.array([o.sd for o in observations]) * np.maximum(steep, _LEAST_SLOPE)
            by_counts = ca.DM([float(o.counts) for o in observations]) * self._tick(x, servo.board)
            by_table = self._table(x, servo, self._angles(x, servo, observations))
            rows.append((by_counts - by_table) / ca.DM(sds * scales.get(servo.joint, 1.0)))
        self._values = ca.Function("residuals", [x], [ca.densify(ca.vertcat(*rows, *self._priors(x)))])

    def __call__(self, x: Array) -> Array:
        return np.asarray(self._values(x).full()).ravel()

    def jacobian(self, x: Array) -> Array:
        return np.asarray(self._slopes(x, 0).full())

    def observed(self, x: Array) -> dict[str, Array]:
        parts = np.split(self(x), np.cumsum(list(self._counts.values())))[:-1]
        return dict(zip(self._counts, parts, strict=True))

    @cached_property
    def _slopes(self) -> ca.Function:
        return self._values.jacobian()

    def _angles(self, x: Any, servo: KnownServo, observations: Sequence[Observation]) -> Any:
        """Where the servo stood, by what was measured (rad)."""
        one = self._unknowns.one
        angles = ca.DM([o.angle - o.sag for o in observations]) - one(x, servo.joint, "zero")
        angles = angles + one(x, servo.joint, "lag") * ca.DM([float(o.approach) for o in observations])
        for name in self._unknowns.compliances:
            angles = angles - ca.DM([o.sag_slopes.get(name, 0.0) for o in observations]) * one(x, name, "compliance")
        return angles

    def _table(self, x: Any, servo: KnownServo, angles: Any) -> Any:
        """Pulses (s) at angles (rad)."""
        pulses = ca.vertsplit(self._unknowns.pulses(x, servo))
        return piecewise_linear(angles, self._unknowns.task.knots_of(servo).tolist(), pulses)

    def _tick(self, x: Any, board: str) -> Any:
        return self._unknowns.task.boards[board].clock.tick / (1.0 + self._unknowns.one(x, board, "clock"))

    def _priors(self, x: Any) -> Iterator[Any]:
        task, one = self._unknowns.task, self._unknowns.one
        for servo in task.servos:
            stated = servo.pulses_at(task.knots_of(servo))
            yield (self._unknowns.pulses(x, servo) - ca.DM(stated)) / (servo.trusted_sd or WEAK_PULSE_SD)
            if task.zero == "kept":
                yield one(x, servo.joint, "zero") / WEAK_ZERO_SD
                if servo.trusted_sd is None:
                    # In counts: by another oscillator the same pulse is stated longer or shorter.
                    longer = self._tick(x, servo.board) / task.boards[servo.board].clock.tick
                    at_zero = float(servo.pulses_at(np.zeros(1))[0]) * longer
                    yield (self._table(x, servo, 0.0) - at_zero) / _KEPT_SD
        for name, board in task.boards.items():
            for measured_pulse in board.measured:
                yield (measured_pulse.counts * self._tick(x, name) - measured_pulse.length) / measured_pulse.sd
        changes = ca.vertcat(ca.SX(0, 1), *[one(x, name, "compliance") for name in self._unknowns.compliances])
        yield changes / task.compliance_sd
        if task.springs is not None:
            yield ca.mtimes(ca.DM(task.springs.slopes), changes) - ca.DM(task.springs.sizes)


_FAR_OFF = 5.0
_LOSSES: tuple[Literal["linear", "soft_l1"], ...] = ("soft_l1", "linear", "linear")
"""Of a round each, after which outliers are judged anew."""
_DETERMINED = 0.2  # A deviation below this part of the weak prior's: the observations determine the number


@dataclass(frozen=True)
class FittedServo:
    """A servo's table and backlash.

    Attributes:
        pulses, pulse_sds: at the knots (s); of a knot that no observation determines the stated pulse, and NaN.
        lag, lag_sd: half the backlash (rad); None where it was not approached from both sides.
    """

    known: KnownServo  # as it was stated
    angles: tuple[float, ...]  # knots (rad)
    pulses: tuple[float, ...]
    pulse_sds: tuple[float, ...]
    determined: tuple[bool, ...]  # whether the observations determine the pulse of a knot
    lag: float | None
    lag_sd: float
    zero: float  # what was added to the measured angles so that the stated zero is kept (rad)
    scatter: float  # of the observations about the fit (rad, root mean square)
    scale: float  # the same in units of the stated deviations; deviations are enlarged by it where it is above 1
    used: int  # how many observations
    outliers: tuple[Observation, ...]  # those set aside
    reach: tuple[float, float]  # the lowest and highest angle observed (rad)


@dataclass(frozen=True)
class ServoFit:
    """Servos, boards and springs.

    Attributes:
        compliances: of the arm's springs, by parameter, where determined: how far from the model's, and the standard
            deviation (rad/(N m)).
    """

    servos: Mapping[str, FittedServo]  # by joint, those with observations
    clocks: Mapping[str, PulseClock]  # by board, at the fitted oscillator, or the stated one
    oscillator_sds: Mapping[str, float]  # by board (Hz), of those that are determined
    compliances: Mapping[str, tuple[float, float]]
    undetermined: tuple[str, ...] = ()  # compliances that the observations do not determine


def fit_servos(task: FitTask) -> ServoFit:
    """Fit everything at once."""
    # In one order, so that the order in which observations came changes no bit.
    in_order = sorted(task.observations, key=lambda o: (o.joint, o.counts, o.approach, o.angle, o.sd, o.sag))
    task = replace(task, observations=tuple(in_order))
    unknowns = Unknowns(task)
    everything = [True] * len(task.observations)
    x, kept = unknowns.start(), everything
    for loss in _LOSSES:
        x = _solved(Residuals(unknowns, kept, {}, x), x, loss, 1e-9).x
        off = Residuals(unknowns, everything, {}, x).observed(x)
        medians = {joint: float(np.median(np.abs(o))) for joint, o in off.items() if len(o)}
        limits = {joint: _FAR_OFF * max(1.0, 1.4826 * median) for joint, median in medians.items()}
        following = {joint: iter(o) for joint, o in off.items()}
        kept = [bool(abs(next(following[o.joint])) <= limits[o.joint]) for o in task.observations]
    scales = {}
    for joint, off_servo in Residuals(unknowns, kept, {}, x).observed(x).items():
        free = len(off_servo) - sum(owner == joint for owner, _ in unknowns.names)
        scales[joint] = float(np.sqrt(off_servo @ off_servo / free)) if free > 0 else 1.0
    enlarged = {joint: max(1.0, scale) for joint, scale in scales.items()}
    solution = _solved(Residuals(unknowns, kept, enlarged, x), x, "linear", 1e-13)
    x, slopes, at = solution.x, np.asarray(solution.jac), unknowns.place
    sds = np.sqrt(np.diag(np.linalg.pinv(slopes.T @ slopes, hermitian=True)))
    off = Residuals(unknowns, kept, {}, x).observed(x)
    servos = {s.joint: _fitted_servo(unknowns, s, x, sds, kept, scales, off) for s in task.servos if task.of(s.joint)}
    stated = {name: board.clock.oscillator_hz for name, board in task.boards.items()}
    oscillators = {name: float(sds[at[name, "clock"]]) * hz for name, hz in stated.items() if (name, "clock") in at}
    springs = {name: at[name, "compliance"] for name in unknowns.compliances}
    changes = {name: (float(x[i]), float(sds[i])) for name, i in springs.items()}
    determined = {name: change for name, change in changes.items() if change[1] < _DETERMINED * task.compliance_sd}
    clocks = {name: unknowns.clock(x, name) for name in task.boards}
    return ServoFit(servos, clocks, oscillators, determined, tuple(name for name in changes if name not in determined))


def _solved(residuals: Residuals, x: Array, loss: Literal["linear", "soft_l1"], tolerance: float) -> OptimizeResult:
    return least_squares(
        residuals, x, jac=residuals.jacobian, x_scale="jac", loss=loss, xtol=tolerance, ftol=tolerance, gtol=tolerance
    )


def _fitted_servo(
    unknowns: Unknowns,
    servo: KnownServo,
    x: Array,
    sds: Array,
    kept: Sequence[bool],
    scales: Mapping[str, float],
    observed: Mapping[str, Array],
) -> FittedServo:
    task, at, joint = unknowns.task, unknowns.place, servo.joint
    knots = task.knots_of(servo)
    first = at[joint, "pulse0"]
    pulse_sds = sds[first : first + len(knots)] * 1e-6
    determined = pulse_sds < _DETERMINED * WEAK_PULSE_SD
    pulses = np.where(determined, unknowns.pulses(x, servo), servo.pulses_at(knots))
    mine = [o for o, keep in zip(task.observations, kept, strict=True) if keep and o.joint == joint]
    outliers = [o for o, keep in zip(task.observations, kept, strict=True) if not keep and o.joint == joint]
    off = observed[joint] * np.array([o.sd for o in mine])
    zero = unknowns.one(x, joint, "zero")
    angles = [o.angle - o.sag - zero for o in mine] or [0.0]
    has_lag = (joint, "lag") in at
    return FittedServo(
        known=servo,
        angles=tuple(float(a) for a in knots),
        pulses=tuple(float(p) for p in pulses),
        pulse_sds=tuple(float(sd) if known else float("nan") for sd, known in zip(pulse_sds, determined, strict=True)),
        determined=tuple(determined.tolist()),
        lag=unknowns.one(x, joint, "lag") if has_lag else None,
        lag_sd=float(sds[at[joint, "lag"]]) if has_lag else float("nan"),
        zero=zero,
        scatter=float(np.sqrt(np.mean(off**2))) if len(off) else 0.0,
        scale=scales.get(joint, 1.0),
        used=len(mine),
        outliers=tuple(outliers),
        reach=(min(angles), max(angles)),
    )
