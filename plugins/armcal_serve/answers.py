"""From a request to its answer, by one calibration, a slice of work at a time. Every request has an answer."""

import math
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from armcal.base.arrays import Array
from armcal.base.config_text import as_line
from armcal.base.quaternions import quaternion_of
from armcal.base.units import to_unit
from armcal.calibration.compensation import Commands, Targets
from armcal.errors import ArmcalError, DataError, Location
from armcal.io.json_server import SLICE_S

from armcal_serve.protocol import VERSION, CompensateRequest, ForwardRequest, RawRequest, Units, parsed, refusal
from armcal_serve.served_arm import ServedArm

Status = Callable[[], Mapping[str, Any]]  # What a request for the status is answered
_Answered = Generator[None, None, list[str]]  # JSON of an answer, a part after the other, without braces

_MOST_AT_ONCE = 64  # Rows that are computed together


@dataclass(frozen=True)
class Answerer:
    """Answers by one calibration."""

    arms: Mapping[str, ServedArm]  # by name
    tag: Mapping[str, Any]  # identifies the calibration in every answer
    fault: ArmcalError | None = None  # the answer to every request; None where the calibration may be used

    def begin(self, line: bytes, arrived: float, status: Status = dict) -> Iterator[bytes | None]:
        """The answer to a line that arrived then (monotonic seconds), after None for each slice before it."""
        began, identity = time.monotonic(), None
        try:
            fields = parsed(line)
            identity = fields.get("id") if isinstance(fields, dict) else None
            raw = RawRequest.of(fields)
            first = raw.checked(range(1))
            if first.do == "status":
                yield as_line({**status(), "id": identity}).encode()
                return
            if self.fault is not None:
                raise self.fault
            answer = self._forward if first.do == "forward" else self._compensate
            parts = [_inner({"armcal_serve": VERSION, "id": identity, "ok": True})]
            parts += yield from answer(raw, first, self._arm(first.arm))
        except ArmcalError as fault:
            parts = [_inner(refusal(identity, fault))]
        except Exception as fault:  # a request that nobody thought of must not end the server
            hint = "Report it with the request; others are answered as before."
            why = ArmcalError(f"it failed ({type(fault).__name__}: {fault}).", hint=hint)
            parts = [_inner(refusal(identity, why))]
        now = time.monotonic()
        times = {"waited_ms": round(1000 * (began - arrived), 3), "took_ms": round(1000 * (now - arrived), 3)}
        yield f"{{{', '.join([*parts, _inner({'calibration': self.tag, **times})])}}}".encode()

    def _forward(self, raw: RawRequest, first: ForwardRequest, arm: ServedArm) -> _Answered:
        field = "joint_angles" if first.joint_angles else "joints"
        rows, angles = list[str](), list[Array]()
        conditions, loads, approach = arm.conditions(first), arm.loads(first), arm.approach(first)

        def step(some: range) -> None:
            postures = getattr(raw.checked(some) if some.start else first, field)
            named = zip(postures, some, strict=True)
            angles.append(np.array([arm.posture(posture, f"{field}.{place}") for posture, place in named]))
            poses = arm.under(conditions).forward(angles[-1], loads, approach.T, conditions)
            rows.extend(as_line(_tool(pose)) for pose in poses)

        yield from _sliced(len(raw.rows), step)
        return _parts({"arm": arm.name}, "tools", rows, arm.beyond_records(np.vstack(angles), loads))

    def _compensate(self, raw: RawRequest, first: CompensateRequest, arm: ServedArm) -> _Answered:
        rows, parts, angles = list[str](), list[Targets](), list[Array]()
        if first.units in ("counts", "pulse_us") and not arm.compensator.expression.servos:
            hint = "Ask for rad or deg, or give the arm's joints pulse tables and calibrate again."
            raise DataError("the arm has no pulse tables.", where=Location(field="units"), hint=hint)
        stated = {"start": first.start, "start_joints": first.start_joints}
        starts = [np.array(arm.posture(values, field)) for field, values in stated.items() if values is not None]
        start = starts[0] if starts else None
        compensator = arm.under(arm.conditions(first))

        def emit(commands: Commands) -> None:
            angles.append(commands.joint_angles)
            rows.extend(as_line(row) for row in command_rows(arm, commands, first.units))

        def step(some: range) -> None:
            request = raw.checked(some) if some.start else first
            parts.append(arm.targets(request, first.targets[0].has_rotation, some.start))
            if not first.path:
                emit(compensator.solve(parts[-1], start))

        yield from _sliced(len(raw.rows), step)
        if first.path:
            for commands in compensator.following(Targets.joined(parts), start):
                if commands is not None:
                    emit(commands)
                yield None
        head = {"arm": arm.name, "joint_names": [*arm.joints]}
        return _parts(head, "commands", rows, arm.beyond_records(np.vstack(angles), arm.loads(first)))

    def _arm(self, name: str | None) -> ServedArm:
        if name is None and len(self.arms) == 1:
            return next(iter(self.arms.values()))
        if name is None or name not in self.arms:
            text = "the calibration has several arms." if name is None else f"the calibration has no arm {name!r:.60}."
            raise DataError(text, where=Location(field="arm"), hint=f"Name one of {', '.join(self.arms)}.")
        return self.arms[name]


