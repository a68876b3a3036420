"""The control socket of a running recalibration: requests and replies, a JSON object a line."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from armcal.errors import InputError, Location
from armcal.io.journal import KeptJournal
from armcal.io.json_server import JsonClient, JsonServer

from armcal_online.running.loop import RECORD, Recalibration
from armcal_online.running.situation import SOCKET

GOOD = "good"  # in place of a sequence number: that of the last good record
COMMANDS = ("status", "pause", "resume", "rollback", "finish")


def control_server(folder: Path, answer: Callable[[dict[str, Any]], Mapping[str, Any]]) -> JsonServer:
    """What serves the socket in a folder.

    Raises:
        InputError: somebody else serves it, or it cannot be made.
    """
    return JsonServer.at(folder / SOCKET, "a recalibration is running here.", "Give another --out.", answer)


def ask(folder: Path, request: Mapping[str, Any], timeout_s: float = 30.0) -> dict[str, Any]:
    """The reply of the recalibration that runs in a folder: ``ok``, and the answer or an ``error``.

    Raises:
        InputError: none runs there, or it does not answer in time.
    """
    where = Location(str(folder / SOCKET))
    try:
        with JsonClient(folder / SOCKET, timeout_s) as client:
            return client.ask(request)
    except TimeoutError as fault:
        hint = "It may be busy with a long roll-back; ask again."
        raise InputError(f"no answer within {timeout_s:g} s.", where=where, hint=hint) from fault
    except (OSError, ValueError) as fault:
        hint = "Start it with `armcal recalibrate`, or give the folder it was given as --out."
        raise InputError(f"no recalibration answers here ({fault}).", where=where, hint=hint) from fault


def answer(recalibration: Recalibration, request: Mapping[str, Any]) -> Mapping[str, Any]:
    """The reply to one of the known commands, which act at once, or to a record: ``ok``, and what it says.

    Raises:
        ArmcalError: the request cannot be met.
    """
    if "command" not in request:
        return recalibration.receive(request)
    match request["command"]:
        case "status":
            pass
        case "pause":
            recalibration.pause()
        case "resume":
            recalibration.resume()
        case "finish":
            recalibration.finishing = "It was asked to finish."
        case "rollback":
            return {"ok": True, **rolled_back(recalibration, request.get("to"))}
        case other:
            raise InputError(f"found the command {other!r}, expected one of {', '.join(COMMANDS)}.")
    return {"ok": True, **recalibration.status()}


def rolled_back(recalibration: Recalibration, to: Any) -> Mapping[str, Any]:
    """The reply after a roll-back, to the state after an entry (its number), a record (its name) or the last good one.

    Raises:
        InputError: it is none of them, or no record was good.
        DataError: the journal does not reach there; nothing is changed.
    """
    before = recalibration.sequence
    if to == GOOD:
        good = recalibration.session.status()["last_good"]
        if good is None:
            hint = "Begin a new --out from the calibration that this one began from."
            raise InputError("no record was good yet.", where=Location("rollback"), hint=hint)
        to = good["sequence"]
    elif isinstance(to, str):
        to = entry_named(recalibration.journal, to)
    if isinstance(to, bool) or not isinstance(to, int) or to < 0:
        hint = f"Give the sequence number of a record, which every event has, or {GOOD} for the last good record."
        raise InputError(f"found {to!r}, expected a sequence number.", where=Location("to"), hint=hint)
    sentence = recalibration.roll_back(to)
    again = f"Nothing is lost: roll back to {before} to have the estimate as it was before this."
    return {"sentence": f"{sentence} {again}", "to": to, "before": before, **recalibration.status()}


def entry_named(journal: KeptJournal, name: str) -> int:
    """The entry of the last record of a name that a journal keeps.

    Raises:
        InputError: it keeps none.
        DataError: it is damaged.
    """
    named = [e.sequence for e in journal.entries() if e.kind == RECORD and e.content.get("id") == name]
    if not named:
        hint = "Give an entry's number or a record's name, as events have them, or the last good record: rollback good."
        raise InputError(f"found no record {name!r} in the journal.", where=Location("rollback"), hint=hint)
    return named[-1]
