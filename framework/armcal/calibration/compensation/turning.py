"""The turn from one rotation to another."""

from __future__ import annotations

import numpy as np

from armcal.base.domains import Array


def turn_between(here: Array, there: Array) -> Array:
    """Rotation vectors in the base frame (N x 3; rad) that turn ``here`` into ``there`` (N x 3 x 3 each).

    Of half turns the direction may be either.
    """
    left = there @ here.transpose(0, 2, 1)
    sine = (
        np.stack([left[:, 2, 1] - left[:, 1, 2], left[:, 0, 2] - left[:, 2, 0], left[:, 1, 0] - left[:, 0, 1]], 1) / 2
    )
    size = np.linalg.norm(sine, axis=1)
    angle = np.arctan2(size, (np.trace(left, axis1=1, axis2=2) - 1) / 2)
    scale = np.where(size < 1e-12, 1.0, angle / np.maximum(size, 1e-300))
    return np.asarray(sine * scale[:, None])
