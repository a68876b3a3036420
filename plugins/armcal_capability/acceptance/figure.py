"""A number with the interval that holds its true value with 95 %."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Figure:
    """An estimate and its 95 % interval, in one unit (``high`` may be infinite)."""

    value: float
    low: float
    high: float

    def times(self, factor: float) -> Figure:
        """In another unit (factor > 0)."""
        return Figure(self.value * factor, self.low * factor, self.high * factor)

    def as_dict(self) -> dict[str, float | None]:
        """For JSON, which knows no infinity."""
        return {"value": self.value, "low": self.low, "high": self.high if np.isfinite(self.high) else None}
