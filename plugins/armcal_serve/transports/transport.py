"""The interface of transports."""

from typing import Protocol


class Transport(Protocol):
    """A way by which requests come.

    Attributes:
        name: as the server's first line has it.
        clients: the number of clients now.
        ended: whether no request will ever come again by it.
        finished: whether all requests were answered, and the answers taken.
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

    def poll(self) -> None:
        """Do what is due; to be called often."""

    def stop_reading(self) -> None:
        """Take no further requests; those that came are answered."""

    def close(self) -> None:
        """Close all connections."""
