"""The state of a recalibration as its events give it, in bounded memory."""

from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any

from armcal_online.tracking.decisions import LEVELS
from armcal_online.watch.estimates import Estimates, Thinned
from armcal_online.watch.events import VERDICTS, Message, message_of, number, record_of, shortened, text, whole
from armcal_online.watch.hours import Hours, Truth, over_time
from armcal_online.watch.situation import AFTER_THE_END, Trouble, over, situation

RECENT_RECORDS = 2000
"""The newest records, kept whole."""
OLDER_ACCEPTED, OLDER_OTHERS = 2000, 1000
NEWEST = 60
"""The newest records, from which it is seen how far off the predictions are now."""
MOST_EVENTS = 400
"""Events in the list; the oldest are forgotten."""


class History:
    """What the events gave so far.

    Attributes:
        step: a number, which whatever is taken now gets.
    """

    def __init__(self) -> None:
        self.unknown = self.unreadable = self.step = 0
        self._begin()

    def _begin(self) -> None:
        """With nothing, for a recalibration that begins."""
        self._accepted: Thinned[Message] = Thinned(RECENT_RECORDS, OLDER_ACCEPTED, shortened)
        self._others: Thinned[Message] = Thinned(RECENT_RECORDS // 2, OLDER_OTHERS, shortened)
        self.estimates = Estimates()
        self._listed: deque[Message] = deque(maxlen=MOST_EVENTS)
        self.written: Message | None = None
        self._counts = dict.fromkeys(VERDICTS, 0)
        self._first: int | None = None
        self._sequence = -1
        self.last: Message | None = None
        self.level, self.level_sentence = "unknown", ""
        self.calibration: str | None = None
        self.gate: float | None = None
        self.trouble, self.hours = Trouble(), Hours()
        self._newest: deque[Message] = deque(maxlen=NEWEST)
        self._good: Message | None = None
        self.finished: Message | None = None

    def take(self, event: Mapping[str, Any] | None) -> list[Message]:
        """Add an event (None: a line that could not be read); returns the messages about it.

        A start that does not resume an earlier one makes everything before it void: the first message is ``reset``.
        """
        if event is None:
            self.unreadable += 1
            return []
        kind = event.get("event")
        if kind == "record":
            return self._record(event)
        if kind == "started":
            return self._start(event)
        if kind == "estimate":
            row = self.estimates.take(event, self.step)
            return [row] if row else []
        message = message_of(event)
        if message is None:
            self.unknown += 1
            return []
        if message["event"] == "level":
            self._set_level(message.get("to"), message["sentence"])
        if message["event"] in ("level", "decision"):
            self.trouble.take(message)
        if message.get("kind") == "rollback":
            self._set_level(message.get("level"), message["sentence"])
            self._good = message.get("last_good", self._good)
        if message["event"] == "finished":
            self.finished = message
        if message["event"] == "calibration":
            self.written = message
        else:
            self._listed.append({**message, "step": self.step})
        return [message]

    def situation(self, folder: str, status: Mapping[str, Any], heard: float | None = None) -> dict[str, Any]:
        """The first screen; ``status`` is the newest of the recalibration, or empty; see ``over`` for ``heard``."""
        level = self.level if self.level in LEVELS else str(status.get("level", "unknown"))
        known = situation(level, self.trouble, tuple(self._newest), self._good or status.get("last_good"), folder)
        life, ending = over(status, self.finished, heard)
        if ending:
            known["do"] = f"{known['do']} {AFTER_THE_END}" if level in LEVELS[2:] else AFTER_THE_END
        return {**known, "life": life, "over": ending}

    def over_time(self, truth: Truth | None, since: int = 0) -> dict[str, Any]:
        known = over_time(self.hours, truth)
        return {**known, "rows": _newer(known["rows"], since), "truth": None if since else known["truth"]}

    def state(self, since: int = 0) -> dict[str, Any]:
        """Everything, but for what was listed up to a step; numbers are SI unless their key says otherwise."""
        records = sorted(_newer([*self._accepted, *self._others], since), key=lambda r: r.get("sequence") or 0)
        estimates = self.estimates.state()
        return {
            "level": self.level,
            "level_sentence": self.level_sentence,
            "counts": dict(self._counts),
            "first_sequence": self._first,
            "last": self.last,
            "gate_probability": self.gate,
            "records": [{k: v for k, v in r.items() if k != "event"} for r in records],
            "estimates": {**estimates, "rows": _newer(estimates["rows"], since)},
            "events": _newer(self._listed, since),
            "written": self.written,
            "finished": self.finished,
            "unknown": self.unknown,
            "unreadable": self.unreadable,
        }

    def _start(self, event: Mapping[str, Any]) -> list[Message]:
        message = message_of(event)
        messages: list[Message] = []
        if event.get("resumed") is not True and (self.last or self._listed):
            self._begin()
            messages.append({"event": "reset"})
        self.calibration = text(event.get("calibration")) or self.calibration
        gate = event.get("gate")
        self.gate = number(gate.get("probability")) if isinstance(gate, Mapping) else self.gate
        first = whole(event.get("sequence"))
        self._sequence = self._sequence if first is None else first - 1
        row = self.estimates.start(event, self.step)
        self._set_level(text(event.get("level")), None)
        self.finished = None
        if message:
            self._listed.append({**message, "step": self.step})
            messages.append(message)
        return [*messages, *([row] if row else [])]

    def _record(self, event: Mapping[str, Any]) -> list[Message]:
        record = record_of(event)
        if record is None:
            self.unknown += 1
            return []
        if record.setdefault("sequence", self._sequence + 1) <= self._sequence:
            return []  # written a second time
        self._sequence, record["step"] = record["sequence"], self.step
        self._counts[record["verdict"]] += 1
        if self._first is None:
            self._first = record["sequence"]
        self.last = record
        self._newest.append({key: record[key] for key in ("sequence", "off_mm") if key in record})
        self.hours.take(record)
        if record["verdict"] == "accepted" and record.get("level") == "nominal":
            self._good = {key: record[key] for key in ("sequence", "id", "at") if key in record}
        kept = {key: value for key, value in record.items() if key != "inputs"}
        (self._accepted if record["verdict"] == "accepted" else self._others).add(kept)
        self._set_level(record.get("level"), None)
        return [record]

    def _set_level(self, level: Any, sentence: str | None) -> None:
        if level not in LEVELS:
            return
        if sentence is not None:
            self.level_sentence = sentence
        elif level != self.level:
            self.level_sentence = "Nothing out of the ordinary." if level == "nominal" else ""
        self.level = level


def _newer(items: Iterable[Message], since: int) -> list[Message]:
    return [item for item in items if item["step"] > since or not since]
