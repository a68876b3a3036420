"""Postures spread evenly over joint space."""

from __future__ import annotations

import math

from armcal.base.domains import Array


def spread(limits: Array, count: int, seed: int) -> Array:
    """So many commands (joints x count) between limits (joints x 2), by a scrambled Sobol sequence.

    More of them begin with the same ones; the same seed gives the same.
    """
    from scipy.stats import qmc

    drawn = qmc.Sobol(len(limits), rng=seed).random_base2(max(0, math.ceil(math.log2(count))))[:count]
    return (limits[:, 0] + drawn * (limits[:, 1] - limits[:, 0])).T.copy()
