"""What each joint of an arm holds, for many commands at once."""

from __future__ import annotations

import numpy as np
from armcal.arm.assembly import Arm, holding_function
from armcal.base.arrays import Array


def holding_efforts(arm: Arm, commands: Array, *load: object) -> Array:
    """Static efforts (joints x N; N m or N) at commands (joints x N), under gravity, a payload and where it sits."""
    return np.asarray(holding_function(arm, *load).map(commands.shape[1])(commands).full())  # type: ignore[arg-type]
