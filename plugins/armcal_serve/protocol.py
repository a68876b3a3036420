"""Requests to `armcal serve` and its answers, version 1: a JSON object each, with the units in the keys."""

import json
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Annotated, Any, Literal, NotRequired

from armcal.base.config_text import as_line
from armcal.base.settings import Acceleration3, Angle, Angle3, Force3, Length3, Mass, Settings, Temperature, Torque3
from armcal.errors import ArmcalError
from pydantic import Field, field_validator
from typing_extensions import TypedDict  # pydantic checks no other before Python 3.12

VERSION = 1
MAX_LINE_BYTES = 256 * 1024  # A longer request is refused, and thrown away while it comes
MAX_ROWS = 1000  # So many targets or postures may stand in one request
_MAX_ID = 200
_ABSOLUTE_ZERO_C = -273.15

Approach = Annotated[int, Field(ge=-1, le=1)]
Joints = tuple[Angle, ...] | dict[str, Angle]  # Of one posture: in the arm's order, or by name
Units = Literal["rad", "deg", "pulse_us", "counts"]
Word = Literal["forward", "compensate", "status"]


def _rows(value: Any) -> Any:
    """One posture, or one target, is a list of one.

    Raises:
        ValueError: there are none, or too many.
    """
    if isinstance(value, dict) or (isinstance(value, list) and value and not isinstance(value[0], list | dict)):
        return [value]
    if isinstance(value, list) and not 0 < len(value) <= MAX_ROWS:
        raise ValueError(f"found {len(value)} of them, expected 1 to {MAX_ROWS} in a request")
    return value


class Acting(Settings):
    """What acts on the arm; the calibration states what is left out.

    Attributes:
        force, torque: on the tool, in the base frame (N, N m).
        temperature: of the arm (C), where it changes with that.
        approach: from where joints come, by name or in the arm's order: -1, 0 (not known), 1.
    """

    payload: Annotated[Mass, Field(ge=0)] | None = None  # at the tool (kg)
    payload_com: Length3 | None = None  # its centre of mass, in the tool's frame (m)
    gravity: Acceleration3 | None = None  # in the base frame (m/s^2)
    force: Force3 | None = None
    torque: Torque3 | None = None
    temperature: Annotated[Temperature, Field(ge=_ABSOLUTE_ZERO_C)] | None = None
    approach: tuple[Approach, ...] | dict[str, Approach] | None = None


class Request(Settings):
    """The fields of every request."""

    armcal_serve: Literal[1] = 1  # the version of this protocol that the client speaks
    id: Annotated[str, Field(max_length=_MAX_ID)] | int | float | None = None  # handed back with the answer
    do: Word  # the kind of request


class StatusRequest(Request):
    """How the server is doing."""

    do: Literal["status"]


class ForwardRequest(Request, Acting):
    """Where the tool is at commands.

    Attributes:
        joints: of one posture or several, by name with the unit: ``{"q1_deg": 10, "slide_mm": 5}``.
    """

    do: Literal["forward"]
    arm: str | None = None  # which, where the calibration has several
    joint_angles: tuple[Joints, ...] | None = None  # of one posture or several (rad), for an arm without sliding joints
    joints: tuple[dict[str, float], ...] | None = None

    _one_posture = field_validator("joint_angles", "joints", mode="before")(_rows)


class TargetRequest(Acting):
    """Where the tool shall be.

    Attributes:
        rpy: its rotation as roll, pitch, yaw about the fixed axes x, y, z (rad): Rz(yaw) Ry(pitch) Rx(roll).
        quaternion_wxyz: its rotation as a unit quaternion, in place of ``rpy``; without either, any rotation will do.
    """

    position: Length3  # of the tool's origin in the base frame (m)
    rpy: Angle3 | None = None
    quaternion_wxyz: tuple[float, float, float, float] | None = None


class CompensateRequest(Request, Acting):
    """Commands that bring the tool to targets; what acts is stated here for all targets, or in a target for itself.

    Attributes:
        path: whether the targets are a path, to be followed in order; otherwise each is reached from ``start``.
    """

    do: Literal["compensate"]
    arm: str | None = None  # which, where the calibration has several
    targets: tuple[TargetRequest, ...]  # one or several
    start: Joints | None = None  # where the arm comes from (rad), for an arm without sliding joints
    start_joints: dict[str, float] | None = None  # the same by name with the unit
    path: bool = False
    units: Units = "rad"  # of the commands in the answer

    _one_target = field_validator("targets", mode="before")(_rows)


