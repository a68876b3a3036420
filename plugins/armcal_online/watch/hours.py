"""How far off the predictions were over time, beside the level: hours in which the level was nominal all the same."""

import csv
import json
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median, median_low
from typing import Any

from armcal_online.tracking.decisions import LEVELS
from armcal_online.watch.events import number, rounded, text

HOUR_S = 3600.0
MOST_HOURS = 2000
"""The oldest hours are forgotten."""
_FEW = 2
"""An hour with fewer records says nothing."""
_OFF = 2.0
"""An hour is off if its readings lie so many times as far from their predictions as in the median hour."""
_MOST_SIZES = 1000
_MOST_ROWS = 20_000
_MOST_SPANS = 40
MISSION, FIGURES = "mission.csv", "mission.json"
_DAY_S = 86400.0


@dataclass
class Hour:
    """An hour's judged readings: when it began, how far off the first of them were (mm), how many, the worst level.

    ``step`` is that of the last reading.
    """

    at: float
    sizes: list[float] = field(default_factory=list)
    count: int = 0
    level: int = 0
    step: int = 0
    _median: float | None = None

    def take(self, off_mm: float, level: int, step: int) -> None:
        self.count, self.step = self.count + 1, step
        self.level = max(self.level, level)
        if len(self.sizes) < _MOST_SIZES:
            self.sizes.append(off_mm)

    def close(self) -> None:
        self._median, self.sizes = self.median, []

    @property
    def median(self) -> float:
        """Of the readings, the smaller of two in the middle: one outlier of two records shows no arm that is off."""
        return median_low(self.sizes) if self._median is None else self._median

    @property
    def row(self) -> dict[str, Any]:
        known = {"at": self.at, "mm": rounded(self.median, 4), "count": self.count, "level": LEVELS[self.level]}
        return {**known, "step": self.step}


@dataclass
class Hours:
    """Hours with records; bounded."""

    _hours: deque[Hour] = field(default_factory=lambda: deque(maxlen=MOST_HOURS))

    def take(self, record: Mapping[str, Any]) -> None:
        """A record; one that was ignored, or has no time or no reading in mm, does not count."""
        at, off, level = record.get("at"), record.get("off_mm"), record.get("level")
        if at is None or off is None or record["verdict"] == "ignored":
            return
        start = HOUR_S * math.floor(at / HOUR_S)
        if not self._hours or start > self._hours[-1].at:
            if self._hours:
                self._hours[-1].close()
            self._hours.append(Hour(start))
        self._hours[-1].take(off, LEVELS.index(level) if level in LEVELS else 0, record.get("step", 0))

    @property
    def rows(self) -> list[dict[str, Any]]:
        return [hour.row for hour in self._hours]


@dataclass(frozen=True)
class Truth:
    """What a simulated mission knows: rows of time, tip error (mm) and level; what is tolerable (mm)."""

    rows: Sequence[Mapping[str, Any]]
    limit_mm: float | None


def truth_beside(folder: Path) -> Truth | None:
    """The truth of the mission that a recalibration is part of; None where there is none that can be read."""
    try:
        known = json.loads((folder.parent / FIGURES).read_text())
        began, limit = number(known["began"]), number(known["limit_mm"])
        with (folder.parent / MISSION).open(newline="", encoding="utf-8") as file:
            listed = [row for row, _ in zip(csv.DictReader(file), range(_MOST_ROWS), strict=False)]
        if began is None:
            return None
        rows = [
            {
                "at": began + _DAY_S * float(row["day"]),
                "mm": rounded(float(row["recalibrated_mm"]), 4),
                "level": text(row["level"]),
            }
            for row in listed
            if row["moment"] == "hour"
        ]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return Truth(rows, limit)


def over_time(hours: Hours, truth: Truth | None) -> dict[str, Any]:
    """For pages: hours by readings, hours by truth, what is usual or tolerable, and spans that were off at nominal."""
    rows = hours.rows
    whole = [row["mm"] for row in rows if row["count"] >= _FEW]
    usual = median(whole) if whole else None
    by_truth = truth is not None and truth.limit_mm is not None
    if truth is not None and truth.limit_mm is not None:
        limit, checked = truth.limit_mm, list(truth.rows)
    else:
        limit, checked = (math.inf if usual is None else _OFF * usual), [row for row in rows if row["count"] >= _FEW]
    off = [row for row in checked if row["level"] == "nominal" and row["mm"] > limit]
    return {
        "rows": rows,
        "truth": None if truth is None else list(truth.rows),
        "usual_mm": rounded(usual, 3),
        "limit_mm": rounded(limit, 3) if math.isfinite(limit) else None,
        "by": "truth" if by_truth else "readings",
        "off": _spans(off),
        "checked": len(checked),
    }


def _spans(off: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    spans: list[dict[str, Any]] = []
    for row in off:
        if spans and row["at"] <= spans[-1]["to"] + 0.5 * HOUR_S:
            spans[-1] |= {"to": row["at"] + HOUR_S, "mm": max(spans[-1]["mm"], row["mm"])}
        else:
            spans.append({"from": row["at"], "to": row["at"] + HOUR_S, "mm": row["mm"]})
    return spans[-_MOST_SPANS:]
