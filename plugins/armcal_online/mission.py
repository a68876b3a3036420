"""``armcal mission``: calibrated before launch, recalibrated record by record, compared with its truth."""

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from time import monotonic
from types import MappingProxyType
from typing import Annotated, Any, Self

import click
import numpy as np
from armcal.base.arrays import Array, Mask
from armcal.base.config_text import as_json
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.base.settings import InputPath, Length, Settings
from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import sealed
from armcal.cli.common import Console, overrides, speaking
from armcal.config.validate import validate
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError, NotConvergedError
from armcal.estimate.estimator import Progress, no_progress
from armcal.io.lines import StandardOutput
from armcal.io.plain_files import reserved, writing
from armcal.measure.tables import csv_text, write_csv
from armcal.plugins import PluginRegistry, discover
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment
from armcal.run.pipeline import calibrate
from armcal.run.result import calibration_content
from pydantic import Field, model_validator
from typing_extensions import override

from armcal_online.commands import header_of, opened
from armcal_online.mission_simulator import DAY_S, HOUR_S, Event, Mission, MissionOfDays, with_payload
from armcal_online.recalibrator import Recalibrator
from armcal_online.settings import SECTION as RECALIBRATE
from armcal_online.settings import RecalibrateSettings
from armcal_online.sources import Incoming, Lines, RowParser

SECTION = "mission"
BENCH, CALIBRATION, RECORDS, RECALIBRATION = "bench.csv", "calibration.yaml", "records.csv", "recalibration"
_MM = 1000.0
Series = Sequence[tuple[float, Array]]  # value vectors in order, with the time from which on each is used (s)
_NONE: Mapping[str, Series] = MappingProxyType({})
_USABLE = ("nominal", "watch")
_RECOVERED, _IN_A_ROW = 1.5, 3  # the error is within so many times that of the day before, so often in a row


class MissionRunSettings(Settings):
    """What the mission begins with, and how it is compared with the truth."""

    experiment: InputPath | None = None  # a configuration whose simulated records are calibrated first
    calibration: InputPath | None = None  # or a file that is there already
    limit: Annotated[Length, Field(gt=0)] = 0.003  # of the mean tip error, for the arm to be used
    poses: Annotated[int, Field(ge=1, le=5000)] = 200  # in which tips are compared

    @model_validator(mode="after")
    def _one_start(self) -> Self:
        if (self.experiment is None) == (self.calibration is None):
            raise ValueError("found both or neither of experiment and calibration, expected one of them")
        return self


@dataclass(frozen=True)
class MissionPlan:
    experiment: Experiment
    simulator: MissionOfDays
    settings: MissionRunSettings
    recalibrate: RecalibrateSettings

    @classmethod
    def load(cls, path: Path, overrides: Sequence[str] = (), registry: PluginRegistry | None = None) -> Self:
        """Read a mission; its sections ``mission`` and ``recalibrate`` are no part of an experiment."""
        source = load_config(path, overrides)
        settings = validate(MissionRunSettings, source, (SECTION,))
        stated = RECALIBRATE in source.data
        recalibrate = validate(RecalibrateSettings, source, (RECALIBRATE,)) if stated else RecalibrateSettings()
        rest = {key: value for key, value in source.data.items() if key not in (SECTION, RECALIBRATE)}
        experiment = Experiment.of(replace(source, data=rest), registry=registry or discover())
        simulator = experiment.simulator()
        if not isinstance(simulator, MissionOfDays):
            raise ConfigError(
                "this simulator knows no truth over time.",
                where=source.where(("simulation", "type")),
                hint="Write simulation: {type: mission, ...}.",
            )
        return cls(experiment, simulator, settings, recalibrate)

    def simulated(self) -> Mission:
        return self.simulator.mission(self.experiment.simulation_request)


def before_launch(plan: MissionPlan, folder: Path, progress: Progress = no_progress) -> Path:
    """The calibration to begin with: the one that is given, or that of simulated records of the bench."""
    settings = plan.settings
    if settings.calibration is not None:
        return settings.calibration
    bench = Experiment.load(settings.experiment or "", registry=plan.experiment.registry)
    made = bench.simulator().simulate(bench.simulation_request)
    write_csv(folder / BENCH, made, bench.request(measured=True).channels)
    again = Experiment.load(settings.experiment or "", data=folder / BENCH, registry=bench.registry)
    result = calibrate(again, progress=progress)
    if not result.estimate.verdict.converged:
        raise NotConvergedError(
            "the calibration before launch did not converge.", hint=f"Try armcal run {settings.experiment}."
        )
    path = folder / CALIBRATION
    path.write_text(sealed(calibration_content(result, again)), encoding="utf-8")
    return path


