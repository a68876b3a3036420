"""How a measuring run ends, and what makes it stop on its way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

How = Literal["done", "held", "parked"]


@dataclass(frozen=True)
class Ending:
    """How a run ended, and a sentence why."""

    how: How
    sentence: str


class ParkRequested(Exception):  # noqa: N818 - no error: somebody or something wants the arm parked
    """The arm is to be parked, and the run to end. The message says why."""


class TrackerLost(ParkRequested):
    """The tracker has told nothing of use for long, be it for where the arm is or for good."""


class ThermalLimit(Exception):  # noqa: N818 - see above
    """A servo has come to its budget before its time."""
