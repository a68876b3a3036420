"""What every transport can do."""

from __future__ import annotations

from typing import Protocol


class Transport(Protocol):
    """A way by which requests come.

    Attributes:
        name: as the server's first line has it.
        clients: who is there now.
        ended: whether no request will ever come again by it.
        finished: whether all that was asked was answered, and taken.
    """

    @property
    def name(self) -> str:
        """See above."""

    @property
    def clients(self) -> int:
        """See above."""

    @property
    def ended(self) -> bool:
        """See above."""

    @property
    def finished(self) -> bool:
        """See above."""

    def open(self) -> None:
        """Begin to take requests."""

    def tend(self) -> None:
        """What is due now and then."""

    def listen_no_more(self) -> None:
        """Take no further requests; those that came are answered."""

    def close(self) -> None:
        """Let go of everything."""
