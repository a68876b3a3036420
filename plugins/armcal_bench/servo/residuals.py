"""How far observations and what was known before are from a vector of a servo fit's unknowns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from armcal.arm.servo import piecewise_linear
from armcal.base.domains import Array

from armcal_bench.servo.known import KnownServo, Observation, piecewise
from armcal_bench.servo.unknowns import US, WEAK_PULSE_SD, Unknowns

WEAK_ZERO_SD = 1.0
_KEPT_SD = 1e-3 * US
_LEAST_SLOPE = 50 * US


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
        """All."""
        return np.asarray(self._values(x).full()).ravel()

    def jacobian(self, x: Array) -> Array:
        """Of all (residuals x unknowns)."""
        return np.asarray(self._slopes(x, 0).full())

    def observed(self, x: Array) -> dict[str, Array]:
        """Of the observations, by joint."""
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
        """The length of a count (s)."""
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