class PowerCutError(Exception):
    pass


class CutSource(Lines):
    """Records until, after so many, the power goes: nothing is finished, nothing more is written."""

    def __init__(self, path: Path, rows: RowParser, count: float) -> None:
        super().__init__(rows, path)
        self._count = count

    @override
    def incoming(self, wait_s: float) -> Incoming | None:
        incoming = super().incoming(wait_s)
        if incoming is not None and incoming.source_row > self._count + 1:  # the first line is the header
            raise PowerCutError
        return incoming


@dataclass
class MissionLog:
    verdicts: dict[str, str] = field(default_factory=dict)
    estimates: dict[float, Mapping[str, float]] = field(default_factory=dict)
    levels: list[tuple[float, str]] = field(default_factory=list)
    decisions: list[tuple[float, Mapping[str, Any]]] = field(default_factory=list)
    resumed: int = 0
    _now: float = 0.0

    def take(self, event: Mapping[str, Any], times: Mapping[str, float]) -> None:
        """An event without a record of its own has the time of the last record before it."""
        match event["event"]:
            case "started":
                self.resumed += event["resumed"]
                self.estimates.setdefault(0.0, {p["name"]: float(p["value"]) for p in event["parameters"]})
                self.levels = self.levels or [(0.0, event["level"])]
            case "record":
                self._now = times.get(event["id"], self._now)
                self.verdicts[event["id"]] = event["verdict"]
            case "estimate":
                self.estimates[self._now] = {name: float(pair[0]) for name, pair in event["parameters"].items()}
            case "level":
                self.levels.append((self._now, event["to"]))
            case "decision":
                self.decisions.append((self._now, event))


def recalibrated(plan: MissionPlan, mission: Mission, calibration: Path, folder: Path) -> MissionLog:
    """Through the loop that ``armcal recalibrate`` uses, anew from its journal after each power cut."""
    stream, registry, settings, log = io.BytesIO(), plan.experiment.registry, plan.recalibrate, MissionLog()
    every = settings.model_copy(update={"output": settings.output.model_copy(update={"estimate_every_records": 1})})
    for cut in (*np.searchsorted(mission.times, mission.power_cuts).tolist(), np.inf):
        session = Recalibrator(Calibration.load(calibration, registry), every, registry)
        source = CutSource(folder / RECORDS, RowParser(session.request, settings.columns), cut)
        kept = folder / RECALIBRATION
        going = opened(kept, header_of(kept, calibration, session), session, source, StandardOutput(stream))
        with suppress(PowerCutError), going as loop:
            loop.run()
            if not source.ended:
                raise KeyboardInterrupt
    times = dict(zip(mission.records.ids, mission.times.tolist(), strict=True))
    for line in stream.getvalue().splitlines():
        log.take(json.loads(line), times)
    return log


@dataclass(frozen=True)
class ErrorCurve:
    """Mean tip errors (m) by calibration, at every record and every hour (T, s since the mission began)."""

    times: Array
    is_hour: Mask
    is_record: Mask
    errors: Mapping[str, Array]
    levels: tuple[str, ...]


