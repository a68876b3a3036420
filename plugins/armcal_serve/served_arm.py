"""An arm that requests are about: its joints by name, in their units, and what acts on it."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NoReturn

import numpy as np
from armcal.arm.statics import LOAD_CHANNELS
from armcal.base.arrays import Array
from armcal.base.units import from_unit, split_suffix, to_unit
from armcal.calibration.compensation.compensator import Compensator
from armcal.calibration.measured_point import Point
from armcal.calibration.recorded_range import PAYLOAD, RecordedRange
from armcal.errors import DataError, Location

from armcal_serve.protocol import Acting

TEMPERATURE = "temperature"
TEMPERATURE_KEY = "temperature_C"
_VECTORS = ("gravity", "payload_com", "force", "torque")
_CHANNEL = {"payload_com": "payload"}
"""The channels of the payload's centre are called ``payload_x`` and so on, those of the others as the field."""


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
    def turns_only(self) -> bool:
        return set(self.dimensions.values()) <= {"angle"}

    @property
    def shown(self) -> Mapping[str, str | list[str]]:
        """For clients: its joints, the point that arrives, and the keys of the surroundings that it changes with."""
        conditions: dict[str, str | list[str]] = {} if self.heated is None else {"conditions": [TEMPERATURE_KEY]}
        return {"joints": [*self.joints], "point": self.point, **conditions}

    def angles(self, postures: Sequence[Sequence[float] | Mapping[str, float]], field: str) -> Array:
        """Postures (N x n; rad) from angles in order or by name."""
        if not self.turns_only:
            hint = f"Give them by name with the unit, as {field.replace('joint_angles', 'joints')}."
            raise DataError("the arm has sliding joints.", where=Location(field=field), hint=hint)
        return np.array([self._in_order(row, f"{field}.{i}") for i, row in enumerate(postures)])

    def named(self, postures: Sequence[Mapping[str, float]], field: str) -> Array:
        """Postures (N x n; rad, or m) from values by name with the unit (``q1_deg``)."""
        rows = []
        for i, row in enumerate(postures):
            values: dict[str, float] = {}
            for key, value in row.items():
                split = split_suffix(key)
                if split is None:
                    _refuse(f"found {_short(key)!r} without a unit.", f"{field}.{i}", f"For example {self._example()}.")
                name, unit = split
                self._known(name, f"{field}.{i}")
                if unit.dimension != self.dimensions[name]:
                    text = f"found {unit.name} for the joint {name}, expected a unit of {self.dimensions[name]}."
                    _refuse(text, f"{field}.{i}", f"For example {self._example()}.")
                if name in values:
                    _refuse(f"the joint {name} is given twice.", f"{field}.{i}", "Give it once.")
                values[name] = from_unit(value, unit.name)
            rows.append(self._in_order(values, f"{field}.{i}"))
        return np.array(rows)

    def written(self, values: Sequence[float], angle_unit: str) -> dict[str, float]:
        """One posture by name with the unit: angles in ``rad`` or ``deg``, lengths in m or mm to match."""
        units = {"angle": angle_unit, "length": "mm" if angle_unit == "deg" else "m"}
        named = zip(self.dimensions.items(), values, strict=True)
        return {f"{name}_{units[kind]}": to_unit(float(value), units[kind]) for (name, kind), value in named}

    def approach(self, acting: Acting, count: int) -> Array:
        """From where each joint comes (n x count): -1, 0 (not known) or 1."""
        sides = acting.approach
        if sides is None:
            return np.zeros((len(self.joints), count))
        if isinstance(sides, Mapping):
            for name in sides:
                self._known(name, "approach")
            row: Sequence[float] = [sides.get(name, 0) for name in self.joints]
        else:
            row = self._in_order(sides, "approach")
        return np.repeat(np.array(row, dtype=float)[:, None], count, axis=1)

    def acting(self, general: Acting, count: int, single: Sequence[Acting] = ()) -> Array:
        """What acts (LOAD_CHANNELS x count; SI): as stated for all, then as stated for each."""
        expression = self.compensator.expression
        start = expression.channels.index(LOAD_CHANNELS[0])
        defaults = expression.defaults[start : start + len(LOAD_CHANNELS)]
        loads = np.repeat(np.asarray(defaults, dtype=float)[:, None], count, axis=1)
        _put(loads, general, slice(None))
        for i, acting in enumerate(single):
            _put(loads, acting, slice(i, i + 1))
        stated = general.payload is not None or (single and all(acting.payload is not None for acting in single))
        if self.needs_payload and not stated:
            _refuse(
                "what hangs on the arm moves it, and neither the request nor the calibration states its payload.",
                "payload_g",
                "Give payload_g, 0 where nothing hangs on it.",
            )
        return loads

    def beyond_records(self, commands: Array, acting: Array) -> tuple[list[int] | None, str]:
        """Which poses lie beyond the records, and a sentence about them; None where the records' ranges are not known.

        Args:
            commands: N x n; rad or m.
            acting: LOAD_CHANNELS x N; SI.
        """
        if self.recorded is None:
            return None, ""
        values = np.vstack([commands.T, acting[LOAD_CHANNELS.index(PAYLOAD)]])
        places: list[int] = np.flatnonzero(self.recorded.beyond(values).any(axis=0)).tolist()
        return places, self.recorded.sentence(values) if places else ""

    def at_temperature(self, field: str) -> Compensator:
        """The compensator where a field of the request states the temperature."""
        if self.heated is None:
            hint = "Leave it out, or calibrate the arm with an effect that depends on it, such as thermal_length."
            _refuse(f"the arm {self.name} does not change with the temperature.", field, hint)
        return self.heated

    def _in_order(self, row: Sequence[float] | Mapping[str, float], field: str) -> list[float]:
        if isinstance(row, Mapping):
            for name in row:
                self._known(name, field)
            missing = [name for name in self.joints if name not in row]
            if missing:
                _refuse(f"found no {', '.join(missing)}.", field, f"Give all of {', '.join(self.joints)}.")
            return [float(row[name]) for name in self.joints]
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

    def _example(self) -> str:
        name, kind = next(iter(self.dimensions.items()))
        return f"{name}_{'deg' if kind == 'angle' else 'mm'}"


def _put(loads: Array, acting: Acting, columns: slice) -> None:
    """Write what is stated into columns of loads (LOAD_CHANNELS x N)."""
    if acting.payload is not None:
        loads[LOAD_CHANNELS.index(PAYLOAD), columns] = acting.payload
    for field in _VECTORS:
        vector = getattr(acting, field)
        if vector is not None:
            first = LOAD_CHANNELS.index(f"{_CHANNEL.get(field, field)}_x")
            loads[first : first + 3, columns] = np.array(vector)[:, None]


def _refuse(message: str, field: str, hint: str) -> NoReturn:
    raise DataError(message, where=Location(field=field), hint=hint)


def _short(text: str) -> str:
    return text if len(text) <= 40 else f"{text[:37]}..."
