"""What an instrument reads: what it would read without noise, disturbed by it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from armcal.base.domains import Array
from armcal.measure.measurement import Measurement
from scipy.spatial.transform import Rotation

_QUATERNION = ("qw", "qx", "qy", "qz")
_SCIPY = ("qx", "qy", "qz", "qw")


def disturbed(
    measurements: Mapping[str, Measurement],
    exact: Mapping[str, Array],
    stated: float | None,
    random: np.random.Generator,
) -> dict[str, Array]:
    """Readings by channel (N each) with Gaussian noise, as declared, or ``stated`` (m) on all but orientations.

    A quaternion is turned about its body's axes by the declared noise of the rotation vector, the last three entries.
    """
    found: dict[str, Array] = {}
    for name, measurement in measurements.items():
        noise = measurement.noise()
        channels = [channel.name for channel in measurement.channels() if f"{name}.{channel.name}" in exact]
        plain = [channel for channel in channels if channel not in _QUATERNION or len(channels) == len(noise)]
        for channel, deviation in zip(plain, noise, strict=False):
            values = exact[f"{name}.{channel}"]
            found[f"{name}.{channel}"] = values + random.normal(
                0.0, deviation if stated is None else stated, len(values)
            )
        if len(plain) < len(channels):
            read = Rotation.from_quat(np.array([exact[f"{name}.{channel}"] for channel in _SCIPY]).T)
            read = read * Rotation.from_rotvec(random.normal(0.0, noise[-3:], (len(read), 3)))
            found |= {f"{name}.{channel}": values for channel, values in zip(_SCIPY, read.as_quat().T, strict=True)}
    return {channel: found[channel] for channel in exact}


def is_orientation(channel: str) -> bool:
    """Whether a channel is a part of a quaternion."""
    return channel.rpartition(".")[2] in _QUATERNION
