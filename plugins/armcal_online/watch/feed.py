"""What pages are fed with: the history, kept up to date from the folder, and the newest messages for each to fetch."""

import contextlib
import json
import shlex
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from secrets import token_hex
from typing import Any

from armcal.errors import ArmcalError
from armcal.io.event_file import EVENTS, EventTail

from armcal_online.watch.events import VERDICTS, Message, named_record, numbers, parsed, scalar, text
from armcal_online.watch.history import History
from armcal_online.watch.hours import MISSION, Truth, truth_beside
from armcal_online.watch.shape import Shape

STATUS, CALIBRATION = "status.json", "calibration.yaml"
MOST_MESSAGES = 1000
"""Messages kept for pages that were away; a page that missed more begins anew."""
TIPS = 40
"""Measured tips that are drawn."""
_LONGEST_STATUS = 1 << 16
_PAUSE = 0.25
_DRAW_EVERY = 2.0
_RETRY = 30.0


class Feed:
    """Follows the folder of a recalibration; only reads it.

    Args:
        folder: of the recalibration; it need not be there yet.
        shape: how the arm is drawn; None where nothing is drawn.
    """

    def __init__(self, folder: Path, shape: Shape | None = None) -> None:
        self.folder = folder
        self.history = History()
        self.trouble: str | None = None
        self.run = token_hex(4)
        self._shape = shape
        self._tail = EventTail(folder)
        self._status: dict[str, Any] = {}
        self._status_time = 0
        self._units_after = 0.0
        self._truth: Truth | None = None
        self._truth_time = 0
        self._situation: Message | None = None
        self._arm: Message | None = None
        self._drawn: int | None = None
        self._messages: deque[tuple[int, str]] = deque(maxlen=MOST_MESSAGES)
        self._number = 0
        self._event_at = time.time()
        self._changed = threading.Condition()

    def step(self) -> list[Message]:
        """Read what is new; returns the messages to pages about it."""
        messages: list[Message] = []
        try:
            lines = self._tail.lines()
            self.trouble = None
        except OSError as fault:
            lines, self.trouble = [], f"{self.folder} cannot be read: {fault}"
        with self._changed:
            for line in lines:
                messages += self.history.take(parsed(line))
            if lines:
                self._event_at = time.time()
                with contextlib.suppress(OSError):
                    self._event_at = (self.folder / EVENTS).stat().st_mtime
            estimates, path = self.history.estimates, self.folder / CALIBRATION
            if estimates.without_unit and time.monotonic() >= self._units_after and path.exists():
                self._units_after = time.monotonic() + _RETRY
                if estimates.add_units(units_of(path)):
                    messages.append({"event": "reset"})  # pages begin anew, with the units
            messages += self._new_status()
            if messages or self._situation:
                messages += self._new_situation()
            self._publish(messages)
        return messages

    def draw(self) -> None:
        """The arm at the newest record, where there is a newer one than that drawn."""
        last = self.history.last
        if self._shape is None or last is None or not last.get("inputs") or last["sequence"] == self._drawn:
            return
        points = self._shape.points(last["inputs"], self.history.calibration, time.monotonic())
        with self._changed:
            self._drawn = last["sequence"]
            self._arm = {"event": "arm", "sequence": self._drawn, "points_mm": points, "fault": self._shape.fault}
            self._publish([self._arm])

    def follow(self, stop: threading.Event) -> None:
        """Read on until ``stop``; the arm is drawn when all is read, or every 2 s while much comes."""
        drawn = time.monotonic()
        while not stop.is_set():
            busy = bool(self.step())
            if not busy or time.monotonic() - drawn > _DRAW_EVERY:
                self.draw()
                drawn = time.monotonic()
            if not busy:
                stop.wait(_PAUSE)

    def state(self) -> dict[str, Any]:
        """Everything, for a page that begins."""
        with self._changed:
            return {
                **self.history.state(),
                "situation": self.history.situation(str(self.folder), self._status),
                "over_time": self.history.over_time(self._truth),
                "folder": str(self.folder),
                "control": f"armcal control {shlex.quote(str(self.folder))}",
                "waiting": self.waiting,
                "too_long": self._tail.too_long,
                "heard_s": self._since(self._event_at),
                "status": self._status,
                "status_s": self._since(self._status_time / 1e9) if self._status else None,
                "arm": self._arm,
                "tips": TIPS,
                "after": f"{self.run}-{self._number}",
            }

    @property
    def waiting(self) -> str | None:
        """What is waited for, as a sentence; None once there is something to show."""
        if self.trouble:
            return self.trouble
        if self._number or self.history.last:
            return None
        missing = "there" if self.folder.is_dir() else "not there yet"
        return f"Waiting for a recalibration to begin: {self.folder} is {missing}, and no event is written."

    def after(self, place: str, patience: float) -> Sequence[tuple[str, str]] | None:
        """Messages after a place in the stream, each with its own place; waits for the first one.

        Args:
            place: as handed out by ``state`` or with a message.
            patience: how long to wait (s); nothing by then gives an empty list.

        Returns:
            None where messages in between are no longer kept, or the place is of another watcher.
        """
        run, _, known = place.rpartition("-")
        if run != self.run or not (known.isascii() and known.isdigit() and len(known) < 16):
            return None
        position = int(known)
        with self._changed:
            self._changed.wait_for(lambda: self._number > position, patience)
            missed = self._number - position
            if missed > len(self._messages) or missed < 0:
                return None
            newest = list(self._messages)[len(self._messages) - missed :]
        return [(f"{self.run}-{number}", message) for number, message in newest]

    def _publish(self, messages: Sequence[Message]) -> None:
        self._number += max(len(messages) - MOST_MESSAGES, 0)
        for message in messages[-MOST_MESSAGES:]:
            self._number += 1
            self._messages.append((self._number, json.dumps(message, allow_nan=False, separators=(",", ":"))))
        if messages:
            self._changed.notify_all()

    @staticmethod
    def _since(moment: float) -> float:
        """Seconds; none where clocks disagree."""
        return round(max(0.0, time.time() - moment), 1)

    def _new_situation(self) -> list[Message]:
        """What the first screen says, where that changed, and what became of the newest hour."""
        with contextlib.suppress(OSError):
            written = (self.folder.parent / MISSION).stat().st_mtime_ns
            if written != self._truth_time:
                self._truth, self._truth_time = truth_beside(self.folder), written
        now = {"event": "situation", "situation": self.history.situation(str(self.folder), self._status)}
        if now == self._situation:
            return []
        self._situation = now
        over_time = self.history.over_time(self._truth)
        newest = {key: over_time[key] for key in ("usual_mm", "limit_mm", "off", "checked")}
        return [{**now, "over_time": {**newest, "rows": over_time["rows"][-1:]}}]

    def _new_status(self) -> list[Message]:
        path = self.folder / STATUS
        try:
            written = path.stat().st_mtime_ns
            if written == self._status_time:
                return []
            status = parsed(path.read_bytes()[:_LONGEST_STATUS])
        except OSError:
            return []
        self._status_time = written
        if status is None:
            return []
        self._status = {str(text(key)): value for key, raw in status.items() if (value := scalar(raw)) is not None}
        counts = numbers(status.get("counts"))
        if all(verdict in counts for verdict in VERDICTS):
            self._status["counts"] = {verdict: counts[verdict] for verdict in VERDICTS}
        if (good := named_record(status.get("last_good"))) is not None:
            self._status["last_good"] = good
        return [{"event": "status", "status": self._status}]


def units_of(path: Path) -> Mapping[str, str]:
    """The units of parameters by name, from a calibration whose arm is not built; empty where it cannot be read."""
    from armcal.config.yaml_source import load_config  # late: needed only where events of the start are gone

    try:
        listed = load_config(path).data.get("parameters")
    except (ArmcalError, OSError):
        return {}
    entries = [entry for entry in listed if isinstance(entry, Mapping)] if isinstance(listed, list) else []
    known = [(text(entry.get("name")), text(entry.get("unit"))) for entry in entries]
    return {name: unit for name, unit in known if name and unit}
