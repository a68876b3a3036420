"""The error of a wrong record: a mixture over sizes, as a marker taken for another is off by far more than a glint.

The stated size is the most probable, and the tails are heavy: a record that is far off then costs every hypothesis
hardly more than one that is less so, and no change of the arm is made up to explain it.
"""

from __future__ import annotations

import math

from armcal.base.domains import Array
from armcal.estimate.online import log_likelihood

_SIZES = ((1.0, 0.5), (3.0, 0.25), (10.0, 0.125), (30.0, 0.125))
"""Of errors in units of the stated size, and how probable each is."""


def log_density_of_outlier(innovation: Array, expected: Array, stated: Array, freedom: float) -> float:
    """Log density of a wrong record, of the size that makes it likeliest.

    Args:
        innovation: of the record (m).
        expected: its covariance if the record were a good one (m x m).
        stated: covariance of an error of the stated size (m x m).
        freedom: degrees of freedom with which the noise is known.
    """
    return max(
        math.log(probability) + log_likelihood(innovation, expected + size**2 * stated, freedom)
        for size, probability in _SIZES
    )
