"""How a servo heats: its winding, heated by the square of its torque, inside its case, cooled by the air.

Two nodes, in units in which a steady loss of 1 heats the winding by 1 above the air:
``loss = (torque / continuous)^2``. Heat 1 is what the servo bears.
"""

from __future__ import annotations

from dataclasses import dataclass

_STEP = 0.05
"""Of the shorter time constant: an explicit step this short stays within some thousandths of the exact course."""


@dataclass(frozen=True)
class HeatPath:
    """The constants of one servo.

    Attributes:
        continuous: the torque that heats the winding to its limit in the end (N m).
        winding_time, case_time: time constants of each node against what it gives its heat to (s).
        winding_share: of the winding's rise, the part that lies between it and the case.
    """

    continuous: float
    winding_time: float
    case_time: float
    winding_share: float

    @property
    def capacities(self) -> tuple[float, float]:
        """What winding and case take up for a rise of 1."""
        return self.winding_time / self.winding_share, self.case_time / (1 - self.winding_share)


class ServoHeat:
    """One servo's temperatures above the air, in parts of what the winding bears.

    Attributes:
        winding, case: see above.
    """

    def __init__(self, path: HeatPath) -> None:
        self.winding, self.case = 0.0, 0.0
        self._path = path
        self._longest = _STEP * min(path.winding_time, path.case_time)

    def advance(self, seconds: float, torque: float) -> None:
        """Hold a torque (N m; 0 for an unpowered servo) for so long."""
        path = self._path
        loss, (winding_capacity, case_capacity) = (torque / path.continuous) ** 2, path.capacities
        while seconds > 0:
            step = min(seconds, self._longest)
            to_case = (self.winding - self.case) / path.winding_share
            to_air = self.case / (1 - path.winding_share)
            self.winding += step * (loss - to_case) / winding_capacity
            self.case += step * (to_case - to_air) / case_capacity
            seconds -= step
