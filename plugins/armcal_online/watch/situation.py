"""What whoever is called at night has to know: what to do, how far off, since when, and where to roll back to."""

import shlex
import time
from collections import deque
from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from armcal_online.tracking.decisions import KINDS, LEVEL_ADVICE, LEVELS, sure_to
from armcal_online.watch.events import Message, when

_NEWEST = 20
"""So many of the last readings show how far off the predictions are now."""
_MOST = 60
AFTER_THE_END = "Start the recalibration again before the arm's next work: the same command goes on where it stopped."
"""What to do once nothing follows the arm."""
SILENT_S = 15.0
"""A recalibration that wrote no status for so long does not run, or hangs."""
_OVER = {
    "ended": "The recalibration has ended",
    "stopped": "The recalibration stopped",
    "silent": "The recalibration was killed, or hangs: its last sign came",
}
_CALM = "some"
"""In the advice for a level for which no event stated how many records it takes."""


def over(status: Mapping[str, Any], finished: Message | None, heard: float | None) -> tuple[str, str | None]:
    """How a recalibration stands, and that nothing follows the arm any more, since when and why; None while one does.

    ``waiting`` while nothing came, ``live``, ``ended``, ``stopped`` by a fault, or ``silent``. ``heard`` is the time of
    its last sign of life (s since 1970).
    """
    fault = status.get("fault")
    if status.get("finished"):
        life, at = "stopped" if fault else "ended", (finished or status).get("at", heard)
    else:
        life, at = "live" if heard else "waiting", heard
        life = "silent" if heard and time.time() - heard > SILENT_S else life
    if life not in _OVER:
        return life, None
    began = f"{_OVER[life]} at {when(at)}" if at else _OVER[life]
    why = f": {fault}" if life == "stopped" else "."
    return life, f"{began}{why} Nothing follows the arm until it is started again; a roll-back works all the same."


class Trouble:
    """Decisions and levels since the level was last nominal; bounded.

    Attributes:
        first: the event that names its earliest record.
        over: the change to nominal with which the last one ended.
        decision: the last decision that meant trouble, also after it.
    """

    def __init__(self) -> None:
        self.first: Message | None = None
        self.over: Message | None = None
        self.decision: Message | None = None
        self._events: deque[Message] = deque(maxlen=_MOST)

    def take(self, message: Message) -> None:
        level = meant_level(message)
        if (message["event"] == "level" and level == "nominal") or message.get("kind") == "rollback":
            self.first, self.over = None, message
            self._events.clear()
        if level in LEVELS[1:]:
            self.first = message if self.first is None else min(self.first, message, key=_first_record)
            self._events.append(message)
            self.decision = message if message["event"] == "decision" else self.decision

    def causes(self, level: str) -> list[Message]:
        """The newest decisions that mean this level: two at once where two things changed."""
        meant = [m for m in self._events if m["event"] == "decision" and meant_level(m) == level]
        return [message for message in meant if message.get("sequence") == meant[-1].get("sequence")]

    def advice(self, level: str) -> str | None:
        """What to do at this level: what the newest event that led to it says, a decision before a change of level."""
        leading = [message for message in self._events if meant_level(message) == level and message.get("do")]
        newest = [message for message in leading if message.get("sequence") == leading[-1].get("sequence")]
        decided = [message for message in newest if message["event"] == "decision"]
        return " ".join(dict.fromkeys(str(message["do"]) for message in decided or newest)) or None


def meant_level(message: Message) -> str | None:
    """The level that an event means; None where it means none."""
    if message["event"] == "level":
        return message.get("to")
    if "level" in message:
        return str(message["level"])
    kind = KINDS.get(message.get("kind", ""))
    return kind.level if kind else None


def situation(
    level: str,
    trouble: Trouble,
    records: Sequence[Mapping[str, Any]],
    good: Mapping[str, Any] | None,
    folder: str,
) -> dict[str, Any]:
    """The first screen.

    Returns:
        ``do``, ``what`` (with how sure that is), ``confirm``; ``earlier``, the last decision where none matters now;
        ``off_mm`` now, from ``off_of`` readings, and ``off_before_mm`` before the last decision; ``since`` and
        ``last_good``, each a record; ``rollback``, a command.
    """
    first, causes = trouble.first, trouble.causes(level)
    cause = causes[-1] if causes else None
    good = good if first is None else first.get("last_good")
    back = None if trouble.over is None or trouble.over.get("kind") != "rollback" else trouble.over
    off = [record["off_mm"] for record in _after(records, cause or back)]
    known: dict[str, Any] = {
        "do": trouble.advice(level) or (back or {}).get("do") or _general_advice(level, good),
        "off_mm": median(off) if off else None,
        "off_of": len(off),
        "last_good": good,
        "rollback": None if good is None else f"armcal control {shlex.quote(folder)} rollback {good['sequence']}",
    }
    if cause is not None:
        known["what"] = " ".join(map(_what, causes))
        known["confirm"] = " ".join(dict.fromkeys(m["confirm"] for m in causes if m.get("confirm"))) or None
        known["off_before_mm"] = cause.get("tip_error_mm")
    elif trouble.decision is not None:
        known["earlier"] = trouble.decision["sentence"]
    start = first or trouble.over
    if start is not None:
        since = {"sequence": _first_record(start)}
        named = {"id": start.get("since_id"), "at": start.get("since_at", start.get("at"))}
        known["since"] = since | {key: value for key, value in named.items() if value is not None}
    return known


def _first_record(message: Message) -> int:
    """The number of the first record that an event is about; 0 where it names none."""
    return int(message.get("since", message.get("sequence")) or 0)


def _what(decision: Message) -> str:
    sure = f" {sure_to(decision['sure_percent'])}." if decision.get("sure_percent") is not None else ""
    return f"{decision.get('what') or decision['sentence']}{sure}"


def _after(records: Sequence[Mapping[str, Any]], cause: Message | None) -> Sequence[Mapping[str, Any]]:
    """The newest records after the last decision; where none came yet, the newest alone, but after a roll-back none."""
    known = [record for record in records if record.get("off_mm") is not None]
    place = -1 if cause is None else cause.get("sequence") or 0
    after = [record for record in known if record["sequence"] > place][-_NEWEST:]
    return after or ([] if cause is not None and cause.get("kind") == "rollback" else known[-1:])


def _general_advice(level: str, good: Mapping[str, Any] | None) -> str:
    words = {str(name): words for name, words in LEVEL_ADVICE.items()}
    if level not in words:
        return "Wait for the first record."
    there = f"record {good.get('id', good['sequence'])}" if good else "the calibration that it began from"
    return words[level].format_map({"calm": _CALM, "good": there})
