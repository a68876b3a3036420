"""What a worker is to make ready; light, since a worker of low priority imports the rest itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from armcal.calibration.compensation.request import Redundancy
    from armcal.calibration.measured_point import Point
    from armcal.functions.batch_function import EvaluatorChoice


@dataclass(frozen=True)
class Order:
    """Which calibration to make ready.

    Attributes:
        accept: whether one whose level is lost answers as any other; else the first is refused, and a later one
            answers every request with that error, since those before it are no longer valid either.
    """

    shown: str  # the file, as it is called in messages
    sequence: int = 1  # its number on this server
    sha256: str = ""  # of its bytes
    arm: str = ""  # the identity that its arm must have; empty: any
    redundancy: Redundancy = "nearest"  # which of many commands
    within: str = ""  # a configuration whose plan has limits and clearance; empty: none
    point: Point = "tool"  # what forward and compensate are about: the tool's frame, or the target that was measured
    evaluator: EvaluatorChoice = "compiled"  # ``compiled`` where a compiler is found, or ``interpreted``
    accept: bool = False
    gently: bool = False  # whether it is made ready at low priority
