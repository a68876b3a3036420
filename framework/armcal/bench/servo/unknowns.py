"""The numbers that a servo fit looks for, and how far observations are from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from armcal.arm.servo import PulseClock
from armcal.base.domains import Array
from armcal.bench.servo.known import KnownBoard, KnownServo, Observation, Zero, interpolated, slopes_at

US = 1e-6
WEAK_PULSE_SD = 300.0 * US
"""How far a table's pulse may well be from the stated one: what no observation tells stays there."""
WEAK_ZERO_SD = 1.0
_KEPT_SD = 1e-3 * US


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
        knots: angles of the tables to be found (rad, rising).
        observations: of any of the servos.
        zero: ``measured`` angles are absolute; ``kept``: each servo's pulse at zero stays the stated one.
        compliance_sd: how far the arm's compliances may well be from the model's (rad/(N m)).
        springs: what else is known of them.
    """

    servos: tuple[KnownServo, ...]
    boards: dict[str, KnownBoard]
    knots: tuple[float, ...]
    observations: tuple[Observation, ...]
    zero: Zero
    compliance_sd: float = 0.2
    springs: SpringRows | None = None

    def of(self, joint: str) -> tuple[Observation, ...]:
        """A joint's observations."""
        return tuple(each for each in self.observations if each.joint == joint)

    def knots_of(self, servo: KnownServo) -> Array:
        """A trusted table keeps its own."""
        return np.array(servo.table.angles if servo.trusted_sd is not None else self.knots)


class Unknowns:
    """Where each unknown is in the vector; pulses are in units of 1 us there, the rest in rad and rad/(N m)."""

    def __init__(self, task: FitTask) -> None:
        self.task = task
        self.names: list[tuple[str, str]] = []
        for servo in task.servos:
            self.names += [(servo.joint, f"pulse{k}") for k in range(len(task.knots_of(servo)))]
            if task.zero == "kept":
                self.names.append((servo.joint, "zero"))
            if {-1, 1} <= {each.approach for each in task.of(servo.joint)}:
                self.names.append((servo.joint, "lag"))
        self.names += [(board, "clock") for board in task.boards if self._told(board)]
        self.names += [(name, "compliance") for name in self.compliances]
        self.place = {name: i for i, name in enumerate(self.names)}

    def _told(self, board: str) -> bool:
        trusted = {s.joint for s in self.task.servos if s.board == board and s.trusted_sd is not None}
        return bool(self.task.boards[board].measured) or any(o.joint in trusted for o in self.task.observations)

    @cached_property
    def compliances(self) -> tuple[str, ...]:
        """Parameters of the arm that are found beside the tables."""
        return tuple(dict.fromkeys(name for each in self.task.observations for name in each.sag_slopes))

    def pulses(self, x: Array, servo: KnownServo) -> Array:
        """A servo's pulses at its knots (s)."""
        first = self.place[servo.joint, "pulse0"]
        return np.asarray(x[first : first + len(self.task.knots_of(servo))] * US)

    def one(self, x: Array, owner: str, name: str) -> float:
        """A number, or 0 if it is not looked for."""
        place = self.place.get((owner, name))
        return 0.0 if place is None else float(x[place])

    def clock(self, x: Array, board: str) -> PulseClock:
        """A board's clock."""
        stated = self.task.boards[board].clock
        return PulseClock(stated.oscillator_hz * (1.0 + self.one(x, board, "clock")), stated.prescale)

    def start(self) -> Array:
        """As stated, the tables by a straight line of least squares through what was observed."""
        x = np.zeros(len(self.names))
        for servo in self.task.servos:
            knots = self.task.knots_of(servo)
            stated = servo.pulses_at(knots)
            seen = self.task.of(servo.joint)
            tick = self.task.boards[servo.board].clock.tick
            hats = [interpolated(np.array([o.angle - o.sag for o in seen]), knots, row) for row in np.eye(len(knots))]
            weight = 10.0 if servo.trusted_sd is not None else 1e-3
            rows = np.vstack([np.array(hats).T.reshape(-1, len(knots)), weight * np.eye(len(knots))])
            right = np.concatenate([[o.counts * tick for o in seen], weight * stated])
            first = self.place[servo.joint, "pulse0"]
            x[first : first + len(knots)] = np.linalg.lstsq(rows, right, rcond=None)[0] / US
        return x


