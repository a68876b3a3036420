"""What may be asked of a running recalibration, and what it answers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from armcal.base.units import from_unit
from armcal.errors import InputError, Location
from armcal.measure.column_match import spellings
from armcal.measure.reader import ReadRequest

from armcal_online.running.loop import Recalibration


class Predicting(Protocol):
    """What is asked of a recalibrator here."""

    @property
    def request(self) -> ReadRequest:
        """What its records may hold."""

    def what_if(self, joints: Mapping[str, float]) -> dict[str, Any]:
        """What it would do at joint angles, by channel (SI)."""


class Requests:
    """Answers requests; commands act at once."""

    def __init__(self, recalibration: Recalibration, session: Predicting) -> None:
        self._recalibration = recalibration
        self._session = session

    def answer(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """The reply to one of the known commands.

        Raises:
            ArmcalError: what is asked for cannot be done.
        """
        match request["command"]:
            case "pause":
                self._recalibration.pause()
            case "resume":
                self._recalibration.resume()
            case "finish":
                self._recalibration.finishing = "It was asked to finish."
            case "rollback":
                self._recalibration.roll_back(_sequence(request.get("to")))
            case "what_if":
                return self._session.what_if(joint_values(request.get("joints"), self._session.request))
        return self._recalibration.status()


def joint_values(joints: Any, request: ReadRequest) -> dict[str, float]:
    """Values by channel (SI), from names with units (``q1_deg``) or channels in SI (``arm.q1``).

    Raises:
        InputError: a name is not known, or a value is no number.
    """
    if not isinstance(joints, dict) or not joints:
        raise InputError("found no joints.", where=Location("joints"), hint='For example {"q1_deg": 10}.')
    names = {name: (w.channel, unit) for w in request.channels for name, unit in spellings(w).items()}
    names |= {w.channel: (w.channel, "1") for w in request.channels}
    found: dict[str, float] = {}
    for name, value in joints.items():
        if name not in names:
            hint = f"Known are {', '.join([*names][:6])}, and others."
            raise InputError("it is not known.", where=Location(f"joints.{name[:60]}"), hint=hint)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1e9:
            raise InputError("it is no number.", where=Location(f"joints.{name[:60]}"), hint="Give a finite number.")
        channel, unit = names[name]
        found[channel] = from_unit(float(value), unit)
    return found


def _sequence(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        hint = "Give the sequence number of a record; every event has it."
        raise InputError(f"found {value!r}, expected a sequence number.", where=Location("to"), hint=hint)
    return value
