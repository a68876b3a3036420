"""What the net under the filter knows between two records: see ``net``."""

from __future__ import annotations

from dataclasses import dataclass

from armcal_online.tracking.refit import NetRecord, Refit


@dataclass(frozen=True)
class Prediction:
    """How far off a record was predicted: by the filter, then by each window.

    ``relative`` is by the median under the stated noise; ``distance`` that of lengths (m).
    """

    sequence: int
    relative: tuple[float, ...]
    distance: tuple[float, ...]


@dataclass(frozen=True)
class NetState:
    """What the net knows between two records.

    Attributes:
        seconds: for which parameters have had time to wander since the calibration.
        records: the last ones.
        refits: of each window that was filled once.
        predictions: of the last records, since the filter was last corrected.
        taken: how many records it has seen.
    """

    seconds: float = 0.0
    records: tuple[NetRecord, ...] = ()
    refits: tuple[Refit, ...] = ()
    predictions: tuple[Prediction, ...] = ()
    taken: int = 0
