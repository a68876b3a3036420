"""What a source of records is."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Literal, Protocol

from armcal_online.sources.incoming import Incoming

Clock = Callable[[], float]
"""Unix seconds."""
AtEnd = Literal["stop", "wait"]
"""What a file's end means: there is no more, or more may come."""
POLL_S = 0.05
"""How often a file is looked at again."""
THROUGH = "/"
"""Before a name among positions: all files up to that name were taken. No file's name begins so."""


class Source(Protocol):
    """Records, one at a time.

    Attributes:
        keeps_records: whether what is not taken stays in it (a file), or is lost (a stream).
    """

    @property
    def keeps_records(self) -> bool:
        """See above."""

    @property
    def ended(self) -> bool:
        """Whether there will never be another record."""

    def incoming(self, wait_s: float) -> Incoming | None:
        """The next record; None if there is none within the wait. Whatever it reads, it never raises."""

    def resume(self, positions: Mapping[str, int]) -> None:
        """Pass over what was taken before: the last row taken, by file. Nothing for a stream, which begins anew."""
        return

    def acknowledge(self, incoming: Incoming, sequence: int) -> None:
        """Tell the sender, if there is one, that a record is safe. Nothing for files: the journal keeps the row."""
        return

    def close(self) -> None:
        """Let go of files and sockets, if there are any."""
        return


def key_of(name: str) -> str:
    """A file's name as a key that can be written: names need not be UTF-8."""
    return name.encode("utf-8", "backslashreplace").decode("utf-8")


def wait_until(deadline: float) -> bool:
    """Sleep for a moment; whether the deadline (monotonic seconds) is still to come."""
    left = deadline - time.monotonic()
    if left <= 0:
        return False
    time.sleep(min(POLL_S, left))
    return True
