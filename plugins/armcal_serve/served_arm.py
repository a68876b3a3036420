"""An arm that requests are about: its joints by name, in their units, the loads on it, and where it is to go."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
from armcal.arm.statics import LOAD_CHANNELS
from armcal.base.arrays import Array
from armcal.base.poses import PoseSettings
from armcal.base.quaternions import rotation_matrix
from armcal.base.units import from_unit, split_suffix, to_unit
from armcal.calibration.compensation import Compensator, Targets
from armcal.calibration.intervals import PAYLOAD, RecordedRange
from armcal.calibration.tool_expression import Point
from armcal.errors import DataError, Location

from armcal_serve.protocol import ArmRequest, CompensateRequest, TargetRequest

TEMPERATURE = "temperature"
TEMPERATURE_KEY = "temperature_C"
_VECTORS = {"gravity": "gravity_x", "payload_com": "payload_x", "force": "force_x", "torque": "torque_x"}
"""The first channel of each."""


@dataclass(frozen=True)
class ServedArm:
    name: str  # the arm's instance name
    dimensions: Mapping[str, str]  # ``angle`` or ``length`` by commanded joint, in order
    compensator: Compensator
    needs_payload: bool  # whether what hangs on it moves it and the calibration does not state that
    heated: Compensator | None = None  # for requests that state the temperature, where the arm changes with it
    point: Point = "tool"  # what requests and answers are about: the tool's frame, or the target that was measured
    recorded: RecordedRange | None = None  # of the joints in the calibration's records, then of the payload

    @property
    def joints(self) -> tuple[str, ...]:
        return tuple(self.dimensions)

    @property
    def slides(self) -> bool:
        return "length" in self.dimensions.values()

    @property
    def shown(self) -> Mapping[str, str | list[str]]:
        """For clients: its joints, the point that arrives, and the keys of the surroundings that it changes with."""
        conditions: dict[str, str | list[str]] = {} if self.heated is None else {"conditions": [TEMPERATURE_KEY]}
        return {"joints": [*self.joints], "point": self.point, **conditions}

    def posture(self, values: Sequence[float] | Mapping[str, float], field: str) -> list[float]:
        """Commands (n; rad, or m) from angles in order (rad), or from values by name with the unit (``q1_deg``)."""
        example = ", ".join(f"{name}_{'deg' if kind == 'angle' else 'mm'}" for name, kind in self.dimensions.items())
        if not isinstance(values, Mapping):
            if self.slides:
                _refuse("the arm has prismatic joints.", field, f"Give joints by name: {example}.")
            return self._in_order(values, field)
        posture: dict[str, float] = {}
        for key, value in values.items():
            name, unit = split_suffix(key) or (key, None)
            self._require_joints([name], field)
            if unit is None or unit.dimension != self.dimensions[name]:
                text = f"found {key}, expected a unit of {self.dimensions[name]}."
                _refuse(text, field, f"Give {example}.")
            if name in posture:
                _refuse(f"the joint {name} is given twice.", field, "Give it once.")
            posture[name] = from_unit(value, unit.name)
        missing = [name for name in self.joints if name not in posture]
        if missing:
            _refuse(f"found no {', '.join(missing)}.", field, f"Give {example}.")
        return [posture[name] for name in self.joints]

    def written(self, values: Sequence[float], angle_unit: str) -> dict[str, float]:
        """One posture by name with the unit: angles in ``rad`` or ``deg``, lengths in m or mm to match."""
        units = {"angle": angle_unit, "length": "mm" if angle_unit == "deg" else "m"}
        named = zip(self.dimensions.items(), values, strict=True)
        return {f"{name}_{units[kind]}": to_unit(float(value), units[kind]) for (name, kind), value in named}

    def approach(self, request: ArmRequest) -> Array:
        """From where each joint comes (n x 1): -1, 0 (not known) or 1."""
        sides = request.approach
        if isinstance(sides, Mapping):
            self._require_joints(sides, "approach")
            sides = tuple(sides.get(name, 0) for name in self.joints)
        return np.zeros((len(self.joints), 1)) if sides is None else np.array([self._in_order(sides, "approach")]).T

    def loads(self, request: ArmRequest) -> Array:
        """The loads on the arm (LOAD_CHANNELS x 1; SI)."""
        expression = self.compensator.expression
        start = expression.channels.index(LOAD_CHANNELS[0])
        loads = np.array(expression.defaults[start : start + len(LOAD_CHANNELS), None], float)
        if request.payload is not None:
            loads[LOAD_CHANNELS.index(PAYLOAD)] = request.payload
        elif self.needs_payload:
            text = "what hangs on the arm moves it, and neither the request nor the calibration states its payload."
            _refuse(text, "payload_g", "Give payload_g, 0 where nothing hangs on it.")
        for field, channel in _VECTORS.items():
            vector, first = getattr(request, field), LOAD_CHANNELS.index(channel)
            if vector is not None:
                loads[first : first + 3, 0] = vector
        return loads

    def targets(self, request: CompensateRequest, turned: bool, place: int) -> Targets:
        """Those of a request, or some of them from a place on; with a rotation each, or with none."""
        some, count = request.targets, len(request.targets)
        for i, target in enumerate(some, place):
            if target.has_rotation is not turned:
                text = "found some targets with a rotation and some without, expected all of one kind."
                _refuse(text, f"targets.{i}", "Ask for them in two requests.")
        rotations = np.array([_rotation(t, f"targets.{i}") for i, t in enumerate(some, place)]) if turned else None
        loads, approach = (np.repeat(of(request), count, axis=1) for of in (self.loads, self.approach))
        conditions = {name: np.full(count, value) for name, value in self.conditions(request).items()}
        try:
            return Targets(np.array([target.position for target in some]), rotations, loads, approach, conditions)
        except ValueError as fault:
            farthest = 1000 * self.compensator.reach.farthest
            reach = f"; this arm reaches {farthest:.0f} mm from its mount at most" if math.isfinite(farthest) else ""
            _refuse(f"{fault}.", "targets", f"Give places of the base frame in mm (position_mm){reach}.")

    def conditions(self, request: ArmRequest) -> dict[str, float]:
        """What a compensator takes of the surroundings."""
        if request.temperature is None:
            return {}
        if self.heated is None:
            hint = "Leave it out, or calibrate the arm with an effect that depends on it, such as thermal_length."
            _refuse(f"the arm {self.name} does not change with the temperature.", TEMPERATURE_KEY, hint)
        return {TEMPERATURE: request.temperature}

    def under(self, conditions: Mapping[str, Any]) -> Compensator:
        return self.heated if conditions and self.heated is not None else self.compensator

    def beyond_records(self, commands: Array, loads: Array) -> tuple[list[int] | None, str]:
        """Which commands (N x n; rad or m) lie beyond the records under loads (LOAD_CHANNELS x 1), and a sentence about
        them; None where the records' ranges are not known.
        """
        if self.recorded is None:
            return None, ""
        values = np.vstack([commands.T, np.full(len(commands), loads[LOAD_CHANNELS.index(PAYLOAD)])])
        places: list[int] = np.flatnonzero(self.recorded.beyond(values).any(axis=0)).tolist()
        return places, self.recorded.sentence(values) if places else ""

    def _in_order(self, row: Sequence[float], field: str) -> list[float]:
        if len(row) != len(self.joints):
            text = f"found {len(row)} values, expected {len(self.joints)}: {', '.join(self.joints)}."
            _refuse(text, field, "Give one for each joint, in this order, or give them by name.")
        return [float(value) for value in row]

    def _require_joints(self, names: Iterable[str], field: str) -> None:
        for name in names:
            if name not in self.dimensions:
                text = f"the arm {self.name} has no joint {name!r:.40}."
                _refuse(text, field, f"Its joints are {', '.join(self.joints)}.")


def _rotation(target: TargetRequest, field: str) -> Array:
    try:
        stated = PoseSettings.si(rpy=target.rpy, quaternion=target.quaternion_wxyz)
    except ValueError as fault:
        message = getattr(fault, "errors", list)()[0]["msg"].removeprefix("Value error, ")
        _refuse(f"{message}.", field, "Give rpy_deg or quaternion_wxyz.")
    return rotation_matrix(np.array(stated.unit_quaternion))


def _refuse(message: str, field: str, hint: str) -> NoReturn:
    raise DataError(message, where=Location(field=field), hint=hint)
