"""The interface of transports."""

from typing import Protocol


class Transport(Protocol):
    """A way by which requests come."""

    @property
    def name(self) -> str:
        """As the server's first line has it."""

    @property
    def clients(self) -> int:
        """How many there are now."""

    @property
    def ended(self) -> bool:
        """Whether no request will ever come again by it."""

    @property
    def finished(self) -> bool:
        """Whether all requests were answered, and the answers taken."""

    def open(self) -> None:
        """Begin to take requests."""

    def poll(self) -> None:
        """Do what is due; to be called often."""

    def stop_reading(self) -> None:
        """Take no further requests; those that came are answered."""

    def close(self) -> None:
        """Close all connections."""
