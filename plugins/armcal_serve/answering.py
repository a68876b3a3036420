"""From a request to its answer, by one calibration. Whatever is asked, there is an answer and no exception."""

from __future__ import annotations

import difflib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np
from armcal.base.domains import Array
from armcal.base.pose_settings import PoseSettings, quaternion_of
from armcal.base.quaternions import rotation_matrix
from armcal.calibration.compensation.request import Targets
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
    as_bytes,
    known_id,
    refusal,
)
from armcal_serve.reading import parsed, request_of
from armcal_serve.rows import command_rows
from armcal_serve.served_arm import TEMPERATURE, TEMPERATURE_KEY, ServedArm
from armcal_serve.shares import Share, shares

Clock = Callable[[], float]


@dataclass(frozen=True)
class Answerer:
    """Answers by one calibration.

    Attributes:
        arms: by name.
        tag: says which calibration it is, in every answer.
        clock: monotonic seconds, the same in all processes of this machine.
        fault: what is answered to everything; None where the calibration may be used.
    """

    arms: Mapping[str, ServedArm]
    tag: CalibrationTag
    clock: Clock = time.monotonic
    fault: ArmcalError | None = None

    def answer(self, line: bytes, arrived: float) -> bytes:
        """The answer to a line that arrived then (monotonic seconds)."""
        began = self.clock()
        identity = None
        try:
            content = parsed(line)
            identity = known_id(content)
            found: dict[str, Any] = {**self._answered(content)}
        except ArmcalError as fault:
            found = {**refusal(identity, fault)}
        except Exception as fault:  # a request that nobody thought of must not end the server
            hint = "Report it with the request; others are answered as before."
            found = {**refusal(identity, ArmcalError(f"it failed ({type(fault).__name__}: {fault}).", hint=hint))}
        found["calibration"] = self.tag
        found["waited_ms"] = round(1000 * (began - arrived), 3)
        found["took_ms"] = round(1000 * (self.clock() - arrived), 3)
        return as_bytes(found)

    def _answered(self, content: Any) -> Mapping[str, Any]:
        request = request_of(content)
        if self.fault is not None:
            raise self.fault
        if isinstance(request, ForwardRequest):
            return self._forward(request)
        if isinstance(request, CompensateRequest):
            return self._compensate(request)
        raise DataError("a request for the status is short, and without escapes.", hint='Send {"do": "status"}.')

    def _forward(self, request: ForwardRequest) -> ForwardAnswer:
        arm = self._arm(request.arm)
        rows = self._postures(arm, request)
        acting, approach = arm.acting(request, len(rows)), arm.approach(request, len(rows))
        if request.temperature is None:
            poses = arm.compensator.forward(rows, acting, approach.T)
        else:
            told = {TEMPERATURE: request.temperature}
            poses = arm.at_temperature(TEMPERATURE_KEY).forward(rows, acting, approach.T, told)
        return {
            "armcal_serve": VERSION,
            "id": request.id,
            "ok": True,
            "arm": arm.name,
            "tools": [_tool(pose) for pose in poses],
        }

    @staticmethod
    def _postures(arm: ServedArm, request: ForwardRequest) -> Array:
        if (request.joint_angles is None) == (request.joints is None):
            text = "found neither joint_angles nor joints" if request.joints is None else "found both of them"
            hint = f"Give joint_angles_deg: {len(arm.joints)} numbers, or several such rows."
            raise DataError(f"{text}, expected one.", where=Location(field="joint_angles_deg"), hint=hint)
        if request.joint_angles is not None:
            return arm.angles(request.joint_angles, "joint_angles")
        return arm.named(request.joints or (), "joints")

    def _compensate(self, request: CompensateRequest) -> CompensateAnswer:
        arm = self._arm(request.arm)
        if request.units in ("counts", "pulse_us") and not arm.compensator.expression.servos:
            hint = "Ask for rad or deg, or give the arm's joints pulse tables and calibrate again."
            raise DataError("the arm has no pulse tables.", where=Location(field="units"), hint=hint)
        return {
            "armcal_serve": VERSION,
            "id": request.id,
            "ok": True,
            "arm": arm.name,
            "joint_names": [*arm.joints],
            "commands": _commands(arm, request),
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


def _commands(arm: ServedArm, request: CompensateRequest) -> list[Command]:
    """One for each target, in their order."""
    start, rows = _start(arm, request), list[tuple[int, Command]]()
    for share in _shares(arm, request):
        find = share.compensator.follow if request.path else share.compensator.solve
        try:
            commands = find(share.targets, start)
        except ValueError as fault:
            raise _refused(fault) from fault
        rows += zip(share.places, command_rows(arm, commands, request.units, _tool), strict=True)
    return [command for _, command in sorted(rows, key=itemgetter(0))]


def _shares(arm: ServedArm, request: CompensateRequest) -> list[Share]:
    try:
        return shares(arm, request, _targets(arm, request))
    except ValueError as fault:
        raise _refused(fault) from fault


def _refused(fault: ValueError) -> DataError:
    return DataError(f"{fault}.", where=Location(field="targets"), hint="Correct the request.")


def _targets(arm: ServedArm, request: CompensateRequest) -> Targets:
    given = request.targets
    positions = np.array([target.position for target in given])
    turned = [i for i, target in enumerate(given) if target.rpy is not None or target.quaternion_wxyz is not None]
    if turned and len(turned) < len(given):
        odd = next(i for i in range(len(given)) if i not in set(turned))
        raise DataError(
            "found targets with a rotation and targets without, expected all of one kind.",
            where=Location(field=f"targets.{odd}"),
            hint="Ask for them in two requests.",
        )
    rotations = np.array([_rotation(target, i) for i, target in enumerate(given)]) if turned else None
    count = len(given)
    approach = arm.approach(request, count)
    for i, target in enumerate(given):
        if target.approach is not None:
            approach[:, i : i + 1] = arm.approach(target, 1)
    return Targets(positions, rotations, arm.acting(request, count, given), approach)


def _rotation(target: TargetRequest, index: int) -> Array:
    try:
        stated = PoseSettings.si(rpy=target.rpy, quaternion=target.quaternion_wxyz)
    except ValueError as fault:
        message = getattr(fault, "errors", list)()[0]["msg"].removeprefix("Value error, ")
        raise DataError(
            f"{message}.", where=Location(field=f"targets.{index}"), hint="Give rpy_deg or quaternion_wxyz."
        ) from fault
    return rotation_matrix(np.array(stated.unit_quaternion))


def _start(arm: ServedArm, request: CompensateRequest) -> Array | None:
    if request.start is not None and request.start_joints is not None:
        raise DataError("found both start and start_joints.", where=Location(field="start"), hint="Give one of them.")
    if request.start is not None:
        return np.asarray(arm.angles([request.start], "start")[0])
    if request.start_joints is not None:
        return np.asarray(arm.named([request.start_joints], "start_joints")[0])
    return None


def _tool(pose: Array) -> Tool:
    return {
        "position_mm": (pose[:3, 3] * 1000).tolist(),
        "quaternion_wxyz": [*quaternion_of(pose[:3, :3])],
    }
