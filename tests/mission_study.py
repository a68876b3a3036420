"""How the filter fares in short missions with what it has no hypothesis for, against a robust refit of 40 records.

Prints a table: ``python -m tests.mission_study [SEEDS] [CASE ...]``.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from armcal.base.arrays import Array
from armcal.calibration.calibration import Calibration
from armcal_online.mission import ErrorCurve, MissionLog, MissionPlan, before_launch, error_curve, run_mission
from armcal_online.mission_simulator import DAY_S, with_payload

from tests.mission_decisions import Decision, Occurrence, occurrences, verdicts
from tests.mission_refits import refits

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "lrm_arm" / "mission.yaml"
DAYS, DAY = 10, 4.0
SHORT = (
    f"simulation.days={DAYS}",
    "simulation.records.every_min=20",
    "simulation.power_cuts=[]",
    "mission.poses=50",
)


def _size(random: np.random.Generator, low: float, high: float) -> float:
    """Each factor as likely as every other; either sign."""
    return float(np.exp(random.uniform(np.log(low), np.log(high))) * random.choice([-1, 1]))


def _vector(random: np.random.Generator, low: float, high: float) -> list[float]:
    direction = random.normal(size=3)
    return [float(x) for x in direction / np.linalg.norm(direction) * abs(_size(random, low, high))]


def two_slips(random: np.random.Generator) -> dict[str, Any]:
    """Two horns slip by 1 to 15 deg at the same moment."""
    joints = random.choice(6, 2, replace=False) + 1
    return {"events": [_turned("slip", i, f"{_size(random, 1, 15)} deg") for i in joints]}


def _turned(kind: str, joint: int, change: str) -> dict[str, Any]:
    return {"kind": kind, "day": DAY, "joint": f"arm.q{joint}", "changes": {f"arm.mdh.theta{joint}": change}}


def outliers(random: np.random.Generator) -> dict[str, Any]:
    """A fifth of the records is off by 30 to 500 mm."""
    return {"events": [], "outliers": {"fraction": 0.2, "size_mm": 30, "largest_mm": 500}}


def tracker_bias(random: np.random.Generator) -> dict[str, Any]:
    """The tracker's readings move away by 0.2 to 1 mm a day."""
    return {"events": [{"kind": "bias", "day": DAY, "per_day_mm": _vector(random, 0.2, 1.0)}]}


def creeping_joint(random: np.random.Generator) -> dict[str, Any]:
    """A joint creeps by 0.1 to 0.6 deg a day."""
    i, change = random.integers(1, 7), f"{_size(random, 0.1, 0.6):.3f} deg in 1 d"
    return {"events": [_turned("creep", i, change)]}


def untold_payload(random: np.random.Generator) -> dict[str, Any]:
    """100 to 300 g, 10 to 80 mm from the tip, that no record reports."""
    mass, lever = abs(_size(random, 100, 300)), _vector(random, 10, 80)
    return {"events": [{"kind": "payload", "day": DAY, "mass_g": mass, "lever_mm": lever}]}


def bent_link(random: np.random.Generator) -> dict[str, Any]:
    """A link's length jumps by 1 to 8 mm and its twist by 1 to 4 deg."""
    i, length, twist = random.integers(3, 6), _size(random, 1, 8), _size(random, 1, 4)
    changes = {f"arm.mdh.a{i}": f"{length:.2f} mm", f"arm.mdh.alpha{i}": f"{twist:.2f} deg"}
    return {"events": [{"kind": "bend", "day": DAY, "joint": f"arm.q{i}", "changes": changes}]}


def unread_tilt(random: np.random.Generator) -> dict[str, Any]:
    """The rover reads its tilt wrong by 10 to 25 deg."""
    azimuth, size = random.uniform(0, 2 * np.pi), abs(_size(random, 10, 25))
    turns = {"statics.gravity_rx": size * np.cos(azimuth), "statics.gravity_ry": size * np.sin(azimuth)}
    changes = {name: f"{turn} deg" for name, turn in turns.items()}
    return {"events": [{"kind": "tilt", "day": DAY, "changes": changes}]}


def nothing(random: np.random.Generator) -> dict[str, Any]:
    """What the configuration has: creep, temperature, tilts, 5 % outliers of 30 to 60 mm."""
    return {"events": []}


CASES: dict[str, Callable[[np.random.Generator], dict[str, Any]]] = {
    case.__name__: case
    for case in (two_slips, outliers, tracker_bias, creeping_joint, untold_payload, nothing, bent_link, unread_tilt)
}


@lru_cache
def launch() -> Path:
    """One calibration before launch for all missions."""
    folder = Path(tempfile.mkdtemp())
    return before_launch(MissionPlan.load(CONFIG, (*SHORT, "simulation.events=[]")), folder)


