"""What an instrument reads: what it would read without noise, disturbed by it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.estimate.simulation import SimulationRequest, measured_with_noise

_QUATERNION = ("qw", "qx", "qy", "qz")


def disturbed(
    request: SimulationRequest,
    commands: Dataset,
    exact: Mapping[str, Array],
    stated: float | None,
    random: np.random.Generator,
) -> dict[str, Array]:
    """Readings by channel (N each) with Gaussian noise, as declared, or ``stated`` (m) on all that are lengths.

    Raises:
        ProblemError: the residual of a measurement depends on something else than its readings.
    """
    found = measured_with_noise(request, commands, exact, random, stated)
    for name in request.measurements:
        parts = [f"{name}.{part}" for part in _QUATERNION]
        if set(parts) <= found.keys():
            length = np.linalg.norm([found[part] for part in parts], axis=0)
            found |= {part: found[part] / length for part in parts}
    return found


def is_orientation(channel: str) -> bool:
    """Whether a channel is a part of a quaternion."""
    return channel.rpartition(".")[2] in _QUATERNION
