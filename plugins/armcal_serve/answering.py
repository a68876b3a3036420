"""From a request to its answer, by one calibration. Every request has an answer; none raises."""

import difflib
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from armcal.base.arrays import Array
from armcal.base.poses import PoseSettings
from armcal.base.quaternions import quaternion_of, rotation_matrix
from armcal.base.units import to_unit
from armcal.calibration.compensation.compensator import Compensator
from armcal.calibration.compensation.request import Commands, Targets
from armcal.errors import ArmcalError, DataError, Location

from armcal_serve.protocol import (
    VERSION,
    CalibrationTag,
    Command,
    CompensateAnswer,
    CompensateRequest,
    ForwardAnswer,
    ForwardRequest,
    TargetRequest,
    Tool,
    Units,
    as_bytes,
    known_id,
    refusal,
)
from armcal_serve.reading import parsed, request_of
from armcal_serve.served_arm import TEMPERATURE, TEMPERATURE_KEY, ServedArm


@dataclass(frozen=True)
class Answerer:
    """Answers by one calibration."""

    arms: Mapping[str, ServedArm]  # by name
    tag: CalibrationTag  # identifies the calibration in every answer
    fault: ArmcalError | None = None  # the answer to every request; None where the calibration may be used

    def answer(self, line: bytes, arrived: float) -> bytes:
        """The answer to a line that arrived then (monotonic seconds)."""
        began = time.monotonic()  # the same clock in all processes of a machine
        identity = None
        try:
            fields = parsed(line)
            identity = known_id(fields)
            request = request_of(fields)
            if self.fault is not None:
                raise self.fault
            if isinstance(request, ForwardRequest):
                answer: dict[str, Any] = {**self._forward(request)}
            elif isinstance(request, CompensateRequest):
                answer = {**self._compensate(request)}
            else:
                text = "a request for the status is short, and without escapes."
                raise DataError(text, hint='Send {"do": "status"}.')
        except ArmcalError as fault:
            answer = {**refusal(identity, fault)}
        except Exception as fault:  # a request that nobody thought of must not end the server
            hint = "Report it with the request; others are answered as before."
            answer = {**refusal(identity, ArmcalError(f"it failed ({type(fault).__name__}: {fault}).", hint=hint))}
        answer["calibration"] = self.tag
        answer["waited_ms"] = round(1000 * (began - arrived), 3)
        answer["took_ms"] = round(1000 * (time.monotonic() - arrived), 3)
        return as_bytes(answer)

    def _forward(self, request: ForwardRequest) -> ForwardAnswer:
        arm = self._arm(request.arm)
        if (request.joint_angles is None) == (request.joints is None):
            text = "found neither joint_angles nor joints" if request.joints is None else "found both of them"
            hint = f"Give joint_angles_deg: {len(arm.joints)} numbers, or several such rows."
            raise DataError(f"{text}, expected one.", where=Location(field="joint_angles_deg"), hint=hint)
        if request.joint_angles is not None:
            rows = arm.angles(request.joint_angles, "joint_angles")
        else:
            rows = arm.named(request.joints or (), "joints")
        acting, approach = arm.acting(request, len(rows)), arm.approach(request, len(rows))
        if request.temperature is None:
            poses = arm.compensator.forward(rows, acting, approach.T)
        else:
            conditions = {TEMPERATURE: request.temperature}
            poses = arm.at_temperature(TEMPERATURE_KEY).forward(rows, acting, approach.T, conditions)
        beyond, warning = arm.beyond_records(rows, acting)
        return {
            "armcal_serve": VERSION,
            "id": request.id,
            "ok": True,
            "arm": arm.name,
            "tools": [_tool(pose) for pose in poses],
            "beyond_records": beyond,
            "warning": warning,
        }

    def _compensate(self, request: CompensateRequest) -> CompensateAnswer:
        arm = self._arm(request.arm)
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
        targets = _targets(arm, request)
        solved: list[tuple[Sequence[int], Commands]] = []
        try:
            for compensator, share, places in shares(arm, request, targets):
                find = compensator.follow if request.path else compensator.solve
                solved.append((places, find(share, start)))
        except ValueError as fault:
            raise DataError(f"{fault}.", where=Location(field="targets"), hint="Correct the request.") from fault
        angles = np.empty((len(targets), len(arm.joints)))
        for places, commands in solved:
            angles[places] = commands.joint_angles
        beyond, warning = arm.beyond_records(angles, targets.acting)
        rows = {
            place: row
            for places, commands in solved
            for place, row in zip(places, command_rows(arm, commands, request.units), strict=True)
        }
        return {
            "armcal_serve": VERSION,
            "id": request.id,
            "ok": True,
            "arm": arm.name,
            "joint_names": [*arm.joints],
            "commands": [rows[place] for place in sorted(rows)],
            "beyond_records": beyond,
            "warning": warning,
        }

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