REQUESTS: Mapping[str, type[Request]] = MappingProxyType(
    {"forward": ForwardRequest, "compensate": CompensateRequest, "status": StatusRequest}
)


class CalibrationTag(TypedDict):
    """Which calibration an answer came from."""

    sequence: int  # 1 for the one that the server began with, one more for each later one
    created: str  # when it was made
    sha256: str  # of its file
    arm: str  # the identity of the arm's description, the same as long as it is the same arm
    recalibrated: int | None  # the recalibration's last record in it; null where there was none
    level: str | None  # the recalibration's: nominal, watch, suspect or lost; null where there was none


class Tool(TypedDict):
    """A pose of the tool in the base frame."""

    position_mm: list[float]
    quaternion_wxyz: list[float]


class Answer(TypedDict):
    """The fields of every answer.

    Attributes:
        waited_ms, took_ms: from the request's arrival until it was begun, and until it was answered.
    """

    armcal_serve: int
    id: str | int | float | None  # the request's; null where it could not be read
    ok: bool  # whether it was answered; if not, ``error`` says why not and ``hint`` what to do
    calibration: NotRequired[CalibrationTag]  # that it was answered from
    waited_ms: NotRequired[float]
    took_ms: NotRequired[float]


class Refusal(Answer):
    """The answer to a request that is refused or failed; ``where`` is the field."""

    error: str
    hint: str
    where: str


class PoseAnswer(Answer):
    """The fields of answers with poses, which may lie where nothing tested how far off predictions are.

    Attributes:
        beyond_records: places (from 0) of the tools or commands that lie beyond the calibration's records; null where
            the calibration keeps no ranges of them.
    """

    arm: str  # which one
    beyond_records: list[int] | None
    warning: str  # a sentence about those, with joint or payload, the farthest value and the recorded ones; else empty


class ForwardAnswer(PoseAnswer):
    """Where the tool is, by posture."""

    tools: list[Tool]


class Command(TypedDict):
    """The command for one target, in the units of the request and in the order of ``joint_names``.

    Attributes:
        joint_angles_rad, joint_angles_deg: the commands; of an arm with sliding joints ``joints`` in their place, by
            name with the unit.
        counts, pulse_us: for the servo board; null for a joint without a pulse table.
        reached: whether the target is reached; ``why_not`` says why not, and the command is the nearest that was found.
        error_mm, error_deg: what remains.
    """

    joint_angles_rad: NotRequired[list[float]]
    joint_angles_deg: NotRequired[list[float]]
    joints: NotRequired[dict[str, float]]
    counts: NotRequired[list[int | None]]
    pulse_us: NotRequired[list[float | None]]
    reached: bool
    why_not: str
    error_mm: float
    error_deg: float
    nearest_mm: float  # no command comes nearer than this, as far as is known
    approach: list[int]  # the assumed side from which each joint comes: -1, 0 (not known), 1
    tool: Tool  # its predicted pose


class CompensateAnswer(PoseAnswer):
    """What to command, by target."""

    joint_names: list[str]
    commands: list[Command]


def refusal(identity: Any, fault: ArmcalError) -> Refusal:
    return {
        "armcal_serve": VERSION,
        "id": identity,
        "ok": False,
        "error": fault.message,
        "hint": fault.hint,
        "where": str(fault.where or ""),
    }


def id_of(line: bytes) -> str | int | float | None:
    """The id in a request that no worker answered; None where it cannot be read."""
    try:
        return known_id(json.loads(line.decode("utf-8-sig")))
    except (ValueError, RecursionError):
        return None


def known_id(content: Any) -> str | int | float | None:
    """The id in a request's content, if it has one that may be handed back."""
    identity = content.get("id") if isinstance(content, dict) else None
    if isinstance(identity, bool) or not isinstance(identity, str | int | float):
        return None
    return identity if not isinstance(identity, str) or len(identity) <= _MAX_ID else None


def as_bytes(answer: Mapping[str, Any]) -> bytes:
    return as_line(answer).encode()


Notify = Callable[[str, str, Mapping[str, Any]], None]
"""Takes an event's name, a sentence and its fields, for the program that started the server."""