@dataclass(frozen=True)
class _Seen:
    """A servo's observations as arrays."""

    servo: KnownServo
    counts: Array
    approach: Array
    angle: Array
    sd: Array
    slopes: Array


class Residuals:
    """Weighted residuals of a vector of unknowns: the observations', in their order by servo, then the priors'."""

    def __init__(self, unknowns: Unknowns, kept: Sequence[bool], scales: dict[str, float], about: Array) -> None:
        self._u = unknowns
        task = unknowns.task
        chosen = [o for o, keep in zip(task.observations, kept, strict=True) if keep]
        self._seen = [_seen(s, [o for o in chosen if o.joint == s.joint], unknowns.compliances) for s in task.servos]
        self._sds = [self._pulse_sds(seen, about) * scales.get(seen.servo.joint, 1.0) for seen in self._seen]

    def _pulse_sds(self, seen: _Seen, x: Array) -> Array:
        """Deviations of angles as deviations of pulses, by the slopes of the tables at x."""
        steep = slopes_at(self._angles(seen, x), self._u.task.knots_of(seen.servo), self._u.pulses(x, seen.servo))
        return np.asarray(seen.sd * np.maximum(np.abs(steep), 50 * US))

    def _angles(self, seen: _Seen, x: Array) -> Array:
        """Where the servos stood, by what was measured."""
        joint = seen.servo.joint
        given = seen.slopes @ np.array([self._u.one(x, name, "compliance") for name in self._u.compliances])
        lag = self._u.one(x, joint, "lag") * seen.approach
        return np.asarray(seen.angle - given - self._u.one(x, joint, "zero") + lag)

    def observed(self, x: Array) -> dict[str, Array]:
        """By joint."""
        found = {}
        for seen, sd in zip(self._seen, self._sds, strict=True):
            servo = seen.servo
            pulses = seen.counts * self._u.clock(x, servo.board).tick
            by_table = interpolated(self._angles(seen, x), self._u.task.knots_of(servo), self._u.pulses(x, servo))
            found[servo.joint] = (pulses - by_table) / sd
        return found

    def __call__(self, x: Array) -> Array:
        """All."""
        return np.concatenate([*self.observed(x).values(), np.array(list(self._priors(x)))])

    def _priors(self, x: Array) -> list[float]:
        task = self._u.task
        rows: list[float] = []
        for servo in task.servos:
            knots, pulses = task.knots_of(servo), self._u.pulses(x, servo)
            rows += list((pulses - servo.pulses_at(knots)) / (servo.trusted_sd or WEAK_PULSE_SD))
            if task.zero == "kept":
                rows.append(self._u.one(x, servo.joint, "zero") / WEAK_ZERO_SD)
                if servo.trusted_sd is None:
                    # In counts: by another oscillator the same pulse is stated longer or shorter.
                    longer = self._u.clock(x, servo.board).tick / task.boards[servo.board].clock.tick
                    stated = servo.pulses_at(np.zeros(1))[0] * longer
                    rows.append((interpolated(np.zeros(1), knots, pulses)[0] - stated) / _KEPT_SD)
        for name, board in task.boards.items():
            tick = self._u.clock(x, name).tick
            rows += [(each.counts * tick - each.length) / each.sd for each in board.measured]
        changes = np.array([self._u.one(x, name, "compliance") for name in self._u.compliances])
        rows += (changes / task.compliance_sd).tolist()
        if task.springs is not None:
            rows += (task.springs.slopes @ changes - task.springs.sizes).tolist()
        return rows


def _seen(servo: KnownServo, seen: Sequence[Observation], compliances: Sequence[str]) -> _Seen:
    slopes = np.array([[o.sag_slopes.get(name, 0.0) for name in compliances] for o in seen])
    return _Seen(
        servo,
        np.array([float(o.counts) for o in seen]),
        np.array([float(o.approach) for o in seen]),
        np.array([o.angle - o.sag for o in seen]),
        np.array([o.sd for o in seen]),
        slopes.reshape(len(seen), len(compliances)),
    )