def error_curve(
    plan: MissionPlan, launch: Parameters, mission: Mission, log: MissionLog, references: Mapping[str, Series] = _NONE
) -> ErrorCurve:
    """Mean distance between a calibration's tip and the true one, as the camera sees it, in fixed random poses.

    A study adds ``references`` by name.
    """
    truth, system = mission.truth, plan.experiment.system
    if truth.parameters.entry_names != launch.entry_names:
        raise ConfigError(
            "the calibration's parameters are not those of the simulated arm.",
            hint="Let mission.experiment describe the same arm, effects and measurements as the mission.",
        )
    hours = np.arange(0.0, mission.settings.days * DAY_S, HOUR_S)
    times = np.unique(np.concatenate([mission.times, hours]))
    frozen, true = launch.nominal(), truth.values_at(times)
    began = dict(zip(launch.entry_names, frozen.tolist(), strict=True))
    estimates = [
        (time, np.array([values.get(n, x) for n, x in began.items()])) for time, values in log.estimates.items()
    ]
    series: dict[str, Series] = {"frozen": [(0.0, frozen)], **references, "recalibrated": estimates}
    differing = np.any(np.vstack([true, *(v for of_one in series.values() for _, v in of_one)]) != frozen, axis=0)
    free = launch.with_free([b.name for b in launch.blocks if differing[launch.entries_of(b.name)].any()])
    poses, instruments = random_poses(plan, mission), dict([next(iter(system.measurements.items()))])
    parts = (system.arms, instruments, free, system.environment, poses)
    problem = Problem.build(*parts, plan.experiment.settings.evaluator, groups={})
    seen = np.zeros((len(times), len(poses), 3))
    for i, camera in enumerate(truth.camera_T_base_at(times)):
        seen[i] = -problem.residuals(true[i])[0].T @ camera[:3, :3].T + camera[:3, 3]
    errors = {name: _errors(problem, of_one, times, seen) for name, of_one in series.items()}
    begun = np.searchsorted([time for time, _ in log.levels], times, side="right") - 1
    levels = tuple(log.levels[i][1] for i in begun)
    return ErrorCurve(times, np.isin(times, hours), np.isin(times, mission.times), errors, levels)


def random_poses(plan: MissionPlan, mission: Mission) -> Dataset:
    """Within the span of the records; a tip measured at zero leaves itself, negative, as the residual."""
    random, arm = np.random.default_rng(0), next(iter(plan.experiment.system.arms.values()))
    count, channels = plan.settings.poses, dict[str, Array]()
    for joint in arm.commanded:
        angles = mission.records.column(f"{arm.name}.{joint}")
        channels[f"{arm.name}.{joint}"] = random.uniform(angles.min(), angles.max(), count)
        channels[f"{arm.name}.approach.{joint}"] = random.choice([-1.0, 1.0], count)
    instrument = next(iter(plan.experiment.system.measurements))
    channels |= {name: np.zeros(count) for name in ("payload", *(f"{instrument}.{axis}" for axis in "xyz"))}
    return Dataset(tuple(map(str, range(count))), channels, source="random poses")


def _errors(problem: Problem, series: Series, times: Array, seen: Array) -> Array:
    """Of a calibration whose springs do not hold the arm, and which predicts nothing: as much as the tips lie apart."""
    errors, used = np.zeros(len(times)), -1
    for i, newest in enumerate(np.searchsorted([time for time, _ in series], times, side="right") - 1):
        if newest != used:
            used, now = newest, np.full_like(seen[i], np.nan)
            with suppress(NotConvergedError):
                now = -problem.residuals(series[newest][1])[0].T
        off = float(np.linalg.norm(now - seen[i], axis=1).mean())
        errors[i] = off if np.isfinite(off) else float(np.linalg.norm(np.ptp(seen[i], axis=0)))
    return errors


def figures(plan: MissionPlan, mission: Mission, log: MissionLog, curve: ErrorCurve) -> dict[str, Any]:
    limit, hour = plan.settings.limit, curve.is_hour
    usable = np.array([level in _USABLE for level in curve.levels]) & (curve.errors["recalibrated"] <= limit)
    verdicts = np.array([log.verdicts.get(text, "ignored") for text in mission.records.ids])
    events = sorted(mission.settings.events, key=lambda event: event.day)
    ends = [next((e.day for e in events if e.day > event.day), np.inf) * DAY_S for event in events]
    return {
        "mission": plan.experiment.name,
        "days": mission.settings.days,
        "began": mission.settings.began,
        "limit_mm": limit * _MM,
        "error_mm": {name: _summary(errors[hour] * _MM) for name, errors in curve.errors.items()},
        "within_limit": {name: float((errors[hour] <= limit).mean()) for name, errors in curve.errors.items()},
        "availability": float(usable[hour].mean()),
        "events": [_event(*pair, log, curve) for pair in zip(events, ends, strict=True)],
        "decisions": [{"day": time / DAY_S, **event} for time, event in log.decisions],
        "records": {
            "arrived": len(verdicts),
            "lost": mission.lost,
            **{verdict: int((verdicts == verdict).sum()) for verdict in ("accepted", "rejected", "ignored")},
            "good_rejected": int(((verdicts == "rejected") & ~mission.outliers).sum()),
            "outliers": int(mission.outliers.sum()),
            "outliers_accepted": int(((verdicts == "accepted") & mission.outliers).sum()),
        },
        "outliers": [text for text, wrong in zip(mission.records.ids, mission.outliers, strict=True) if wrong],
        "power_cuts": [time / DAY_S for time in mission.power_cuts],
        "resumed": log.resumed,
    }


