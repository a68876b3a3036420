"""How far the calibration can be trusted, and when that changes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import bdtrc, chdtrc, chdtri, fdtrc, fdtri

from armcal_online.tracking.decisions import LEVELS, Level


@dataclass(frozen=True)
class Health:
    """A level, the number of records since the last trouble, and the reason of the level.

    It gets no better than ``best`` while a change is unexplained, however well the records fit.
    """

    level: Level = "nominal"
    calm: int = 0
    sentence: str = "The records agree with the calibration."
    best: Level = "nominal"

    def troubled(self, level: Level, sentence: str) -> Health:
        """After trouble: at least that bad, counting anew."""
        if LEVELS.index(level) > LEVELS.index(self.level):
            return replace(self, level=level, calm=0, sentence=sentence)
        return replace(self, calm=0)

    def calmed(self, after: int) -> Health:
        """After a record without trouble: better by a level once ``after`` of them came in a row."""
        if LEVELS.index(self.level) <= LEVELS.index(self.best):
            return self
        if self.calm + 1 < after:
            return replace(self, calm=self.calm + 1)
        level = LEVELS[LEVELS.index(self.level) - 1]
        text = f"{after} records in a row agree with the calibration"
        if level == self.best != "nominal":
            text += "; what changed it is not known"
        return replace(self, level=level, calm=0, sentence=f"{text}.")


def nis_limit(dof: int, probability: float, freedom: float = math.inf) -> float:
    """What NIS stays below with a probability, where all is as believed.

    ``freedom``: degrees of freedom with which the noise is known. Where they are few, NIS by ``dof`` has an F
    distribution, as Hotelling's T-squared [Hotelling1931].
    """
    if math.isinf(freedom):
        return float(chdtri(float(dof), 1 - probability))
    return dof * float(fdtri(float(dof), freedom, probability))


def many_outliers(count: int, records: int, fraction: float) -> float:
    """How probable at least ``count`` outliers among some records are, if ``fraction`` of all are."""
    return float(bdtrc(count - 1, records, fraction)) if count > 0 else 1.0


def improbability(nis_window: Sequence[tuple[float, int]], known: float = math.inf) -> float:
    """How probable NIS (each with its degrees of freedom, in order) at least as large in sum are by chance.

    Neighbours that resemble each other count for less than their number: by their first serial correlation. ``known``:
    degrees of freedom with which the noise is known, which all of them share.
    """
    if len(nis_window) < 3:
        return 1.0
    total, freedom = (float(sum(column)) for column in zip(*nis_window, strict=True))
    relative = np.array([nis / dof for nis, dof in nis_window])
    centred = relative - relative.mean()
    power = float(centred @ centred)
    serial = float(centred[1:] @ centred[:-1]) / power if power > 0 else 0.0
    serial = float(np.clip(serial, 0.0, 0.9))
    shared = (1 + serial) / (1 - serial)
    if math.isinf(known):
        return float(chdtrc(freedom / shared, total / shared))
    return float(fdtrc(freedom / shared, known, total / freedom))
