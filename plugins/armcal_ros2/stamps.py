"""When a message was measured: its header's stamp, or when the recorder received it; and stamps that cannot be."""

from __future__ import annotations

from array import array
from typing import Any, Literal

import numpy as np
from armcal.base.settings import Settings
from armcal.io.plain_files import refuse

_MOST_BACKWARD = 0.01
_MOST_DELAYS = 4096
_FAR_S, _FEW = 10.0, 10
"""A stamp that is so far from the others, by the time of receipt, is wrong; after so many at the begin, the others."""
Clock = Literal["header", "receive"]


class TopicSettings(Settings):
    """A topic, and what its times are: stamps of its headers, or when the recorder received its messages."""

    topic: str | None = None
    stamps: Clock = "header"


class Stamps:
    """Times of one topic's messages, in order; those that cannot be are counted.

    Attributes:
        count: of messages.
        latest: the last time (s since 1970), None before the first.
    """

    def __init__(self, topic: str, clock: Clock) -> None:
        self.topic, self.count, self.latest = topic, 0, None
        self._clock = clock
        self._zero = self._repeated = self._backward = self._far = 0
        self._usual: float | None = None
        self._delays = array("d")

    count: int
    latest: float | None

    def time(self, stamp: int, received: int) -> float | None:
        """Seconds since 1970 (arguments in ns); None where it is missing, repeated or before an earlier one."""
        self.count += 1
        chosen = stamp if self._clock == "header" else received
        if not chosen:
            self._zero += 1
            return None
        time, delay = chosen / 1e9, (received - chosen) / 1e9
        if self._usual is not None and abs(delay - self._usual) > _FAR_S:
            self._far += 1
            if self._far < _FEW or self.count > 2 * _FEW:
                return None
            self.latest = None  # the first were wrong, and these are right
        self._usual = delay
        if self.latest is not None and time <= self.latest:
            self._repeated += time == self.latest
            self._backward += time < self.latest
            return None
        self.latest = time
        if len(self._delays) < _MOST_DELAYS:
            self._delays.append(delay)
        return time

    @property
    def delay(self) -> float:
        """The median time from measurement to receipt, by both clocks (s); NaN before the first message."""
        return float(np.median(self._delays)) if self._delays else float("nan")

    def check(self, place: str) -> list[str]:
        """What was left out, sentences; times that are useless altogether are refused.

        Raises:
            DataError: stamps are zero, constant or backwards in too many messages.
        """
        hint = f"Take the times of receipt: set stamps: receive for {self.topic}."
        usable = self.count - self._zero - self._repeated - self._backward - self._far
        text = f"of {self.count} messages of {self.topic}"
        if self.count and self._zero > self.count / 2:
            refuse(place, f"{self._zero} {text} have the stamp zero, expected times of measurement.", hint)
        if self._repeated > max(self.count / 2, 1):
            refuse(place, f"{self._repeated} {text} repeat the stamp before: the clock stands.", hint)
        if self._backward > max(_MOST_BACKWARD * self.count, 1):
            several = " Or several programs publish there: give each its own topic."
            refuse(place, f"{self._backward} {text} have stamps before that of an earlier one.", hint + several)
        if self._far > self.count / 2:
            refuse(place, f"{self._far} {text} have stamps that jump: the clock was set.", hint)
        causes = {
            "stamp zero": self._zero,
            "a stamp far from that of others": self._far,
            "a repeated stamp": self._repeated,
            "an earlier stamp": self._backward,
        }
        listed = ", ".join(f"{count} with {cause}" for cause, count in causes.items() if count)
        return [f"{self.count - usable} {text} were left out: {listed}."] if listed else []


def nanoseconds(stamp: Any) -> int:
    """The time of a header (ns since 1970)."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
