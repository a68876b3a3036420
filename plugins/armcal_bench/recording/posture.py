"""A posture as it was captured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Posture:
    """The mean of readings of arms that stood still.

    Attributes:
        name: its number, counted from 1 over all that were ever captured here.
        angles: by channel (``arm.q1``; rad, or m of sliding joints).
        spread: the largest less the smallest reading of the joint that moved most (rad or m).
        readings: how many it is the mean of.
        at: unix seconds; of two postures the later one's is not the smaller.
        labels: the group it belongs to (a socket's name), by column.
        stamp: when it was, by the source's own clock (s), where it says so.
    """

    name: str
    angles: Mapping[str, float]
    spread: float
    readings: int
    at: float
    labels: Mapping[str, str] = field(default_factory=dict)
    stamp: float | None = None

    @property
    def place(self) -> str:
        """The name of its group, for people."""
        return "/".join(self.labels.values())

    def as_dict(self) -> dict[str, Any]:
        """As JSON; numbers read back bit for bit."""
        return {**self.__dict__, "angles": dict(self.angles), "labels": dict(self.labels)}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Posture:
        """What ``as_dict`` wrote."""
        return cls(**content)
