"""Requests to `armcal serve`, version 1: a JSON object a line, with the units in the keys; read and checked."""

import difflib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, NoReturn

from armcal.base.settings import Acceleration3, Angle, Angle3, Force3, Length3, Mass, Settings, Temperature, Torque3
from armcal.config.validate import validate
from armcal.config.yaml_source import ConfigSource
from armcal.errors import ArmcalError, DataError, InputError, Location
from pydantic import Field, field_validator

VERSION = 1
MAX_LINE_BYTES = 256 * 1024  # A longer request is refused, and thrown away while it comes
MAX_ROWS = 1000  # So many targets or postures may stand in one request
_AT_ONCE = 32  # of them are checked
_MAX_ID = 200
_ABSOLUTE_ZERO_C = -273.15
_EXAMPLE = '{"id": 1, "do": "status"}'

Approach = Annotated[int, Field(ge=-1, le=1)]
Joints = tuple[Angle, ...] | dict[str, Angle]  # Of one posture: in the arm's order, or by name
Units = Literal["rad", "deg", "pulse_us", "counts"]


def _rows(value: Any) -> Any:
    """One posture, or one target, is a list of one."""
    if isinstance(value, dict) or (isinstance(value, list) and value and not isinstance(value[0], list | dict)):
        return [value]
    if isinstance(value, list) and not 0 < len(value) <= MAX_ROWS:
        raise ValueError(f"found {len(value)} of them, expected 1 to {MAX_ROWS} in a request")
    return value


class Acting(Settings):
    """What acts on the arm; the calibration states what is left out."""

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


class ForwardRequest(Request, Acting):
    """Where the tool is at commands."""

    arm: str | None = None  # which, where the calibration has several
    joint_angles: tuple[Joints, ...] | None = None  # of one posture or several (rad), for an arm without sliding joints
    joints: tuple[dict[str, float], ...] | None = None  # the same by name with the unit: {"q1_deg": 10, "slide_mm": 5}

    _one_posture = field_validator("joint_angles", "joints", mode="before")(_rows)


class TargetRequest(Acting):
    """Where the tool shall be; without a rotation any will do."""

    position: Length3  # of the tool's origin in the base frame (m)
    rpy: Angle3 | None = None  # roll, pitch, yaw about the fixed axes x, y, z (rad): Rz(yaw) Ry(pitch) Rx(roll)
    quaternion_wxyz: tuple[float, float, float, float] | None = None  # in place of ``rpy``


class CompensateRequest(Request, Acting):
    """Commands that bring the tool to targets; what acts is stated here for all targets, or in a target for itself."""

    arm: str | None = None  # which, where the calibration has several
    targets: tuple[TargetRequest, ...]  # one or several
    start: Joints | None = None  # where the arm comes from (rad), for an arm without sliding joints
    start_joints: dict[str, float] | None = None  # the same by name with the unit
    path: bool = False  # whether targets are followed in order; otherwise each is reached from ``start``
    units: Units = "rad"  # of the commands in the answer

    _one_target = field_validator("targets", mode="before")(_rows)


REQUESTS: Mapping[str, type[Request]] = MappingProxyType(
    {"forward": ForwardRequest, "compensate": CompensateRequest, "status": Request}
)


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
        text = f"the request is not JSON ({_short(str(fault))})."
        raise DataError(text, hint=f"Send an object a line, such as {_EXAMPLE}.") from fault


def request_of(fields: Any) -> Iterator[Request | None]:
    """A request, checked; None after each slice of its rows before that."""
    words = ", ".join(REQUESTS)
    if not isinstance(fields, dict):
        short = _short(json.dumps(fields))
        raise DataError(f"found {short}, expected an object.", hint=f"Send an object such as {_EXAMPLE}.")
    word = fields.get("do")
    if not isinstance(word, str) or word not in REQUESTS:
        near = difflib.get_close_matches(word, REQUESTS, n=1) if isinstance(word, str) else []
        short = f"found {_short(json.dumps(word))}" if "do" in fields else "found nothing"
        hint = f"Did you mean {near[0]}?" if near else f"For example {_EXAMPLE}."
        raise DataError(f"{short}, expected one of {words}.", where=Location(field="do"), hint=hint)
    if fields.get("armcal_serve", VERSION) != VERSION:
        short = _short(json.dumps(fields["armcal_serve"]))
        where = Location(field="armcal_serve")
        raise DataError(f"found version {short}, expected {VERSION}.", where=where, hint="Leave it out, or say 1.")
    kind = REQUESTS[word]
    key = next((key for key in fields if key.startswith(("targets", "joint_angles", "joints"))), "")
    rows = fields.get(key)
    if not (isinstance(rows, list) and _AT_ONCE < len(rows) <= MAX_ROWS and isinstance(rows[0], list | dict)):
        yield _checked(kind, fields)
        return
    checked: list[Any] = []
    for start in range(0, len(rows), _AT_ONCE):
        some = rows[start : start + _AT_ONCE]
        try:
            request = kind.model_validate({**fields, key: some})
        except ValueError:
            for place, row in enumerate(some, start):
                _checked(kind, {**fields, key: [row]}, place)
            request = _checked(kind, {**fields, key: some})
        name = max((name for name in type(request).model_fields if key.startswith(name)), key=len)
        checked += getattr(request, name)
        yield None
    yield request.model_copy(update={name: tuple(checked)})


def _checked(kind: type[Request], fields: dict[str, Any], place: int | None = None) -> Request:
    """A request; ``place`` is that of its only row among others, for the message."""
    try:
        return kind.model_validate(fields)
    except ValueError:
        pass
    try:  # the same check says what is wrong in the words of a configuration
        validate(kind, ConfigSource(fields, {(): Location()}, Path(), Path(), ()))
    except InputError as fault:
        if place is not None and fault.where is not None and fault.where.field:
            fault.where = Location(field=fault.where.field.replace(".0", f".{place}", 1))
        raise
    except Exception as fault:  # not even that is possible
        hint = "Send what docs/serve.md shows."
        raise DataError(f"the request is refused ({type(fault).__name__}).", hint=hint) from fault
    raise DataError("the request is refused.", hint="Send what docs/serve.md shows.")


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


def _short(text: str) -> str:
    return text if len(text) <= 80 else f"{text[:77]}..."
