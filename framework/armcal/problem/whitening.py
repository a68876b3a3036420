"""Whitening: what turns residuals into numbers of unit variance, record by record.

A whitening W of a covariance S has W S W' = I; the inverse of its lower Cholesky factor is taken.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armcal.base.domains import Array


def declared(noise: Sequence[float]) -> Array:
    """From standard deviations that hold for every record (n_r x n_r)."""
    return np.diag(1 / np.array(noise))


def by_deviation(deviations: Array) -> Array:
    """From each record's own standard deviations (n_r x N), uncorrelated (n_r x n_r x N)."""
    count = len(deviations)
    whitening = np.zeros((count, *deviations.shape))
    whitening[np.arange(count), np.arange(count)] = 1 / deviations
    return whitening


def by_covariance(covariances: Array) -> Array:
    """From each record's covariance, given and returned as n_r x n_r x N.

    Raises:
        numpy.linalg.LinAlgError: one is not positive definite.
    """
    lower = np.linalg.cholesky(np.moveaxis(covariances, 2, 0))
    identity = np.broadcast_to(np.eye(lower.shape[1]), lower.shape)
    return np.ascontiguousarray(np.moveaxis(np.linalg.solve(lower, identity), 0, 2))


def transformed(matrices: Array, rows: Array) -> Array:
    """Each record's matrix (n_r x n_r x N) times its rows (n_r x ... x N)."""
    result = np.zeros_like(rows)
    for i in range(len(rows)):
        for j, row in enumerate(rows):
            result[i] += matrices[i, j] * row
    return result
