"""From a request to its answer, by one calibration, a slice of work at a time. Every request has an answer."""

import difflib
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
from armcal.calibration.compensation.request import Commands, Targets
from armcal.errors import ArmcalError, DataError, Location
from armcal.io.json_server import SLICE_S

from armcal_serve.protocol import (
    VERSION,
    CompensateRequest,
    ForwardRequest,
    RawRequest,
    TargetRequest,
    Units,
    known_id,
    parsed,
    refusal,
)
from armcal_serve.served_arm import TEMPERATURE_KEY, ServedArm

Status = Callable[[], Mapping[str, Any]]  # What a request for the status is answered

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
        head: Mapping[str, Any]
        try:
            fields = parsed(line)
            identity = known_id(fields)
            raw = RawRequest.of(fields)
            first = raw.checked(range(1))
            if raw.do == "status":
                yield as_line({**status(), "id": identity}).encode()
                return
            if self.fault is not None:
                raise self.fault
            computed = self._forward if raw.do == "forward" else self._compensate
            of_kind, rows, tail = yield from computed(raw, first, self._arm(first.arm))
            head = {"armcal_serve": VERSION, "id": identity, "ok": True, **of_kind}
        except ArmcalError as fault:
            head, rows, tail = refusal(identity, fault), "", {}
        except Exception as fault:  # a request that nobody thought of must not end the server
            hint = "Report it with the request; others are answered as before."
            why = ArmcalError(f"it failed ({type(fault).__name__}: {fault}).", hint=hint)
            head, rows, tail = refusal(identity, why), "", {}
        now = time.monotonic()
        times = {"waited_ms": round(1000 * (began - arrived), 3), "took_ms": round(1000 * (now - arrived), 3)}
        yield f"{as_line(head)[:-1]}, {rows}{as_line({**tail, 'calibration': self.tag, **times})[1:]}".encode()

    def _forward(self, raw: RawRequest, first: ForwardRequest, arm: ServedArm) -> Generator[None, None, "_Answered"]:
        rows, angles, loads = list[str](), list[Array](), list[Array]()
        field = "joint_angles" if first.joint_angles else "joints"
        if not first.joint_angles and not first.joints:
            hint = f"Give joint_angles_deg: {len(arm.joints)} numbers, or several such rows."
            where = Location(field="joint_angles_deg")
            raise DataError("found neither joint_angles_deg nor joints.", where=where, hint=hint)

        def step(some: range) -> None:
            request = raw.checked(some) if some.start else first
            stated = getattr(request, field)
            postures = [arm.posture(row, f"{field}.{place}") for row, place in zip(stated, some, strict=True)]
            angles.append(np.array(postures))
            loads.append(arm.loads(request, len(some)))
            conditions = arm.conditions(request.temperature, TEMPERATURE_KEY)
            approach = arm.approach(request, len(some)).T
            poses = arm.under(conditions).forward(angles[-1], loads[-1], approach, conditions)
            rows.extend(as_line(_tool(pose)) for pose in poses)

        yield from _sliced(len(raw.rows), step)
        return _answered({"arm": arm.name}, "tools", rows, arm.beyond_records(np.vstack(angles), np.hstack(loads)))

    def _compensate(
        self, raw: RawRequest, first: CompensateRequest, arm: ServedArm
    ) -> Generator[None, None, "_Answered"]:
        rows, parts, done = list[str](), list[Targets](), list[Commands]()
        if first.units in ("counts", "pulse_us") and not arm.compensator.expression.servos:
            hint = "Ask for rad or deg, or give the arm's joints pulse tables and calibrate again."
            raise DataError("the arm has no pulse tables.", where=Location(field="units"), hint=hint)
        if first.start is not None and first.start_joints is not None:
            where = Location(field="start")
            raise DataError("found both start and start_joints.", where=where, hint="Give one of them.")
        stated = {"start": first.start, "start_joints": first.start_joints}
        starts = [np.array(arm.posture(values, field)) for field, values in stated.items() if values is not None]
        start = starts[0] if starts else None

        def emit(commands: Commands) -> None:
            done.append(commands)
            rows.extend(as_line(row) for row in command_rows(arm, commands, first.units))

        def step(some: range) -> None:
            request = raw.checked(some) if some.start else first
            for place, target in zip(some, request.targets, strict=True):
                _require_alike(target, first.targets[0], first.temperature is not None, place)
            parts.append(arm.targets(request, some.start))
            if not first.path:
                emit(arm.under(parts[-1].conditions).solve(parts[-1], start))

        yield from _sliced(len(raw.rows), step)
        if first.path:
            targets = Targets.joined(parts)
            for commands in arm.under(targets.conditions).following(targets, start):
                if commands is not None:
                    emit(commands)
                yield None
        angles, loads = (np.vstack([c.joint_angles for c in done]), np.hstack([t.acting for t in parts]))
        head = {"arm": arm.name, "joint_names": [*arm.joints]}
        return _answered(head, "commands", rows, arm.beyond_records(angles, loads))

    def _arm(self, name: str | None) -> ServedArm:
        if name is None and len(self.arms) == 1:
            return next(iter(self.arms.values()))
        if name is not None and name in self.arms:
            return self.arms[name]
        near = difflib.get_close_matches(name or "", self.arms, n=1)
        text = "the calibration has several arms" if name is None else "the calibration has no such arm"
        hint = f"Did you mean {near[0]}?" if near else f"Say which: {', '.join(self.arms)}."
        raise DataError(f"{text}.", where=Location(field="arm"), hint=hint)


_Answered = tuple[Mapping[str, Any], str, Mapping[str, Any]]  # before the rows, the rows as text, and after them


def _answered(head: Mapping[str, Any], name: str, rows: list[str], beyond: tuple[list[int] | None, str]) -> _Answered:
    return head, f'"{name}": [{", ".join(rows)}], ', {"beyond_records": beyond[0], "warning": beyond[1]}


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


def _require_alike(target: TargetRequest, first: TargetRequest, has_temperature: bool, place: int) -> None:
    """Targets of one request all have a rotation or none has, and so with the temperature."""
    rotation = [one.rpy is not None or one.quaternion_wxyz is not None for one in (target, first)]
    temperature = [has_temperature or one.temperature is not None for one in (target, first)]
    for words, (here, there) in (("rotation", rotation), (TEMPERATURE_KEY, temperature)):
        if here != there:
            text = (
                f"found {'a' if here else 'no'} {words} here and {'a' if there else 'no'} {words} in the first target"
            )
            where = Location(field=f"targets.{place}")
            raise DataError(f"{text}, expected all of one kind.", where=where, hint="Ask for them in two requests.")


def command_rows(arm: ServedArm, commands: Commands, units: Units) -> list[dict[str, Any]]:
    """Commands as they are answered, one row a target."""
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
