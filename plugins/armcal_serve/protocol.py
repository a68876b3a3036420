"""Requests to `armcal serve`, version 1: a JSON object a line, with the units in the keys; read and checked."""

import difflib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, NoReturn, Self

from armcal.base.settings import Acceleration3, Angle, Angle3, Force3, Length3, Mass, Settings, Temperature, Torque3
from armcal.config.validate import validate
from armcal.config.yaml_source import ConfigSource
from armcal.errors import ArmcalError, DataError, InputError, Location
from pydantic import Field

VERSION = 1
MAX_LINE_BYTES = 256 * 1024  # A longer request is refused, and thrown away while it comes
MAX_ROWS = 1000  # So many targets or postures may stand in one request
_MAX_ID = 200
_ABSOLUTE_ZERO_C = -273.15
_EXAMPLE = '{"id": 1, "do": "status"}'

Approach = Annotated[int, Field(ge=-1, le=1)]
Units = Literal["rad", "deg", "pulse_us", "counts"]


class Loads(Settings):
    """The loads on the arm; the calibration states what is left out."""

    payload: Annotated[Mass, Field(ge=0)] | None = None  # at the tool (kg)
    payload_com: Length3 | None = None  # its centre of mass, in the tool's frame (m)
    gravity: Acceleration3 | None = None  # in the base frame (m/s^2)
    force: Force3 | None = None  # on the tool, in the base frame (N)
    torque: Torque3 | None = None  # N m
    temperature: Annotated[Temperature, Field(ge=_ABSOLUTE_ZERO_C)] | None = None  # of an arm that changes with it
    # From where joints come, by name or in the arm's order: -1, 0 (not known), 1.
    approach: tuple[Approach, ...] | dict[str, Approach] | None = None


class Request(Settings):
    """The fields of every request."""

    armcal_serve: Literal[1] = 1  # the version of this protocol that the client speaks
    id: Annotated[str, Field(max_length=_MAX_ID)] | int | float | None = None  # handed back with the answer
    do: Literal["forward", "compensate", "status"]


class ForwardRequest(Request, Loads):
    """Where the tool is at commands."""

    arm: str | None = None  # which, where the calibration has several
    joint_angles: tuple[tuple[Angle, ...], ...] = ()  # of postures (rad), for an arm without prismatic joints
    joints: tuple[dict[str, float], ...] = ()  # the same by name with the unit: {"q1_deg": 10, "slide_mm": 5}


class TargetRequest(Loads):
    """Where the tool shall be; without a rotation any will do."""

    position: Length3  # of the tool's origin in the base frame (m)
    rpy: Angle3 | None = None  # roll, pitch, yaw about the fixed axes x, y, z (rad): Rz(yaw) Ry(pitch) Rx(roll)
    quaternion_wxyz: tuple[float, float, float, float] | None = None  # in place of ``rpy``


class CompensateRequest(Request, Loads):
    """Commands that bring the tool to targets; loads are stated here for all targets, or in a target for itself."""

    arm: str | None = None  # which, where the calibration has several
    targets: tuple[TargetRequest, ...]
    start: tuple[Angle, ...] | None = None  # where the arm comes from (rad), for an arm without prismatic joints
    start_joints: dict[str, float] | None = None  # the same by name with the unit
    path: bool = False  # whether targets are followed in order; otherwise each is reached from ``start``
    units: Units = "rad"  # of the commands in the answer


_KINDS: Mapping[str, type[Request]] = MappingProxyType(
    {"forward": ForwardRequest, "compensate": CompensateRequest, "status": Request}
)
_ROWS = {"forward": ("joint_angles", "joints"), "compensate": ("targets",), "status": ()}  # keys of postures or targets