def _summary(mm: Array) -> dict[str, float]:
    p95 = float(np.percentile(mm, 95))
    return {"mean": mm.mean(), "median": float(np.median(mm)), "p95": p95, "max": mm.max(), "last": mm[-1]}


def _event(event: Event, end: float, log: MissionLog, curve: ErrorCurve) -> dict[str, Any]:
    begun, error = event.day * DAY_S, curve.errors["recalibrated"]
    day_before = (curve.times < begun) & (curve.times >= begun - DAY_S)
    before = float(np.median(error[day_before if day_before.any() else slice(1)]))
    after = (curve.times >= begun) & (curve.times < end)
    following = np.flatnonzero(after & curve.is_record)
    good = error[following] <= _RECOVERED * before
    runs = (i for i in range(len(good) - _IN_A_ROW + 1) if good[i : i + _IN_A_ROW].all())
    first = None if event.grows else next(runs, None)
    decided = next(((time, made) for time, made in log.decisions if begun <= time < end), None)
    worst, count = float(error[after].max(initial=0.0)), 0 if first is None else first + 1
    if event.grows:
        aftermath = f"at worst {worst * _MM:.1f} mm"
    else:
        aftermath = f"recovered in {count} record{'s' if count > 1 else ''}" if count else "not recovered"
    return {
        "day": event.day,
        "label": event.label,
        "decision": decided and decided[1]["kind"],
        "decided_after_hours": decided and (decided[0] - begun) / HOUR_S,
        "aftermath": aftermath,
        "worst_mm": worst * _MM,
        "recovered_after_records": count or None,
    }


def curve_text(curve: ErrorCurve, mission: Mission) -> str:
    """A CSV: errors, level and temperature over time, and the true values of what moves (SI)."""
    truth, values = mission.truth, mission.truth.values_at(curve.times)
    columns: dict[str, Sequence[Any]] = {
        "day": (curve.times / DAY_S).round(6).tolist(),
        "moment": ["record" if is_record else "hour" for is_record in curve.is_record],
        **{f"{name}_mm": (errors * _MM).round(6).tolist() for name, errors in curve.errors.items()},
        "level": curve.levels,
        "temperature_C": truth.temperature_at(curve.times).round(3).tolist(),
        **{truth.parameters.entry_names[i]: values[:, i].tolist() for i in np.flatnonzero(np.ptp(values, axis=0))},
    }
    return csv_text([columns, *zip(*columns.values(), strict=True)], "")


def run_mission(
    plan: MissionPlan, folder: Path, progress: Progress = no_progress
) -> tuple[Mission, ErrorCurve, dict[str, Any]]:
    """The whole mission in a folder, its records as a CSV that ``armcal recalibrate`` takes too."""
    experiment, mission = plan.experiment, plan.simulated()
    write_csv(folder / RECORDS, mission.records, experiment.request(measured=True).channels)
    path = before_launch(plan, folder, progress)
    launch = with_payload(Calibration.load(path, experiment.registry).parameters)
    log = recalibrated(plan, mission, path, folder)
    curve = error_curve(plan, launch, mission, log)
    return mission, curve, figures(plan, mission, log, curve)


FIGURES = ("mission.csv", "mission.json", "mission.png")
OURS = (BENCH, RECORDS, CALIBRATION, RECALIBRATION, *FIGURES)  # an earlier mission's move to earlier/N
_INK = "#333333"
_CURVES = {  # colour, width and name, those above last
    "frozen": ("#b5542a", 1.2, "frozen at launch"),
    "recalibrated": ("#1f5fa8", 1.5, "recalibrated"),
}
_LEVELS = {"nominal": "#4c9f70", "watch": "#e3c14b", "suspect": "#dd7f33", "lost": "#b8322f"}
_NIGHT = (18.0, 30.0)  # hours from the mission's midnight


