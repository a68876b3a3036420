"""The joint density of some of several records, how it changes with each more or less, and that of a wrong record."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from armcal.base.arrays import Array, Mask
from armcal.estimate.online import log_density, log_likelihood
from scipy.linalg.lapack import dposv


@dataclass(frozen=True)
class Density:
    """A log density, and the squared Mahalanobis distance in it."""

    log_density: float
    nis: float


@dataclass(frozen=True)
class JointDensity:
    """Innovations of records (m), their joint covariance (m x m), and the rows of each record."""

    innovation: Array
    covariance: Array
    rows: Sequence[slice]

    def log_densities(self, chosen: Mask, freedom: float) -> tuple[Density, Array]:
        """The density of chosen records, and what it becomes with each record taken out of them, or put to them (n).

        Both come from one factorisation: a record less divides by its density given the others, which the blocks of
        the inverse give [Rasmussen2006]; a record more multiplies by it.

        Raises:
            LinAlgError: the covariance is not positive definite.
        """
        inside = np.flatnonzero(np.repeat(chosen, [own.stop - own.start for own in self.rows]))
        covariance, innovation = self.covariance[np.ix_(inside, inside)], self.innovation[inside]
        inverse: Array = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
        weighted = inverse @ innovation
        nis, log_determinant = _solved(covariance, innovation)
        changed, start = np.zeros(len(self.rows)), 0
        for i, own in enumerate(self.rows):
            size = own.stop - own.start
            if chosen[i]:
                at = slice(start, start + size)
                start += size
                distance, log_volume = _solved(inverse[at, at], weighted[at])
                parts = nis - distance, log_determinant + log_volume, len(inside) - size
            else:
                across = self.covariance[own, inside]
                given = self.covariance[own, own] - across @ inverse @ across.T
                distance, log_volume = _solved(given, self.innovation[own] - across @ weighted)
                parts = nis + distance, log_determinant + log_volume, len(inside) + size
            changed[i] = log_density(*parts, freedom)
        return Density(log_density(nis, log_determinant, len(inside), freedom), nis), changed


def _solved(covariance: Array, innovation: Array) -> tuple[float, float]:
    if not len(innovation):
        return 0.0, 0.0
    root, weighted, fault = dposv(covariance, innovation)
    if fault:
        raise np.linalg.LinAlgError("a covariance is not positive definite")
    return float(innovation @ weighted), 2 * float(np.log(root.diagonal()).sum())


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
