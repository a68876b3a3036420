"""The numbers that a servo fit looks for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from armcal.arm.servo import PulseClock
from armcal.base.domains import Array

from armcal_bench.servo.known import KnownBoard, KnownServo, Observation, Zero, piecewise

US = 1e-6
WEAK_PULSE_SD = 300.0 * US
"""How far a table's pulse may well be from the stated one: what no observation determines stays there."""


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
        knots: angles of the tables to be found (rad, rising); empty: each servo's own.
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
        return tuple(observation for observation in self.observations if observation.joint == joint)

    def knots_of(self, servo: KnownServo) -> Array:
        """A trusted table keeps its own."""
        own = servo.table.angles if servo.trusted_sd is not None else self.knots or servo.knots
        return np.array(own or servo.table.angles)


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
        """Parameters of the arm that are found beside the tables."""
        return tuple(dict.fromkeys(name for observation in self.task.observations for name in observation.sag_slopes))

    def pulses(self, x: Any, servo: KnownServo) -> Any:
        """A servo's pulses at its knots (s), of a vector of floats or symbols."""
        first = self.place[servo.joint, "pulse0"]
        return x[first : first + len(self.task.knots_of(servo))] * US

    def one(self, x: Any, owner: str, name: str) -> Any:
        """A number of a vector (floats or symbols), or 0 if it is not looked for."""
        place = self.place.get((owner, name))
        return 0.0 if place is None else x[place]

    def clock(self, x: Array, board: str) -> PulseClock:
        """A board's clock."""
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
