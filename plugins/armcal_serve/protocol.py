"""Requests to `armcal serve`, version 1: a JSON object a line, with the units in the keys; read and checked."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, Self

from armcal.base.settings import Acceleration3, Angle, Angle3, Force3, Length3, Mass, Settings, Temperature, Torque3
from armcal.config.validate import validate
from armcal.config.yaml_source import ConfigSource
from armcal.errors import ArmcalError, DataError, InputError, Location
from pydantic import Field, model_validator

VERSION = 1
MAX_LINE_BYTES = 256 * 1024  # A longer request is refused, and thrown away while it comes
MAX_ROWS = 1000  # So many targets or postures may stand in one request
_ABSOLUTE_ZERO_C = -273.15
_EXAMPLE = 'Send an object a line, such as {"id": 1, "do": "status"}.'

Approach = Annotated[int, Field(ge=-1, le=1)]
Units = Literal["rad", "deg", "pulse_us", "counts"]


class Request(Settings):
    """The fields of every request."""

    armcal_serve: Literal[1] = 1  # the version of this protocol that the client speaks
    id: str | int | float | None = None  # returned with the answer
    do: Literal["forward", "compensate", "status"]


class ArmRequest(Request):
    """Of an arm, and the loads on it in all rows of the request; the calibration states what is omitted."""

    arm: str | None = None  # which, where the calibration has several
    payload: Annotated[Mass, Field(ge=0)] | None = None  # at the tool (kg)
    payload_com: Length3 | None = None  # its centre of mass, in the tool's frame (m)
    gravity: Acceleration3 | None = None  # in the base frame (m/s^2)
    force: Force3 | None = None  # on the tool, in the base frame (N)
    torque: Torque3 | None = None  # N m
    temperature: Annotated[Temperature, Field(ge=_ABSOLUTE_ZERO_C)] | None = None  # of an arm that changes with it
    # From where joints come, by name or in the arm's order: -1, 0 (not known), 1.
    approach: tuple[Approach, ...] | dict[str, Approach] | None = None


class ForwardRequest(ArmRequest):
    """Where the tool is at commands."""

    joint_angles: tuple[tuple[Angle, ...], ...] = ()  # of postures (rad), for an arm without prismatic joints
    joints: tuple[dict[str, float], ...] = ()  # the same by name with the unit: {"q1_deg": 10, "slide_mm": 5}

    @model_validator(mode="after")
    def _one_of_them(self) -> Self:
        if bool(self.joint_angles) == bool(self.joints):
            raise ValueError("expected either joint_angles_deg or joints: a posture, or several")
        return self


class TargetRequest(Settings):
    """Where the tool shall be; without a rotation any will do."""

    position: Length3  # of the tool's origin in the base frame (m)
    rpy: Angle3 | None = None  # roll, pitch, yaw about the fixed axes x, y, z (rad): Rz(yaw) Ry(pitch) Rx(roll)
    quaternion_wxyz: tuple[float, float, float, float] | None = None  # in place of ``rpy``

    @property
    def has_rotation(self) -> bool:
        return self.rpy is not None or self.quaternion_wxyz is not None


class CompensateRequest(ArmRequest):
    """Commands that bring the tool to targets."""

    targets: tuple[TargetRequest, ...]
    start: tuple[Angle, ...] | None = None  # where the arm comes from (rad), for an arm without prismatic joints
    start_joints: dict[str, float] | None = None  # the same by name with the unit
    path: bool = False  # whether targets are followed in order; otherwise each is reached from ``start``
    units: Units = "rad"  # of the commands in the answer

    @model_validator(mode="after")
    def _one_start(self) -> Self:
        if self.start is not None and self.start_joints is not None:
            raise ValueError("found both start and start_joints, expected one of them")
        return self


# By what is to be done: the class of such a request, and the keys of its rows.
_KINDS: Mapping[str, tuple[type[Request], tuple[str, ...]]] = MappingProxyType(
    {
        "forward": (ForwardRequest, ("joint_angles", "joints")),
        "compensate": (CompensateRequest, ("targets",)),
        "status": (Request, ()),
    }
)


@dataclass(frozen=True)
class RawRequest:
    """A request whose rows, its postures or targets, are checked some at a time."""

    fields: dict[str, Any]
    kind: type[Request]
    key: str  # of the rows, as the request has it; empty where it has none
    rows: list[Any]

    @classmethod
    def of(cls, fields: Any) -> Self:
        if not isinstance(fields, dict):
            raise DataError("the request is JSON, but no object.", hint=_EXAMPLE)
        do = str(fields.get("do"))
        if do not in _KINDS:
            text = f"found {f'{do!r:.60}' if 'do' in fields else 'nothing'}, expected one of {', '.join(_KINDS)}."
            raise DataError(text, where=Location(field="do"), hint=_EXAMPLE)
        kind, keys = _KINDS[do]
        key = next((key for key in fields if key.startswith(keys)), "")
        rows = fields.get(key, [])
        if not isinstance(rows, list) or (rows and not isinstance(rows[0], list | dict)):
            rows = [rows]
        if key and not 0 < len(rows) <= MAX_ROWS:
            text = f"found {len(rows)} of them, expected 1 to {MAX_ROWS} in a request."
            raise DataError(text, where=Location(field=key), hint="Ask in several requests.")
        return cls(fields, kind, key, rows)

    def checked(self, some: range) -> Any:
        """The request with some of its rows, of the class of its kind."""
        fields = {**self.fields, self.key: self.rows[some.start : some.stop]} if self.key else self.fields
        try:  # refused in the words of a configuration
            return validate(self.kind, ConfigSource(fields, {(): Location()}, Path(), Path(), ()))
        except InputError as fault:
            field = (fault.where and fault.where.field) or ""
            if field.startswith(self.key):
                field = re.sub(r"\d+", lambda place: f"{int(place[0]) + some.start}", field, count=1)
                fault.where = Location(field=field)
            raise


def parsed(line: bytes) -> Any:
    try:
        return json.loads(line)
    except (ValueError, RecursionError) as fault:
        raise DataError(f"the request is not JSON ({fault}).", hint=_EXAMPLE) from fault


def refusal(identity: Any, fault: ArmcalError) -> dict[str, Any]:
    return {
        "armcal_serve": VERSION,
        "id": identity,
        "ok": False,
        "error": fault.message,
        "hint": fault.hint,
        "where": str(fault.where or ""),
    }
