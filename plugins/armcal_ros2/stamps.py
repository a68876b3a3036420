"""When a message was measured: its header's stamp, or when the recorder received it; and stamps that cannot be."""

from array import array
from collections import Counter
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from armcal.base.settings import Settings
from armcal.io.plain_files import refuse

_MOST_DELAYS = 4096
_FAR_S, _FEW = 10.0, 10
"""A stamp that is so far from the others, by the time of receipt, is wrong; after so many at the begin, the others."""
_ZERO, _SAME, _FAR = "the stamp zero", "the stamp of the one before", "a stamp far from those of others"
_EARLIER = "a stamp before that of an earlier one"
_MOST: Mapping[str, float] = MappingProxyType({_ZERO: 0.5, _SAME: 0.5, _FAR: 0.5, _EARLIER: 0.01})
"""A larger part of the messages, and times are not to be trusted."""
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
        self.topic, self.count = topic, 0
        self.latest: float | None = None
        self._clock = clock
        self._left = Counter[str]()
        self._usual: float | None = None
        self._delays = array("d")

    def time(self, stamp: int, received: int) -> float | None:
        """Seconds since 1970 (arguments in ns); None where it is missing, repeated or before an earlier one."""
        self.count += 1
        chosen = stamp if self._clock == "header" else received
        time, delay = chosen / 1e9, (received - chosen) / 1e9
        fault = ""
        if not chosen:
            fault = _ZERO
        elif time == self.latest:
            fault = _SAME
        elif self._usual is not None and abs(delay - self._usual) > _FAR_S:
            if self._left[_FAR] < _FEW or self.count > 2 * _FEW:
                fault = _FAR
            else:
                self.latest = None  # the first were wrong, and these are right
        if not fault and self.latest is not None and time < self.latest:
            fault = _EARLIER
        if fault:
            self._left[fault] += 1
            return None
        self.latest, self._usual = time, delay
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
        for cause, count in self._left.items():
            if count > max(_MOST[cause] * self.count, 1):
                text = f"{count} of {self.count} messages of {self.topic} have {cause}, expected times of measurement."
                hint = f"Set stamps: receive for {self.topic}, or give each program that publishes a topic of its own."
                refuse(place, text, hint)
        listed = ", ".join(f"{count} with {cause}" for cause, count in self._left.items())
        return [f"of {self.count} messages of {self.topic} some were left out: {listed}."] if listed else []


def nanoseconds(stamp: Any) -> int:
    """The time of a header (ns since 1970)."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
