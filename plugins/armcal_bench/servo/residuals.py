"""How far observations and what was known before are from a vector of a servo fit's unknowns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from armcal.arm.servo import piecewise_linear
from armcal.base.domains import Array

from armcal_bench.servo.known import KnownServo, Observation, slopes_at
from armcal_bench.servo.unknowns import US, WEAK_PULSE_SD, Unknowns

WEAK_ZERO_SD = 1.0
_KEPT_SD = 1e-3 * US
_LEAST_SLOPE = 50 * US


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
    """Weighted residuals of a vector of unknowns: the observations', in their order by servo, then the priors'.

    One expression gives values and exact derivatives.

    Args:
        unknowns: what is looked for.
        kept: which observations count.
        scales: of the deviations, by joint.
        about: the vector at which deviations of angles are made deviations of pulses, by the slopes of the tables.
    """

    def __init__(self, unknowns: Unknowns, kept: Sequence[bool], scales: dict[str, float], about: Array) -> None:
        self._u = unknowns
        task = unknowns.task
        chosen = [o for o, keep in zip(task.observations, kept, strict=True) if keep]
        self._seen = [_seen(s, [o for o in chosen if o.joint == s.joint], unknowns.compliances) for s in task.servos]
        sds = [self._pulse_sds(seen, about) * scales.get(seen.servo.joint, 1.0) for seen in self._seen]
        x = ca.SX.sym("x", len(unknowns.names))
        observed = [self._observed(x, seen, sd) for seen, sd in zip(self._seen, sds, strict=True)]
        rows = ca.densify(ca.vertcat(*observed, *self._priors(x)))
        self._values = ca.Function("residuals", [x], [rows])

    def __call__(self, x: Array) -> Array:
        """All."""
        return np.asarray(self._values(x).full()).ravel()

    def jacobian(self, x: Array) -> Array:
        """Of all (residuals x unknowns)."""
        return np.asarray(self._slopes(x, 0).full())

    def observed(self, x: Array) -> dict[str, Array]:
        """Of the observations, by joint."""
        ends = np.cumsum([len(seen.counts) for seen in self._seen])
        parts = np.split(self(x), ends)[:-1]
        return {seen.servo.joint: part for seen, part in zip(self._seen, parts, strict=True)}

    @cached_property
    def _slopes(self) -> ca.Function:
        return self._values.jacobian()

    def _pulse_sds(self, seen: _Seen, x: Array) -> Array:
        angles = np.asarray(ca.DM(self._angles(x, seen))).ravel()
        steep = slopes_at(angles, self._u.task.knots_of(seen.servo), self._u.pulses(x, seen.servo))
        return np.asarray(seen.sd * np.maximum(np.abs(steep), _LEAST_SLOPE))

    def _angles(self, x: Any, seen: _Seen) -> Any:
        """Where the servos stood, by what was measured."""
        joint = seen.servo.joint
        angles = ca.DM(seen.angle) - self._one(x, joint, "zero") + self._one(x, joint, "lag") * ca.DM(seen.approach)
        for column, name in enumerate(self._u.compliances):
            angles = angles - ca.DM(seen.slopes[:, column]) * self._one(x, name, "compliance")
        return angles

    def _observed(self, x: Any, seen: _Seen, sd: Array) -> Any:
        if not len(seen.counts):
            return ca.SX.zeros(0, 1)
        by_table = self._table(x, seen.servo, self._angles(x, seen))
        return (ca.DM(seen.counts) * self._tick(x, seen.servo.board) - by_table) / ca.DM(sd)

    def _table(self, x: Any, servo: KnownServo, angles: Any) -> Any:
        return piecewise_linear(angles, self._u.task.knots_of(servo).tolist(), self._pulses(x, servo))

    def _pulses(self, x: Any, servo: KnownServo) -> list[Any]:
        first = self._u.place[servo.joint, "pulse0"]
        return [x[first + k] * US for k in range(len(self._u.task.knots_of(servo)))]

    def _tick(self, x: Any, board: str) -> Any:
        return self._u.task.boards[board].clock.tick / (1.0 + self._one(x, board, "clock"))

    def _one(self, x: Any, owner: str, name: str) -> Any:
        place = self._u.place.get((owner, name))
        return 0.0 if place is None else x[place]

    def _priors(self, x: Any) -> Iterator[Any]:
        task = self._u.task
        for servo in task.servos:
            stated = servo.pulses_at(task.knots_of(servo))
            for pulse, before in zip(self._pulses(x, servo), stated, strict=True):
                yield (pulse - before) / (servo.trusted_sd or WEAK_PULSE_SD)
            if task.zero == "kept":
                yield self._one(x, servo.joint, "zero") / WEAK_ZERO_SD
                if servo.trusted_sd is None:
                    yield self._kept_zero(x, servo)
        for name, board in task.boards.items():
            for measured_pulse in board.measured:
                yield (measured_pulse.counts * self._tick(x, name) - measured_pulse.length) / measured_pulse.sd
        changes = [self._one(x, name, "compliance") for name in self._u.compliances]
        yield from (change / task.compliance_sd for change in changes)
        if task.springs is not None:
            for row, size in zip(task.springs.slopes, task.springs.sizes, strict=True):
                yield sum(slope * change for slope, change in zip(row, changes, strict=True)) - size

    def _kept_zero(self, x: Any, servo: KnownServo) -> Any:
        """In counts: by another oscillator the same pulse is stated longer or shorter."""
        longer = self._tick(x, servo.board) / self._u.task.boards[servo.board].clock.tick
        stated = float(servo.pulses_at(np.zeros(1))[0]) * longer
        return (self._table(x, servo, 0.0) - stated) / _KEPT_SD


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