@click.command()
@click.argument("config", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Where the mission goes.")
@overrides
@speaking
def mission(console: Console, config: Path, out: Path, overrides: tuple[str, ...]) -> None:
    """Simulate the mission of CONFIG, recalibrate over all of it, and compare that with the truth."""
    import_module("matplotlib")  # if it is missing, the command ends now
    began = monotonic()
    kept = click.get_current_context().with_resource(reserved(out, OURS))
    plan = MissionPlan.load(config, overrides, console.registry())
    kept.place({})
    with console.progress() as progress:
        made, curve, content = run_mission(plan, out, progress)
    texts = (curve_text(curve, made).encode(), f"{as_json(content)}\n".encode(), mission_figure(curve, content))
    with writing(out, "Check the room on the disk."):
        for name, data in zip(FIGURES, texts, strict=True):
            (out / name).write_bytes(data)
    console.result({**content, "folder": str(out)})
    rows, share = list[tuple[str, ...]](), content["within_limit"]
    for name, sizes in content["error_mm"].items():
        rows.append((_CURVES[name][2], *(f"{size:.3f}" for size in sizes.values()), f"{share[name]:.1%}"))
    columns = ("calibration", "mean", "median", "95 %", "max", "last", f"within {content['limit_mm']:g} mm")
    console.table(f"Mean tip error over {content['days']:g} days, mm", columns, rows)
    for line in _lines(content):
        console.line(line)
    console.line(f"figure: {out / 'mission.png'}  ({monotonic() - began:.1f} s)")


def _lines(content: Mapping[str, Any]) -> Iterator[str]:
    for event in content["events"]:
        after = event["decided_after_hours"]
        decided = "nothing decided" if after is None else f"{event['decision']} after {after:.1f} h"
        yield f"day {event['day']:.2f}: {event['label']}: {decided}, {event['aftermath']}"
    counts = content["records"]
    yield f"{len(content['decisions'])} decisions; available {content['availability']:.1%} of the time"
    yield (
        f"{counts['arrived']} records: {counts['accepted']} accepted, {counts['rejected']} rejected "
        f"({counts['good_rejected']} of them good), {counts['ignored']} ignored; "
        f"{counts['outliers_accepted']} of {counts['outliers']} outliers accepted"
    )


def mission_figure(curve: ErrorCurve, content: Mapping[str, Any]) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    figure = Figure(figsize=(11.5, 5.6), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    axes, band = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [16, 1], "hspace": 0.02})
    days, at, limit = content["days"], curve.times / DAY_S, content["limit_mm"]
    for day in range(-1, int(np.ceil(days))):
        axes.axvspan(*(day + hour / 24 for hour in _NIGHT), color="#eef0f4", lw=0, zorder=0)
    for height, (name, (color, width, label)) in enumerate(_CURVES.items(), 3):
        axes.plot(at, 1000 * curve.errors[name], color=color, lw=width, label=label, zorder=height)
    axes.axhline(limit, color=_INK, lw=0.9, ls=(0, (5, 4)), zorder=2, label=f"limit {limit:g} mm")
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 3)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.minorticks_off()
    axes.grid(axis="y", color="#d9d9d9", lw=0.6)
    axes.set_ylabel("mean tip error, mm")
    over = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "fontsize": 8.5}
    for i, event in enumerate(content["events"]):
        axes.axvline(event["day"], color=_INK, lw=1.0, zorder=3)
        side, text = ("right" if event["day"] > 0.7 * days else "left"), f"{event['label']}\n{event['aftermath']}"
        axes.annotate(text, (event["day"], 1.0), xytext=(0, 4 + 24 * (i % 2)), ha=side, **over)
    for day in content["power_cuts"]:
        axes.axvline(day, color=_INK, lw=0.9, ls=":", zorder=3)
        axes.annotate("power cut", (day, 1.0), xytext=(3, -4), rotation=90, va="top", **over)
    changes = np.flatnonzero([a != b for a, b in zip(curve.levels, curve.levels[1:], strict=False)]) + 1
    named = set[str]()
    for first, last in zip([0, *changes], [*changes, len(at)], strict=True):
        level, end = curve.levels[first], days if last == len(at) else at[last]
        band.axvspan(at[first], end, color=_LEVELS[level], lw=0, label=None if level in named else level)
        named.add(level)
    band.set_yticks([])
    band.set_ylabel("level", rotation=0, ha="right", va="center")
    band.set_xlabel("days since the mission began")
    band.set_xlim(0, days)
    figure.suptitle(content["mission"], x=0.01, ha="left", fontsize=12)
    figure.legend(loc="outside lower center", ncols=5, fontsize=8.5, frameon=False)
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()