def shares(
    arm: ServedArm, request: CompensateRequest, targets: Targets
) -> list[tuple[Compensator, Targets, Sequence[int]]]:
    """All targets to one compensator; to two where some targets state the temperature and others do not.

    Returns:
        compensators, each with its targets and their places in the request.

    Raises:
        DataError: the arm does not change with the temperature; or some targets of a path state it and others do not.
    """
    stated = [request.temperature if target.temperature is None else target.temperature for target in request.targets]
    warm = [place for place, value in enumerate(stated) if value is not None]
    if not warm:
        return [(arm.compensator, targets, range(len(stated)))]
    field = TEMPERATURE_KEY if request.temperature is not None else f"targets.{warm[0]}.{TEMPERATURE_KEY}"
    heated = arm.at_temperature(field)
    rest = [place for place, value in enumerate(stated) if value is None]
    if rest and request.path:
        raise DataError(
            "found targets of a path with a temperature and targets without, expected all of one kind.",
            where=Location(field=f"targets.{rest[0]}"),
            hint=f"Give {TEMPERATURE_KEY} for all of the request, or for each target.",
        )
    temperatures = np.array([stated[place] for place in warm], dtype=float)
    known = replace(targets.subset(np.array(warm)), conditions={TEMPERATURE: temperatures})
    unheated = [(arm.compensator, targets.subset(np.array(rest)), rest)] if rest else []
    return [(heated, known, warm), *unheated]


def _targets(arm: ServedArm, request: CompensateRequest) -> Targets:
    targets = request.targets
    positions = np.array([target.position for target in targets])
    turned = [i for i, target in enumerate(targets) if target.rpy is not None or target.quaternion_wxyz is not None]
    if turned and len(turned) < len(targets):
        odd = next(i for i in range(len(targets)) if i not in set(turned))
        raise DataError(
            "found targets with a rotation and targets without, expected all of one kind.",
            where=Location(field=f"targets.{odd}"),
            hint="Ask for them in two requests.",
        )
    rotations, count = None, len(targets)
    if turned:
        rotations = np.array([_rotation(target, i) for i, target in enumerate(targets)])
    approach = arm.approach(request, count)
    for i, target in enumerate(targets):
        if target.approach is not None:
            approach[:, i : i + 1] = arm.approach(target, 1)
    acting, farthest = arm.acting(request, count, targets), 1000 * arm.compensator.reach.farthest
    try:
        return Targets(positions, rotations, acting, approach)
    except ValueError as fault:
        reach = f"; this arm reaches {farthest:.0f} mm from its mount at most" if math.isfinite(farthest) else ""
        hint = f"Give places of the base frame in mm (position_mm){reach}."
        raise DataError(f"{fault}.", where=Location(field="targets"), hint=hint) from fault


def _rotation(target: TargetRequest, index: int) -> Array:
    try:
        stated = PoseSettings.si(rpy=target.rpy, quaternion=target.quaternion_wxyz)
    except ValueError as fault:
        message = getattr(fault, "errors", list)()[0]["msg"].removeprefix("Value error, ")
        raise DataError(
            f"{message}.", where=Location(field=f"targets.{index}"), hint="Give rpy_deg or quaternion_wxyz."
        ) from fault
    return rotation_matrix(np.array(stated.unit_quaternion))


def command_rows(arm: ServedArm, commands: Commands, units: Units) -> list[Command]:
    """One row a target, in the units of the request."""
    return [
        {
            **_commanded(arm, commands, i, units),  # type: ignore[typeddict-item]
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
    """What to command for one target."""
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


def _tool(pose: Array) -> Tool:
    return {
        "position_mm": (pose[:3, 3] * 1000).tolist(),
        "quaternion_wxyz": [*quaternion_of(pose[:3, :3])],
    }
