"""The first screen for an operator on call: what to do, how far off, since when, and where to roll back to.

A recalibration keeps it from its own events and writes it into ``status.json``. Whether that process still runs is not
its own to say: ``present`` asks the control socket, which ends with the process.
"""

import json
import math
import shlex
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from statistics import median
from typing import Any

from armcal.errors import InputError, Location
from armcal.io.json_server import JsonClient

from armcal_online.tracking.decisions import KINDS, LEVEL_ADVICE, LEVELS, spoken_time, sure_to

STATUS, SOCKET = "status.json", "control.sock"
EVENTS, EARLIER = "events.jsonl", "events.jsonl.1"
SILENT_S = 15.0  # a recalibration that wrote no status for so long hangs, though its process is there
AFTER_THE_END = "Start the recalibration again before the arm's next work: the same command goes on where it stopped."
_OVER = {
    "ended": "The recalibration has ended",
    "stopped": "The recalibration stopped",
    "killed": "The recalibration was killed: no process answers here, and its last sign came",
    "hangs": "The recalibration hangs, or was killed: its last sign came",
}
_NEWEST = 20  # so many of the last readings show how far off the predictions are now
_MOST = 60
_CALM = "some"  # in the advice for a level for which no event stated how many records it takes

Event = Mapping[str, Any]


class Situation:
    """The first screen, kept from events; bounded."""

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self._first: Event | None = None  # since the level was last nominal: the event that names the earliest record
        self._over: Event | None = None  # the change to nominal, or the roll-back, with which the last trouble ended
        self._decision: Event | None = None  # the last decision that meant trouble, also after it
        self._noted: deque[Event] = deque(maxlen=_MOST)
        self._off: deque[tuple[int, float]] = deque(maxlen=_MOST)  # entry and mm of the newest readings

    @classmethod
    def recovered(cls, folder: Path) -> "Situation":
        """As the events in a folder leave it; what cannot be read there is passed over."""
        known = cls()
        for name in filter(lambda name: (folder / name).is_file(), (EARLIER, EVENTS)):
            with suppress(OSError), (folder / name).open(encoding="utf-8", errors="replace") as lines:
                for line in lines:
                    with suppress(ValueError, TypeError, KeyError, AttributeError, RecursionError):
                        known.take(json.loads(line))
        return known

    def take(self, event: Event) -> None:
        kind = event["event"]
        if kind == "started" and event.get("resumed") is not True:
            self._begin()
        elif kind == "record" and event.get("residual_mm"):
            size = math.hypot(*event["residual_mm"])
            self._off.extend([(event["sequence"], size)] if math.isfinite(size) else [])
        elif kind in ("decision", "level"):
            level = _meant_level(event)
            if (kind == "level" and level == "nominal") or event.get("kind") == "rollback":
                self._first, self._over = None, event
                self._noted.clear()
            if level in LEVELS[1:] and event.get("kind") != "rollback":
                self._first = event if self._first is None else min(self._first, event, key=_first_record)
                self._noted.append(event)
                self._decision = event if kind == "decision" else self._decision

    def first_screen(self, level: str, good: Event | None, folder: Path) -> dict[str, Any]:
        """The first screen.

        Returns:
            ``do``, ``what`` (with how sure that is), ``confirm``; ``earlier``, the last decision where none matters
            now; ``off_mm`` now, from ``off_of`` readings, and ``off_before_mm`` before the last decision; ``since`` and
            ``last_good``, each a record; ``rollback``, a command.
        """
        causes = self._causes(level)
        cause = causes[-1] if causes else None
        good = good if self._first is None else self._first.get("last_good")
        back = self._over if self._over and self._over.get("kind") == "rollback" else None
        off = self._off_since(cause or back)
        screen: dict[str, Any] = {
            "do": self._advice(level) or (back or {}).get("do") or _general_advice(level, good),
            "off_mm": float(f"{median(off):.4g}") if off else None,
            "off_of": len(off),
            "last_good": good,
            "rollback": good and f"armcal control {shlex.quote(str(folder))} rollback {good['sequence']}",
        }
        if cause is not None:
            screen["what"] = " ".join(map(_what, causes))
            screen["confirm"] = " ".join(dict.fromkeys(event["confirm"] for event in causes if event.get("confirm")))
            screen["off_before_mm"] = cause.get("tip_error_mm")
        elif self._decision is not None:
            screen["earlier"] = self._decision["sentence"]
        start = self._first or self._over
        if start is not None:
            since = {"sequence": _first_record(start), "id": start.get("since_id")}
            since["at"] = start.get("since_at", start.get("at"))
            screen["since"] = {key: value for key, value in since.items() if value is not None}
        return screen

    def _causes(self, level: str) -> list[Event]:
        """The newest decisions that mean this level: two at once where two things changed."""
        meant = [event for event in self._noted if event["event"] == "decision" and _meant_level(event) == level]
        return [event for event in meant if event["sequence"] == meant[-1]["sequence"]]

    def _advice(self, level: str) -> str | None:
        """What to do at this level: what the newest event that led to it says, a decision before a change of level."""
        leading = [event for event in self._noted if _meant_level(event) == level and event.get("do")]
        newest = [event for event in leading if event["sequence"] == leading[-1]["sequence"]]
        decided = [event for event in newest if event["event"] == "decision"]
        return " ".join(dict.fromkeys(str(event["do"]) for event in decided or newest)) or None

    def _off_since(self, cause: Event | None) -> Sequence[float]:
        """The newest readings after a decision; where none came yet, the newest alone, but after a roll-back none."""
        place = -1 if cause is None else cause["sequence"]
        after = [mm for sequence, mm in self._off if sequence > place][-_NEWEST:]
        none = cause is not None and cause.get("kind") == "rollback"
        return after or ([] if none else [mm for _, mm in self._off][-1:])