@dataclass(frozen=True)
class RawRequest:
    """A request whose rows, its postures or targets, are checked some at a time."""

    do: str
    fields: dict[str, Any]
    key: str  # of the rows, as the request has it; empty where it has none
    rows: list[Any]

    @classmethod
    def of(cls, fields: Any) -> Self:
        if not isinstance(fields, dict):
            raise DataError(f"found {_short(fields)}, expected an object.", hint=f"Send an object such as {_EXAMPLE}.")
        do = fields.get("do")
        if not isinstance(do, str) or do not in _KINDS:
            near = difflib.get_close_matches(do, _KINDS, n=1) if isinstance(do, str) else []
            text = f"found {_short(do)}" if "do" in fields else "found nothing"
            hint = f"Did you mean {near[0]}?" if near else f"For example {_EXAMPLE}."
            raise DataError(f"{text}, expected one of {', '.join(_KINDS)}.", where=Location(field="do"), hint=hint)
        version = fields.get("armcal_serve", VERSION)
        if version != VERSION:
            where, hint = Location(field="armcal_serve"), "Leave it out, or say 1."
            raise DataError(f"found version {_short(version)}, expected {VERSION}.", where=where, hint=hint)
        keys = [key for key in fields if key.startswith(_ROWS[do])]
        if len(keys) > 1:
            hint = "Give one of them."
            raise DataError(f"found {' and '.join(keys)}.", where=Location(field=keys[0]), hint=hint)
        rows = fields[keys[0]] if keys else []
        if isinstance(rows, dict) or (isinstance(rows, list) and rows and not isinstance(rows[0], list | dict)):
            rows = [rows]
        if keys and isinstance(rows, list) and not 0 < len(rows) <= MAX_ROWS:
            text = f"found {len(rows)} of them, expected 1 to {MAX_ROWS} in a request."
            raise DataError(text, where=Location(field=keys[0]), hint="Ask in several requests.")
        return cls(do, fields, keys[0] if keys else "", rows if isinstance(rows, list) else [rows])

    def checked(self, some: range) -> Any:
        """The request with some of its rows, of the class of its kind."""
        fields = {**self.fields, self.key: self.rows[some.start : some.stop]} if self.key else self.fields
        kind = _KINDS[self.do]
        try:
            return kind.model_validate(fields)
        except ValueError:
            pass
        try:  # the same check says what is wrong in the words of a configuration
            validate(kind, ConfigSource(fields, {(): Location()}, Path(), Path(), ()))
        except InputError as fault:
            field = (fault.where and fault.where.field) or ""
            if field.startswith(_ROWS[self.do]):
                fault.where = Location(
                    field=re.sub(r"\d+", lambda place: f"{int(place[0]) + some.start}", field, count=1)
                )
            raise
        except Exception as fault:  # not even that is possible
            hint = "Send what docs/serve.md shows."
            raise DataError(f"the request is refused ({type(fault).__name__}).", hint=hint) from fault
        raise DataError("the request is refused.", hint="Send what docs/serve.md shows.")


def parsed(line: bytes) -> Any:
    """The JSON in a line."""
    try:
        return json.loads(line.decode("utf-8-sig"), parse_constant=_not_finite)
    except UnicodeDecodeError as fault:
        message = f"the request holds the byte 0x{line[fault.start]:02x}, which is not UTF-8 text."
        raise DataError(message, hint="Send UTF-8.") from fault
    except RecursionError as fault:
        raise DataError("the request is nested too deeply.", hint=f"Send an object such as {_EXAMPLE}.") from fault
    except ValueError as fault:
        text = f"the request is not JSON ({str(fault)[:80]})."
        raise DataError(text, hint=f"Send an object a line, such as {_EXAMPLE}.") from fault


def refusal(identity: Any, fault: ArmcalError) -> dict[str, Any]:
    return {
        "armcal_serve": VERSION,
        "id": identity,
        "ok": False,
        "error": fault.message,
        "hint": fault.hint,
        "where": str(fault.where or ""),
    }


def known_id(content: Any) -> str | int | float | None:
    """The id in a request's content, if it has one that may be handed back."""
    identity = content.get("id") if isinstance(content, dict) else None
    if isinstance(identity, bool) or not isinstance(identity, str | int | float):
        return None
    return identity if not isinstance(identity, str) or len(identity) <= _MAX_ID else None


def _not_finite(word: str) -> NoReturn:
    raise ValueError(f"{word} is no number")


def _short(content: Any) -> str:
    text = json.dumps(content)
    return text if len(text) <= 80 else f"{text[:77]}..."
