"""From a request to its answer, by one calibration, a slice of work at a time. Every request has an answer."""

import difflib
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from armcal.arm.statics import LOAD_CHANNELS
from armcal.base.arrays import Array
from armcal.base.config_text import as_line
from armcal.base.poses import PoseSettings
from armcal.base.quaternions import quaternion_of, rotation_matrix
from armcal.base.units import to_unit
from armcal.calibration.compensation.compensator import Compensator
from armcal.calibration.compensation.request import Commands, Targets
from armcal.errors import ArmcalError, DataError, Location
from armcal.io.json_server import SLICE_S

from armcal_serve.protocol import (
    VERSION,
    CompensateRequest,
    ForwardRequest,
    Request,
    TargetRequest,
    Units,
    known_id,
    parsed,
    refusal,
    request_of,
)
from armcal_serve.served_arm import TEMPERATURE, TEMPERATURE_KEY, ServedArm

Status = Callable[[], Mapping[str, Any]]  # What a request for the status is answered

_AT_ONCE = 32  # Postures, or targets of a path that are read
_MOST_AT_ONCE = 64  # Targets that are solved together


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
            identity = known_id(fields)
            request: Request | None = None
            for request in request_of(fields):
                if request is None:
                    yield None
            assert request is not None
            if request.do == "status":
                yield as_line({**status(), "id": request.id}).encode()
                return
            if self.fault is not None:
                raise self.fault
            parts: Any = ()
            for parts in self._forward(request) if request.do == "forward" else self._compensate(request):
                if parts is None:
                    yield None
            head, name, rows, (beyond, warning) = parts
            head = {"armcal_serve": VERSION, "id": request.id, "ok": True, **head}
            tail = {"beyond_records": beyond, "warning": warning}
        except ArmcalError as fault:
            head, name, rows, tail = refusal(identity, fault), "", (), {}
        except Exception as fault:  # a request that nobody thought of must not end the server
            hint = "Report it with the request; others are answered as before."
            why = ArmcalError(f"it failed ({type(fault).__name__}: {fault}).", hint=hint)
            head, name, rows, tail = refusal(identity, why), "", (), {}
        now = time.monotonic()
        times = {"waited_ms": round(1000 * (began - arrived), 3), "took_ms": round(1000 * (now - arrived), 3)}
        middle = f', "{name}": [{", ".join(rows)}], ' if name else ", "
        yield f"{as_line(head)[:-1]}{middle}{as_line({**tail, 'calibration': self.tag, **times})[1:]}".encode()

    def _forward(self, request: Any) -> Iterator[Any]:
        assert isinstance(request, ForwardRequest)
        arm = self._arm(request.arm)
        if (request.joint_angles is None) == (request.joints is None):
            text = "found neither joint_angles nor joints" if request.joints is None else "found both of them"
            hint = f"Give joint_angles_deg: {len(arm.joints)} numbers, or several such rows."
            raise DataError(f"{text}, expected one.", where=Location(field="joint_angles_deg"), hint=hint)
        if request.joint_angles is not None:
            angles = arm.angles(request.joint_angles, "joint_angles")
        else:
            angles = arm.named(request.joints or (), "joints")
        acting, approach = arm.acting(request, len(angles)), arm.approach(request, len(angles))
        compensator, conditions = arm.compensator, None
        if request.temperature is not None:
            compensator, conditions = arm.at_temperature(TEMPERATURE_KEY), {TEMPERATURE: request.temperature}
        rows: list[str] = []
        for start in range(0, len(angles), _AT_ONCE):
            some = slice(start, start + _AT_ONCE)
            for pose in compensator.forward(angles[some], acting[:, some], approach.T[some], conditions):
                rows.append(as_line(_tool(pose)))
            yield None
        yield {"arm": arm.name}, "tools", rows, arm.beyond_records(angles, acting)

    def _compensate(self, request: Any) -> Iterator[Any]:
        assert isinstance(request, CompensateRequest)
        arm, count = self._arm(request.arm), len(request.targets)
        if request.units in ("counts", "pulse_us") and not arm.compensator.expression.servos:
            hint = "Ask for rad or deg, or give the arm's joints pulse tables and calibrate again."
            raise DataError("the arm has no pulse tables.", where=Location(field="units"), hint=hint)
        if request.start is not None and request.start_joints is not None:
            text = "found both start and start_joints."
            raise DataError(text, where=Location(field="start"), hint="Give one of them.")
        start: Array | None = None
        if request.start is not None:
            start = np.asarray(arm.angles([request.start], "start")[0])
        if request.start_joints is not None:
            start = np.asarray(arm.named([request.start_joints], "start_joints")[0])
        _require_one_kind(request.targets)
        rows, angles, acting = [""] * count, np.empty((count, len(arm.joints))), np.empty((len(LOAD_CHANNELS), count))
        try:
            for compensator, places in _shares(arm, request):
                solved = _followed if request.path else _one_by_one
                at = 0
                for part in solved(compensator, arm, request, places, start):
                    if part is None:
                        yield None
                        continue
                    targets, commands = part
                    here = places[at : at + len(commands)]
                    at += len(commands)
                    angles[here], acting[:, here] = commands.joint_angles, targets.acting
                    for place, row in zip(here, command_rows(arm, commands, request.units), strict=True):
                        rows[place] = as_line(row)
                    yield None
        except ValueError as fault:
            raise DataError(f"{fault}.", where=Location(field="targets"), hint="Correct the request.") from fault
        yield {"arm": arm.name, "joint_names": [*arm.joints]}, "commands", rows, arm.beyond_records(angles, acting)

    def _arm(self, name: str | None) -> ServedArm:
        if name is None and len(self.arms) == 1:
            return next(iter(self.arms.values()))
        if name is not None and name in self.arms:
            return self.arms[name]
        known = ", ".join(self.arms)
        near = difflib.get_close_matches(name or "", self.arms, n=1)
        text = "the calibration has several arms" if name is None else "the calibration has no such arm"
        hint = f"Did you mean {near[0]}?" if near else f"Say which: {known}."
        raise DataError(f"{text}.", where=Location(field="arm"), hint=hint)