@dataclass(frozen=True)
class Flown:
    """One mission: errors, that of the refit of the last 40 records, what happened, and what was decided."""

    curve: ErrorCurve
    recent: Array
    happened: tuple[Occurrence, ...]
    decisions: list[Decision]


def flown(case: str, seed: int) -> Flown:
    """One mission through the loop that ``armcal recalibrate`` uses."""
    plan = CASES[case](np.random.default_rng([seed, list(CASES).index(case)]))
    texts = [
        f"simulation.{key}={yaml.safe_dump(value, default_flow_style=True, width=9999)}" for key, value in plan.items()
    ]
    start = f"mission.calibration={launch()}"
    loaded = MissionPlan.load(CONFIG, (*SHORT, "mission.experiment=null", start, f"simulation.seed={seed}", *texts))
    with tempfile.TemporaryDirectory() as folder:
        mission, curve, content = run_mission(loaded, Path(folder))
    before = with_payload(Calibration.load(launch(), loaded.experiment.registry).parameters)
    references = refits(loaded, with_payload(loaded.experiment.parameters).with_nominal(before.nominal()), mission)
    nothing_decided = MissionLog(estimates={0.0: {}}, levels=[(0.0, "nominal")])
    recent = error_curve(loaded, before, mission, nothing_decided, references).errors["refit_recent"]
    return Flown(curve, recent, occurrences(mission.settings.events, DAYS), content["decisions"])


@dataclass(frozen=True)
class Row:
    """One mission: mean errors from the event on (mm), the worst day's ratio, and decisions."""

    filter_mm: float
    recent_mm: float
    frozen_mm: float
    worst: float
    alarms: int
    quiet_days: float
    verdicts: tuple[str, ...]

    @property
    def ratio(self) -> float:
        """Of the filter's error to that of the refit of the last 40."""
        return self.filter_mm / self.recent_mm


def row(made: Flown) -> Row:
    """From the event's moment on, or from the first refit on without one."""
    curve, (found, alarms) = made.curve, verdicts(made.happened, made.decisions)
    recent, filtered, days = made.recent, curve.errors["recalibrated"], curve.times / DAY_S
    first_refit = float(days[int(np.argmax(recent != curve.errors["frozen"]))])
    after = curve.is_hour & (days >= (made.happened[0].day if made.happened else first_refit))
    means = [float(1000 * errors[after].mean()) for errors in (filtered, recent, curve.errors["frozen"])]
    inside = [curve.is_hour & (days >= day) & (days < day + 1) for day in np.arange(first_refit, days[-1])]
    worst = max(float(filtered[day].mean() / recent[day].mean()) for day in inside if day.any())
    quiet = [not any(o.is_open(day) for o in made.happened) for day in days[curve.is_hour]]
    return Row(*means, worst, len(alarms), DAYS * float(np.mean(quiet)), tuple(found))


def table(rows: dict[str, Sequence[Row]]) -> Iterator[str]:
    """A line a case: ratios are medians over the missions, and the largest; alarms by 30 quiet days."""
    yield (
        "case            missions  filter  refit-40  frozen mm   ratio median  largest   worst day   "
        "false alarms/30 d   right vague wrong missed"
    )
    for case, flown_rows in rows.items():
        values = np.array([[r.filter_mm, r.recent_mm, r.frozen_mm, r.ratio] for r in flown_rows])
        quiet = sum(r.quiet_days for r in flown_rows)
        alarms = 30 * sum(r.alarms for r in flown_rows) / quiet if quiet else np.nan
        verdicts = [verdict for r in flown_rows for verdict in r.verdicts]
        counts = " ".join(f"{verdicts.count(verdict):5d}" for verdict in ("right", "vague", "wrong", "missed"))
        yield (
            f"{case:15s} {len(flown_rows):8d}  {values[:, 0].mean():6.2f}  {values[:, 1].mean():8.2f}  "
            f"{values[:, 2].mean():9.2f}   {np.median(values[:, 3]):12.2f}  {values[:, 3].max():7.2f}   "
            f"{max(r.worst for r in flown_rows):9.2f}   {alarms:17.1f}   {counts}"
        )


def main(arguments: Sequence[str]) -> None:
    """Fly, and print after each case."""
    seeds = int(arguments[0]) if arguments else 10
    for case in arguments[1:] or CASES:
        rows = []
        for seed in range(1, seeds + 1):
            rows.append(row(flown(case, seed)))
            print(f"# {case} seed {seed}: {rows[-1]}", file=sys.stderr, flush=True)
        print("\n".join(table({case: rows})), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