def _meant_level(event: Event) -> str | None:
    if event["event"] == "level":
        return str(event["to"])
    if event.get("level") is not None:
        return str(event["level"])
    kind = KINDS.get(event.get("kind", ""))
    return kind.level if kind else None


def _first_record(event: Event) -> int:
    return int(event.get("since", event.get("sequence")) or 0)


def _what(decision: Event) -> str:
    sure = f" {sure_to(decision['sure_percent'])}." if decision.get("sure_percent") is not None else ""
    return f"{decision.get('what') or decision['sentence']}{sure}"


def _general_advice(level: str, good: Event | None) -> str:
    words = {str(name): words for name, words in LEVEL_ADVICE.items()}
    if level not in words:
        return "Wait for the first record."
    there = f"record {good.get('id', good['sequence'])}" if good else "the calibration that it began from"
    return words[level].format_map({"calm": _CALM, "good": there})


def is_running(folder: Path) -> bool | None:
    """Whether a process answers at the control socket; None where this user may not ask."""
    try:
        JsonClient(folder / SOCKET, 1.0).close()
    except (PermissionError, TimeoutError):
        return None
    except OSError:
        return False
    return True


def present(folder: Path) -> dict[str, Any]:
    """The newest status in a folder, and whether what wrote it still runs, whatever it wrote last.

    Returns:
        what is in ``status.json``; ``life`` (``waiting`` before the first status, ``running``, ``ended``, ``stopped``
        by a fault, ``killed`` or ``hangs``); ``over``, a sentence where nothing follows the arm; and ``situation``,
        whose ``do`` then says so too.

    Raises:
        InputError: it may not be read.
    """
    try:
        read = json.loads((folder / STATUS).read_text(encoding="utf-8", errors="replace"))
        status = read if isinstance(read, dict) else {}
    except (FileNotFoundError, ValueError, RecursionError):
        status = {}
    except OSError as fault:
        where, hint = Location(str(folder / STATUS)), "Ask as the user who recalibrates."
        raise InputError(f"it cannot be read ({fault.strerror}).", where=where, hint=hint) from fault
    life = _life(status, is_running(folder))
    now = dict(status.get("situation") or {"do": "Wait for the first record."})
    over = None
    if life in _OVER:
        at = status.get("at")
        began = f"{_OVER[life]} at {spoken_time(at)}" if at else _OVER[life]
        why = f": {status['fault']}" if life == "stopped" else "."
        over = f"{began}{why} Nothing follows the arm until it is started again; a roll-back works all the same."
        bad = status.get("level") in LEVELS[2:]
        now["do"] = f"{now['do']} {AFTER_THE_END}" if bad else AFTER_THE_END
    return {**status, "folder": str(folder), "situation": now, "life": life, "over": over}


def _life(status: Event, runs: bool | None) -> str:
    silent = time.time() - float(status.get("at") or 0.0) > SILENT_S
    if status.get("finished") and (not runs or silent):
        return "stopped" if status.get("fault") else "ended"
    if not status:
        return "running" if runs else "waiting"
    if runs is False:
        return "killed"
    return "hangs" if silent else "running"