def _one_by_one(
    compensator: Compensator, arm: ServedArm, request: CompensateRequest, places: Sequence[int], start: Array | None
) -> Iterator[tuple[Targets, Commands] | None]:
    """Targets and their commands, as many together as there is time for."""
    at, wide = 0, 1
    while at < len(places):
        began = time.monotonic()
        targets = _targets(arm, request, places[at : at + wide])
        commands = compensator.solve(targets, start)
        took = time.monotonic() - began
        yield targets, commands
        at += wide
        wide = max(1, wide // 2) if took > SLICE_S else min(_MOST_AT_ONCE, 2 * wide) if took < SLICE_S / 3 else wide


def _followed(
    compensator: Compensator, arm: ServedArm, request: CompensateRequest, places: Sequence[int], start: Array | None
) -> Iterator[tuple[Targets, Commands] | None]:
    read: list[Targets] = []
    for at in range(0, len(places), _AT_ONCE):
        read.append(_targets(arm, request, places[at : at + _AT_ONCE]))
        yield None
    targets, at = Targets.joined(read), 0
    for commands in compensator.following(targets, start):
        if commands is None:
            yield None
        else:
            yield targets.subset(np.arange(at, at + len(commands))), commands
            at += len(commands)


def _shares(arm: ServedArm, request: CompensateRequest) -> list[tuple[Compensator, Sequence[int]]]:
    """Compensators, each with the places of its targets in the request: two where some state the temperature."""
    stated = [request.temperature if target.temperature is None else target.temperature for target in request.targets]
    warm = [place for place, value in enumerate(stated) if value is not None]
    if not warm:
        return [(arm.compensator, range(len(stated)))]
    field = TEMPERATURE_KEY if request.temperature is not None else f"targets.{warm[0]}.{TEMPERATURE_KEY}"
    heated = arm.at_temperature(field)
    rest = [place for place, value in enumerate(stated) if value is None]
    if rest and request.path:
        raise DataError(
            "found targets of a path with a temperature and targets without, expected all of one kind.",
            where=Location(field=f"targets.{rest[0]}"),
            hint=f"Give {TEMPERATURE_KEY} for all of the request, or for each target.",
        )
    return [(heated, warm), *([(arm.compensator, rest)] if rest else [])]


def _require_one_kind(targets: Sequence[TargetRequest]) -> None:
    turned = [target.rpy is not None or target.quaternion_wxyz is not None for target in targets]
    if any(turned) and not all(turned):
        raise DataError(
            "found targets with a rotation and targets without, expected all of one kind.",
            where=Location(field=f"targets.{turned.index(False)}"),
            hint="Ask for them in two requests.",
        )


def _targets(arm: ServedArm, request: CompensateRequest, places: Sequence[int]) -> Targets:
    """Some of a request's."""
    some = [request.targets[place] for place in places]
    positions, rotations = np.array([target.position for target in some]), None
    if some[0].rpy is not None or some[0].quaternion_wxyz is not None:
        rotations = np.array([_rotation(target, place) for place, target in zip(places, some, strict=True)])
    approach = arm.approach(request, len(some))
    for i, target in enumerate(some):
        if target.approach is not None:
            approach[:, i : i + 1] = arm.approach(target, 1)
    acting, farthest = arm.acting(request, len(some), some), 1000 * arm.compensator.reach.farthest
    temperatures = [request.temperature if target.temperature is None else target.temperature for target in some]
    conditions = {} if temperatures[0] is None else {TEMPERATURE: np.array(temperatures, dtype=float)}
    try:
        return Targets(positions, rotations, acting, approach, conditions)
    except ValueError as fault:
        reach = f"; this arm reaches {farthest:.0f} mm from its mount at most" if math.isfinite(farthest) else ""
        hint = f"Give places of the base frame in mm (position_mm){reach}."
        raise DataError(f"{fault}.", where=Location(field="targets"), hint=hint) from fault


def _rotation(target: TargetRequest, place: int) -> Array:
    try:
        stated = PoseSettings.si(rpy=target.rpy, quaternion=target.quaternion_wxyz)
    except ValueError as fault:
        message = getattr(fault, "errors", list)()[0]["msg"].removeprefix("Value error, ")
        where = Location(field=f"targets.{place}")
        raise DataError(f"{message}.", where=where, hint="Give rpy_deg or quaternion_wxyz.") from fault
    return rotation_matrix(np.array(stated.unit_quaternion))


def command_rows(arm: ServedArm, commands: Commands, units: Units) -> list[dict[str, Any]]:
    """One row a target, in the units of the request."""
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
        if not arm.turns_only:
            return {"joints": arm.written(values.tolist(), units)}
        return {f"joint_angles_{units}": to_unit(values, units).tolist()}
    servos = arm.compensator.expression.servos
    counts = [] if commands.counts is None else commands.counts[row].tolist()
    if units == "counts":
        shown = zip(arm.joints, counts, strict=True)
        return {"counts": [count if name in servos else None for name, count in shown]}
    ticks = [servos[name][1].tick if name in servos else None for name in arm.joints]
    return {"pulse_us": [None if tick is None else n * tick * 1e6 for tick, n in zip(ticks, counts, strict=True)]}


def _tool(pose: Array) -> dict[str, Any]:
    return {
        "position_mm": (pose[:3, 3] * 1000).tolist(),
        "quaternion_wxyz": [*quaternion_of(pose[:3, :3])],
    }
