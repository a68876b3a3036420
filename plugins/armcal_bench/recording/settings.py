"""The section ``bench.recording``: when a posture is one, and which names its labels may have."""

from __future__ import annotations

import math
from typing import Annotated

from armcal.base.settings import Angle, Duration, Length, Settings
from pydantic import Field, model_validator


class RecordingSettings(Settings):
    """How postures are captured.

    Attributes:
        window: a posture is the mean of the readings of so long.
        samples: it has at least so many.
        spread: no turning joint moves by more within the window; ``sliding_spread``: no sliding one.
        stale: a stream that is silent for longer does not show where the arm stands now.
        rest: with ``--capture still``, how long the arm must stand before it is captured by itself.
        moved: and how far a joint must have gone since the posture before.
        alike: postures of one group whose joints all differ by less are reported as nearly the same.
        groups: names that the digits stand for, ``[front/hole_0, front/hole_1]``; an asterisk keeps what was named
            before. Without any, those that the measurements' settings speak of.
    """

    window: Duration = 0.5
    samples: Annotated[int, Field(ge=2)] = 5
    spread: Angle = math.radians(0.2)
    sliding_spread: Length = 0.0002
    stale: Duration = 1.0
    rest: Duration = 1.0
    moved: Angle = math.radians(5.0)
    alike: Angle = math.radians(2.0)
    groups: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _above_zero(self) -> RecordingSettings:
        for name in ("window", "spread", "sliding_spread", "stale", "rest", "moved", "alike"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} is not above zero")
        return self
