"""What a mission leaves as text: its truth, its errors over time, and its figures."""

from __future__ import annotations

import csv
import io
from typing import Any

import numpy as np
from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from armcal.base.units import to_unit
from armcal.estimate.mission_truth import DAY_S, Mission

from armcal_online.mission.judge import ErrorCurve, EventReport, Judgement
from armcal_online.mission.mission_log import Decision, MissionLog

_MM = 1000.0
_SHOWN = {"m": "mm", "rad": "deg"}


def truth_text(mission: Mission, parameters: Parameters) -> str:
    """A CSV: at each record the temperature and what moves, with its unit in the column's name."""
    values = mission.truth.values_at(mission.times)
    units = [block.entry_unit for block in parameters.blocks for _ in block.entry_names]
    columns: dict[str, Array] = {
        "day": mission.times / DAY_S,
        "temperature_C": mission.truth.temperature_at(mission.times),
    }
    for name in mission.truth.moving:
        entry = mission.truth.names.index(name)
        unit = _SHOWN.get(units[entry], units[entry])
        columns[name if unit == "1" else f"{name}_{unit}"] = to_unit(values[:, entry], unit)
    cameras = mission.truth.camera_T_base_at(mission.times)
    columns |= {f"camera_{axis}_mm": cameras[:, i, 3] * _MM for i, axis in enumerate("xyz")}
    outlier = ["yes" if wrong else "no" for wrong in mission.outliers]
    rows = zip(mission.records.ids, *(v.tolist() for v in columns.values()), outlier, strict=True)
    return _csv(["pose_id", *columns, "outlier"], rows)


def schedule(mission: Mission) -> dict[str, Any]:
    """Events and power cuts by day, for other programs."""
    return {
        "days": mission.seconds / DAY_S,
        "began": mission.began,
        "events": [
            {"day": e.time / DAY_S, "kind": e.kind, "joint": e.joint or None, "label": e.label} for e in mission.events
        ],
        "power_cuts": [time / DAY_S for time in mission.power_cuts],
        "lost": mission.lost,
        "outliers": [text for text, wrong in zip(mission.records.ids, mission.outliers, strict=True) if wrong],
    }


def curve_text(curve: ErrorCurve, temperature: Array) -> str:
    """A CSV: errors over time."""
    rows = zip(
        (curve.times / DAY_S).round(6).tolist(),
        ["record" if each else "hour" for each in curve.is_record],
        (curve.frozen * _MM).round(6).tolist(),
        (curve.recalibrated * _MM).round(6).tolist(),
        curve.levels,
        temperature.round(3).tolist(),
        strict=True,
    )
    return _csv(["day", "moment", "frozen_mm", "recalibrated_mm", "level", "temperature_C"], rows)


def figures(name: str, mission: Mission, log: MissionLog, judged: Judgement) -> dict[str, Any]:
    """The whole judgement for other programs."""
    curve, counts = judged.curve, judged.records
    return {
        "mission": name,
        "days": mission.seconds / DAY_S,
        "limit_mm": judged.limit * _MM,
        "error_mm": {
            "frozen": _summary(curve.frozen[curve.is_hour]),
            "recalibrated": _summary(curve.recalibrated[curve.is_hour]),
        },
        "availability": judged.availability,
        "frozen_within_limit": judged.frozen_within,
        "events": [_event(report) for report in judged.events],
        "missed": judged.missed,
        "false_alarms": [_decision(false_alarm) for false_alarm in judged.false_alarms],
        "records": {key: getattr(counts, key) for key in counts.__dataclass_fields__},
        "power_cuts": [time / DAY_S for time in mission.power_cuts],
        "resumed": log.resumed,
        "hours_at_level": _hours(curve),
    }


def _event(report: EventReport) -> dict[str, Any]:
    return {
        "day": report.event.time / DAY_S,
        "kind": report.event.kind,
        "joint": report.event.joint or None,
        "label": report.event.label,
        "named": report.named,
        "decision": _decision(report.decision) if report.decision else None,
        "before_mm": report.before * _MM,
        "worst_mm": report.worst * _MM,
        "recovered_after_records": report.records,
        "recovered_after_hours": None if report.seconds is None else report.seconds / 3600,
    }


def _decision(decision: Decision) -> dict[str, Any]:
    return {
        "day": decision.time / DAY_S,
        "kind": decision.kind,
        "joint": decision.joint or None,
        "sentence": decision.sentence,
    }


def _hours(curve: ErrorCurve) -> dict[str, int]:
    held = [level for level, hour in zip(curve.levels, curve.is_hour, strict=True) if hour]
    return {level: held.count(level) for level in dict.fromkeys(held)}


def _summary(errors: Array) -> dict[str, float]:
    """Of hourly errors (m), in mm."""
    mm = errors * _MM
    return {
        "mean": float(mm.mean()),
        "median": float(np.median(mm)),
        "p95": float(np.percentile(mm, 95)),
        "max": float(mm.max()),
        "last": float(mm[-1]),
    }


def _csv(header: list[str], rows: Any) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return stream.getvalue()
