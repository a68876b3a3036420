"""An arm that requests are about: its joints by name, in their units, the loads on it, and where it is to go."""

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
from armcal.arm.statics import LOAD_CHANNELS
from armcal.base.arrays import Array
from armcal.base.poses import PoseSettings
from armcal.base.quaternions import rotation_matrix
from armcal.base.units import from_unit, split_suffix, to_unit
from armcal.calibration.compensation.compensator import Compensator
from armcal.calibration.compensation.request import Targets
from armcal.calibration.measured_point import Point
from armcal.calibration.recorded_range import PAYLOAD, RecordedRange
from armcal.errors import DataError, Location

from armcal_serve.protocol import CompensateRequest, Loads, TargetRequest

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
        if not isinstance(values, Mapping):
            if self.slides:
                _refuse("the arm has prismatic joints.", field, f"Give joints by name, as {self._example}.")
            return self._in_order(values, field)
        posture: dict[str, float] = {}
        for key, value in values.items():
            split = split_suffix(key)
            if split is None:
                _refuse(f"found {_short(key)!r} without a unit.", field, f"For example {self._example}.")
            name, unit = split
            self._known(name, field)
            if unit.dimension != self.dimensions[name]:
                text = f"found {unit.name} for the joint {name}, expected a unit of {self.dimensions[name]}."
                _refuse(text, field, f"For example {self._example}.")
            if name in posture:
                _refuse(f"the joint {name} is given twice.", field, "Give it once.")
            posture[name] = from_unit(value, unit.name)
        missing = [name for name in self.joints if name not in posture]
        if missing:
            _refuse(f"found no {', '.join(missing)}.", field, f"Give all of {', '.join(self.joints)}.")
        return [posture[name] for name in self.joints]

    def written(self, values: Sequence[float], angle_unit: str) -> dict[str, float]:
        """One posture by name with the unit: angles in ``rad`` or ``deg``, lengths in m or mm to match."""
        units = {"angle": angle_unit, "length": "mm" if angle_unit == "deg" else "m"}
        named = zip(self.dimensions.items(), values, strict=True)
        return {f"{name}_{units[kind]}": to_unit(float(value), units[kind]) for (name, kind), value in named}

    def approach(self, stated: Loads, count: int) -> Array:
        """From where each joint comes (n x count): -1, 0 (not known) or 1."""
        sides = stated.approach
        if isinstance(sides, Mapping):
            for name in sides:
                self._known(name, "approach")
            sides = tuple(sides.get(name, 0) for name in self.joints)
        row = np.zeros(len(self.joints)) if sides is None else np.array(self._in_order(sides, "approach"))
        return np.repeat(row[:, None], count, axis=1)

    def loads(self, general: Loads, count: int, single: Sequence[Loads] = ()) -> Array:
        """The loads (LOAD_CHANNELS x count; SI): as stated for all, then as stated for each."""
        expression = self.compensator.expression
        start = expression.channels.index(LOAD_CHANNELS[0])
        loads = np.repeat(
            np.asarray(expression.defaults[start : start + len(LOAD_CHANNELS), None], float), count, axis=1
        )
        for columns, stated in ((slice(None), general), *((slice(i, i + 1), one) for i, one in enumerate(single))):
            if stated.payload is not None:
                loads[LOAD_CHANNELS.index(PAYLOAD), columns] = stated.payload
            for field, channel in _VECTORS.items():
                vector, first = getattr(stated, field), LOAD_CHANNELS.index(channel)
                if vector is not None:
                    loads[first : first + 3, columns] = np.array(vector)[:, None]
        known = general.payload is not None or (single and all(stated.payload is not None for stated in single))
        if self.needs_payload and not known:
            text = "what hangs on the arm moves it, and neither the request nor the calibration states its payload."
            _refuse(text, "payload_g", "Give payload_g, 0 where nothing hangs on it.")
        return loads

    def targets(self, request: CompensateRequest, first: int) -> Targets:
        """Those of a request; ``first`` is the place of its first one, for messages."""
        some, rotations = request.targets, None
        if some[0].rpy is not None or some[0].quaternion_wxyz is not None:
            rotations = np.array([_rotation(target, f"targets.{first + i}") for i, target in enumerate(some)])
        approach = self.approach(request, len(some))
        for i, target in enumerate(some):
            if target.approach is not None:
                approach[:, i : i + 1] = self.approach(target, 1)
        loads = self.loads(request, len(some), some)
        temperatures = [request.temperature if target.temperature is None else target.temperature for target in some]
        field = f"targets.{first + next((i for i, t in enumerate(some) if t.temperature is not None), 0)}."
        field = TEMPERATURE_KEY if request.temperature is not None else field + TEMPERATURE_KEY
        conditions = self.conditions(temperatures[0], field)
        if conditions:
            conditions = {TEMPERATURE: np.array(temperatures, dtype=float)}
        try:
            return Targets(np.array([target.position for target in some]), rotations, loads, approach, conditions)
        except ValueError as fault:
            farthest = 1000 * self.compensator.reach.farthest
            reach = f"; this arm reaches {farthest:.0f} mm from its mount at most" if math.isfinite(farthest) else ""
            _refuse(f"{fault}.", "targets", f"Give places of the base frame in mm (position_mm){reach}.")

    def conditions(self, temperature: float | None, field: str) -> dict[str, Any]:
        """What a compensator takes of the surroundings, by the temperature that a field states."""
        if temperature is None:
            return {}
        if self.heated is None:
            hint = "Leave it out, or calibrate the arm with an effect that depends on it, such as thermal_length."
            _refuse(f"the arm {self.name} does not change with the temperature.", field, hint)
        return {TEMPERATURE: temperature}

    def under(self, conditions: Mapping[str, Any]) -> Compensator:
        return self.heated if conditions and self.heated is not None else self.compensator

    def beyond_records(self, commands: Array, loads: Array) -> tuple[list[int] | None, str]:
        """Which poses lie beyond the records, and a sentence about them; None where the records' ranges are not known.

        Args:
            commands: N x n; rad or m.
            loads: LOAD_CHANNELS x N; SI.
        """
        if self.recorded is None:
            return None, ""
        values = np.vstack([commands.T, loads[LOAD_CHANNELS.index(PAYLOAD)]])
        places: list[int] = np.flatnonzero(self.recorded.beyond(values).any(axis=0)).tolist()
        return places, self.recorded.sentence(values) if places else ""

    def _in_order(self, row: Sequence[float], field: str) -> list[float]:
        if len(row) != len(self.joints):
            text = f"found {len(row)} values, expected {len(self.joints)}: {', '.join(self.joints)}."
            _refuse(text, field, "Give one for each joint, in this order, or give them by name.")
        return [float(value) for value in row]

    def _known(self, name: str, field: str) -> None:
        if name in self.dimensions:
            return
        near = difflib.get_close_matches(name, self.joints, n=1)
        hint = f"Did you mean {near[0]}?" if near else f"The joints are {', '.join(self.joints)}."
        _refuse(f"the arm {self.name} has no joint {_short(name)!r}.", field, hint)

    @property
    def _example(self) -> str:
        name, kind = next(iter(self.dimensions.items()))
        return f"{name}_{'deg' if kind == 'angle' else 'mm'}"


def _rotation(target: TargetRequest, field: str) -> Array:
    try:
        stated = PoseSettings.si(rpy=target.rpy, quaternion=target.quaternion_wxyz)
    except ValueError as fault:
        message = getattr(fault, "errors", list)()[0]["msg"].removeprefix("Value error, ")
        _refuse(f"{message}.", field, "Give rpy_deg or quaternion_wxyz.")
    return rotation_matrix(np.array(stated.unit_quaternion))


def _refuse(message: str, field: str, hint: str) -> NoReturn:
    raise DataError(message, where=Location(field=field), hint=hint)


def _short(text: str) -> str:
    return text if len(text) <= 40 else f"{text[:37]}..."
