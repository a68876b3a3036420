"""What pages are fed with: the history, kept up to date from the folder, of which each fetches what is new to it."""

import contextlib
import shlex
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from secrets import token_hex
from typing import Any

from armcal.errors import ArmcalError

from armcal_online.event_file import EVENTS, EventTail
from armcal_online.watch.events import VERDICTS, Message, named_record, numbers, parsed, scalar, text
from armcal_online.watch.history import History
from armcal_online.watch.hours import MISSION, Truth, truth_beside
from armcal_online.watch.shape import Shape
from armcal_online.watch.situation import over

STATUS, CALIBRATION = "status.json", "calibration.yaml"
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
        self._shape = shape
        self._tail = EventTail(folder)
        self._status: dict[str, Any] = {}
        self._status_time = 0
        self._units_after = 0.0
        self._truth: Truth | None = None
        self._truth_time = 0
        self._arm: dict[str, Any] | None = None
        self._run, self._number = token_hex(4), 0
        self._event_at = time.time()
        self._changed = threading.Condition()

    def step(self) -> list[Message]:
        """Read what is new; returns the messages about it."""
        try:
            lines = self._tail.lines()
            self.trouble = None
        except OSError as fault:
            lines, self.trouble = [], f"{self.folder} cannot be read: {fault}"
        with self._changed:
            self.history.step, conversions = self._number + 1, self.history.estimates.conversions
            messages = [message for line in lines for message in self.history.take(parsed(line))]
            if lines:
                self._event_at = time.time()
                with contextlib.suppress(OSError):
                    self._event_at = (self.folder / EVENTS).stat().st_mtime
            self._find_units()
            is_converted = self.history.estimates.conversions != conversions
            is_other, has_status = self._read_truth() or is_converted, self._read_status()
            if is_other or {"event": "reset"} in messages:
                self._run = token_hex(4)  # what pages have is void: they begin anew
            if is_other or has_status or lines:
                self._renew()
        return messages

    def draw(self) -> None:
        """The arm at the newest record, where there is a newer one than that drawn."""
        last = self.history.last
        drawn = self._arm and self._arm["sequence"]
        if self._shape is None or last is None or not last.get("inputs") or last["sequence"] == drawn:
            return
        points = self._shape.points(last["inputs"], self.history.calibration, time.monotonic())
        with self._changed:
            self._arm = {"sequence": last["sequence"], "points_mm": points, "fault": self._shape.fault}
            self._renew()

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

    def state(self, place: str = "", patience: float = 0.0) -> dict[str, Any]:
        """What a page shows.

        Args:
            place: of an earlier state, as that had it: of records, events, estimates and hours only those since then
                are given, and ``whole`` is false.
            patience: how long to wait for something new since then (s).
        """
        with self._changed:
            self._changed.wait_for(lambda: place != self._place, patience)
            run, _, number = place.rpartition("-")
            is_known = run == self._run and number.isascii() and number.isdigit() and len(number) < 16
            since = int(number) if is_known else 0
            return {
                **self.history.state(since),
                "situation": self.history.situation(str(self.folder), self._status, self._heard),
                "over_time": self.history.over_time(self._truth, since),
                "folder": str(self.folder),
                "control": f"armcal control {shlex.quote(str(self.folder))}",
                "waiting": self.waiting,
                "too_long": self._tail.too_long,
                "heard_s": self._since(self._event_at),
                "status": self._status,
                "arm": self._arm,
                "tips": TIPS,
                "whole": not is_known,
                "place": self._place,
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

    @property
    def over(self) -> str | None:
        """That nothing follows the arm any more, as a sentence; None while a recalibration is live."""
        return over(self._status, self.history.finished, self._heard)[1]

    @property
    def _heard(self) -> float | None:
        """When the recalibration last gave a sign of life: by its status, or by its events before the first."""
        if self._status:
            return self._status_time / 1e9
        return self._event_at if self._number else None

    @property
    def _place(self) -> str:
        return f"{self._run}-{self._number}"

    def _renew(self) -> None:
        self._number += 1
        self._changed.notify_all()

    @staticmethod
    def _since(moment: float) -> float:
        return round(max(0.0, time.time() - moment), 1)

    def _find_units(self) -> None:
        estimates, path = self.history.estimates, self.folder / CALIBRATION
        if not estimates.without_unit or time.monotonic() < self._units_after or not path.exists():
            return
        self._units_after = time.monotonic() + _RETRY
        estimates.add_units(units_of(path))

    def _read_truth(self) -> bool:
        try:
            written = (self.folder.parent / MISSION).stat().st_mtime_ns
        except OSError:
            return False
        if written == self._truth_time:
            return False
        self._truth, self._truth_time = truth_beside(self.folder), written
        return True

    def _read_status(self) -> bool:
        """Whether there is another status."""
        path = self.folder / STATUS
        try:
            written = path.stat().st_mtime_ns
            if written == self._status_time:
                return False
            status = parsed(path.read_bytes()[:_LONGEST_STATUS])
        except OSError:
            return False
        self._status_time = written
        if status is None:
            return False
        self._status = {str(text(key)): value for key, raw in status.items() if (value := scalar(raw)) is not None}
        counts = numbers(status.get("counts"))
        if all(verdict in counts for verdict in VERDICTS):
            self._status["counts"] = {verdict: counts[verdict] for verdict in VERDICTS}
        if (good := named_record(status.get("last_good"))) is not None:
            self._status["last_good"] = good
        return True


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