def _parts(head: Mapping[str, Any], name: str, rows: list[str], beyond: tuple[list[int] | None, str]) -> list[str]:
    return [_inner(head), f'"{name}": [{", ".join(rows)}]', _inner({"beyond_records": beyond[0], "warning": beyond[1]})]


def _inner(content: Mapping[str, Any]) -> str:
    return as_line(content)[1:-1]


def _sliced(count: int, step: Callable[[range], None]) -> Iterator[None]:
    """Do a step for some rows after others, as many together as there is time for; None after each."""
    at, wide = 0, 1
    while at < count:
        began = time.monotonic()
        step(range(at, min(at + wide, count)))
        took = time.monotonic() - began
        at += wide
        wide = max(1, wide // 2) if took > SLICE_S else min(_MOST_AT_ONCE, 2 * wide) if took < SLICE_S / 3 else wide
        yield None


def command_rows(arm: ServedArm, commands: Commands, units: Units) -> list[dict[str, Any]]:
    return [
        {
            **_commanded(arm, commands, i, units),
            "reached": bool(commands.reached[i]),
            "why_not": commands.reasons[i],
            "error_mm": float(commands.distances[i]) * 1000,
            "error_deg": math.degrees(float(commands.turns[i])),
            "nearest_mm": float(commands.bounds[i]) * 1000,
            "approach": [round(side) for side in commands.approach[i].tolist()],
            "tool": _tool(commands.base_T_point[i]),
        }
        for i in range(len(commands))
    ]


def _commanded(arm: ServedArm, commands: Commands, row: int, units: Units) -> dict[str, Any]:
    if units == "rad" or units == "deg":
        values = commands.joint_angles[row]
        if arm.slides:
            return {"joints": arm.written(values.tolist(), units)}
        return {f"joint_angles_{units}": to_unit(values, units).tolist()}
    servos = arm.compensator.expression.servos
    counts = [] if commands.counts is None else commands.counts[row].tolist()
    set_at = {name: n for name, n in zip(arm.joints, counts, strict=True) if name in servos}
    if units == "counts":
        return {"counts": [set_at.get(name) for name in arm.joints]}
    pulses = {name: count * servos[name][1].tick * 1e6 for name, count in set_at.items()}
    return {"pulse_us": [pulses.get(name) for name in arm.joints]}


def _tool(pose: Array) -> dict[str, Any]:
    return {
        "position_mm": (pose[:3, 3] * 1000).tolist(),
        "quaternion_wxyz": [*quaternion_of(pose[:3, :3])],
    }
