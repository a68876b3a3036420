"""The files that a mission leaves: its truth, its errors over time, its figures."""

import csv
import io
import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np
import yaml
from armcal.base.arrays import Array
from armcal.base.config_text import as_json
from armcal.base.parameters import Parameters
from armcal.base.units import to_unit
from armcal.errors import InputError
from armcal.estimate.simulation import DAY_S, Mission
from armcal.io.plain_files import check_output, writing

from armcal_online.mission.decisions import Verdict
from armcal_online.mission.figure import mission_figure
from armcal_online.mission.judge import ErrorCurve, EventReport, Judgement
from armcal_online.mission.log import Decision, MissionLog
from armcal_online.mission.mission import MissionResult
from armcal_online.mission.settings import MissionPlan

SURPRISE = "surprise.yaml"
_MM = 1000.0
_SHOWN = {"m": "mm", "rad": "deg"}


def write_files(folder: Path, plan: MissionPlan, result: MissionResult, content: Mapping[str, Any]) -> None:
    """Write the truth, the errors, the judgement's figures (``content``) and the figure.

    Raises:
        InputError: a file cannot be written, or a link or device stands in its place.
    """
    curve, truth, name = result.judgement.curve, result.mission.truth, plan.experiment.name
    texts = {
        "truth.csv": truth_text(result.mission, plan.experiment.parameters),
        "truth.json": json.dumps(schedule(result.mission), indent=2) + "\n",
        "mission.csv": curve_text(curve, truth.temperature_at(curve.times)),
        "mission.json": as_json(content) + "\n",
    }
    if plan.planted:
        texts[SURPRISE] = surprise_text(plan)
    files = {name: text.encode() for name, text in texts.items()}
    files["mission.png"] = mission_figure(result.mission, result.judgement, name, plan.settings.refit.records)
    with writing(folder, "Check the room on the disk."):
        for name, data in files.items():
            check_output(folder / name, InputError)
            (folder / name).write_bytes(data)


def surprise_text(plan: MissionPlan) -> str:
    name = plan.experiment.source.path.name
    above = f"# What was planted. Beside {name} this file repeats the mission, whatever later versions would draw.\n"
    content = {"extends": name, **plan.planted}
    return above + yaml.safe_dump(content, default_flow_style=None, sort_keys=False, width=100)


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
    hung = mission.truth.payload_at(mission.times)
    columns |= {"payload_g": hung[:, 0] * _MM} | {f"payload_{a}_mm": hung[:, i] * _MM for i, a in enumerate("xyz", 1)}
    flags = [["yes" if flag else "no" for flag in flags] for flags in (mission.outliers, mission.exchanged)]
    rows = zip(mission.records.ids, *(v.tolist() for v in columns.values()), *flags, strict=True)
    return _csv(["pose_id", *columns, "outlier", "exchanged"], rows)


def schedule(mission: Mission) -> dict[str, Any]:
    """Events and power cuts by day, for other programs."""
    return {
        "days": mission.seconds / DAY_S,
        "began": mission.began,
        "events": [
            {
                "day": e.time / DAY_S,
                "until_day": e.until / DAY_S,
                "kind": e.kind,
                "joint": e.joint or None,
                "label": e.label,
            }
            for e in mission.events
        ],
        "power_cuts": [time / DAY_S for time in mission.power_cuts],
        "lost": mission.lost,
        "outliers": [text for text, wrong in zip(mission.records.ids, mission.outliers, strict=True) if wrong],
        "exchanged": [text for text, other in zip(mission.records.ids, mission.exchanged, strict=True) if other],
    }


def curve_text(curve: ErrorCurve, temperature: Array) -> str:
    """A CSV: errors over time."""
    rows = zip(
        (curve.times / DAY_S).round(6).tolist(),
        ["record" if is_record else "hour" for is_record in curve.is_record],
        *((errors * _MM).round(6).tolist() for errors in curve.errors.values()),
        curve.levels,
        temperature.round(3).tolist(),
        strict=True,
    )
    return _csv(["day", "moment", *(f"{name}_mm" for name in curve.errors), "level", "temperature_C"], rows)


def figures(name: str, mission: Mission, log: MissionLog, judged: Judgement) -> dict[str, Any]:
    """The whole judgement for other programs."""
    curve = judged.curve
    levels = [level for level, hour in zip(curve.levels, curve.is_hour, strict=True) if hour]
    return {
        "mission": name,
        "days": mission.seconds / DAY_S,
        "limit_mm": judged.limit * _MM,
        "error_mm": {name: _summary(errors[curve.is_hour]) for name, errors in curve.errors.items()},
        "within_limit": {name: judged.within(name) for name in curve.errors},
        "worst_ratio_to_recent_refit": (
            None
            if judged.worst is None
            else {"ratio": judged.worst.ratio, "since_day": judged.worst.since / DAY_S, "days": 1}
        ),
        "availability": judged.availability,
        "events": [_event(report) for report in judged.events],
        "decisions": {verdict: judged.count(verdict) for verdict in get_args(Verdict)},
        "false_alarms": [_decision(false_alarm) for false_alarm in judged.false_alarms],
        "quiet_days": judged.quiet / DAY_S,
        "records": dict(judged.records),
        "power_cuts": [time / DAY_S for time in mission.power_cuts],
        "resumed": log.resumed,
        "hours_at_level": Counter(levels),
    }


def _event(report: EventReport) -> dict[str, Any]:
    """What happened at one moment, and what became of it."""
    occurrence, decision = report.occurrence, report.finding.decision
    return {
        "day": occurrence.time / DAY_S,
        "kinds": [event.kind for event in occurrence.events],
        "joints": [event.joint or None for event in occurrence.events],
        "label": occurrence.label,
        "named": report.finding.verdict,
        "decision": _decision(decision) if decision else None,
        "decided_after_hours": (decision.time - occurrence.time) / 3600 if decision else None,
        "aftermath": report.aftermath,
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
        "candidates": list(decision.candidates),
        "sentence": decision.sentence,
    }


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
