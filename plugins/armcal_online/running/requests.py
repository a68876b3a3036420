"""Requests to a running recalibration, and the replies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from armcal.base.units import from_unit
from armcal.errors import InputError, Location
from armcal.measure.column_match import spellings
from armcal.measure.reader import ReadRequest

from armcal_online.running.loop import Recalibration
from armcal_online.tracking.recalibrator import Recalibrator


class Requests:
    """Answers requests; commands act at once."""

    def __init__(self, recalibration: Recalibration, session: Recalibrator) -> None:
        self._recalibration = recalibration
        self._session = session

    def answer(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """The reply to one of the known commands.

        Raises:
            ArmcalError: the request cannot be met.
        """
        match request["command"]:
            case "pause":
                self._recalibration.pause()
            case "resume":
                self._recalibration.resume()
            case "finish":
                self._recalibration.finishing = "It was asked to finish."
            case "rollback":
                to = request.get("to")
                if isinstance(to, bool) or not isinstance(to, int) or to < 0:
                    hint = "Give the sequence number of a record; every event has it."
                    raise InputError(f"found {to!r}, expected a sequence number.", where=Location("to"), hint=hint)
                self._recalibration.roll_back(to)
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
    values: dict[str, float] = {}
    for name, value in joints.items():
        if name not in names:
            hint = f"Known are {', '.join([*names][:6])}, and others."
            raise InputError("it is not known.", where=Location(f"joints.{name[:60]}"), hint=hint)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1e9:
            raise InputError("it is no number.", where=Location(f"joints.{name[:60]}"), hint="Give a finite number.")
        channel, unit = names[name]
        values[channel] = from_unit(float(value), unit)
    return values
