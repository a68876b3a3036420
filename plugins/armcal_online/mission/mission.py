"""A mission: simulated, calibrated before launch, recalibrated record by record, and judged against the truth."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import sealed
from armcal.errors import ConfigError, InputError, NotConvergedError
from armcal.estimate.estimator import Progress, no_progress
from armcal.estimate.simulation import Mission
from armcal.io.plain_files import check_output
from armcal.measure.csv_writer import write_csv
from armcal.plugins import PluginRegistry
from armcal.run.experiment import Experiment
from armcal.run.outputs import calibration_content
from armcal.run.pipeline import calibrate
from armcal.run.prepare import Stopwatch
from typing_extensions import override

from armcal_online.mission.errors import error_curve
from armcal_online.mission.judge import Judgement, judge
from armcal_online.mission.log import MissionLog, read_mission_log
from armcal_online.mission.references import refits
from armcal_online.mission.settings import MissionPlan
from armcal_online.sources.source import Incoming, Source
from armcal_online.tracking.settings import RecalibrateSettings

SOURCE_KEY = "mission"

CALIBRATION = "calibration.yaml"
BENCH = "bench.csv"
RECORDS = "records.csv"
RECALIBRATION = "recalibration"


class PowerCutError(Exception):
    """The power is gone: nothing is finished, nothing more is written."""


def as_incoming(records: Dataset, times: Array, began: float) -> tuple[Incoming, ...]:
    """Records as they arrive, by the mission's clock (times in s since it began)."""
    names = list(records.channels)
    columns = [records.channels[name].tolist() for name in names]
    labels = list(records.extra)
    return tuple(
        Incoming(
            record_id=records.ids[i],
            channels={name: column[i] for name, column in zip(names, columns, strict=True)},
            labels={name: records.extra[name][i] for name in labels},
            arrived=began + float(times[i]),
            source_key=SOURCE_KEY,
            source_row=i + 1,
        )
        for i in range(len(records))
    )


class MissionSource(Source):
    """Records one after another; see ``Source``. After row ``cut`` the power goes."""

    keeps_records = True

    def __init__(self, records: Sequence[Incoming], cut: int | None = None) -> None:
        self._records, self._cut = records, cut
        self._next = 0

    @property
    @override
    def ended(self) -> bool:
        return self._next >= len(self._records) and self._cut is None

    @override
    def resume(self, positions: Mapping[str, int]) -> None:
        self._next = positions.get(SOURCE_KEY, 0)

    @override
    def incoming(self, wait_s: float) -> Incoming | None:
        """Raises:
        PowerCutError: it is time.
        """
        if self._cut is not None and self._next >= self._cut:
            raise PowerCutError
        if self._next >= len(self._records):
            return None
        self._next += 1
        return self._records[self._next - 1]


Session = Callable[[Path, RecalibrateSettings, MissionSource, Path], Sequence[Mapping[str, Any]]]
"""Recalibrates a calibration from a source until that ends, resuming what is in the folder; the events that it wrote,
those up to a power cut, which it does not raise."""


@dataclass(frozen=True)
class MissionResult:
    """A mission as it went."""

    mission: Mission
    calibration: Calibration
    log: MissionLog
    judgement: Judgement


def simulated(plan: MissionPlan) -> Mission:
    """The mission's records and truth.

    Raises:
        ConfigError: the simulation does not fit the arm.
    """
    mission = plan.simulator.mission(plan.experiment.simulation_request)
    if not len(mission.records):
        raise ConfigError(
            "no record arrives in this mission.",
            where=plan.experiment.source.where(("simulation",)),
            hint="Make it longer, or lose fewer records.",
        )
    return mission


def before_launch(plan: MissionPlan, folder: Path, progress: Progress = no_progress) -> Path:
    """The calibration to begin with: the one that is given, or that of simulated records of the bench.

    Raises:
        InputError: the experiment is refused.
        NotConvergedError: it did not converge.
    """
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
    check_output(path, InputError)
    path.write_text(sealed(calibration_content(result, again)), encoding="utf-8")
    return path


def recalibrated(
    mission: Mission, calibration: Path, settings: RecalibrateSettings, session: Session, folder: Path
) -> MissionLog:
    incoming = as_incoming(mission.records, mission.times, mission.began)
    every = settings.model_copy(update={"output": settings.output.model_copy(update={"estimate_every_records": 1})})
    cuts = [int(np.searchsorted(mission.times, time)) for time in mission.power_cuts]
    events: list[Mapping[str, Any]] = []
    for cut in (*cuts, None):
        events += session(calibration, every, MissionSource(incoming, cut), folder)
    return read_mission_log(events, mission)


def run_mission(
    plan: MissionPlan,
    folder: Path,
    session: Session,
    registry: PluginRegistry,
    progress: Progress = no_progress,
    watch: Stopwatch | None = None,
) -> MissionResult:
    """The whole mission in a folder, its records as a CSV that ``armcal recalibrate`` takes too.

    Raises:
        InputError: the mission, or what it begins with, is refused.
        NotConvergedError: the calibration before launch did not converge.
    """
    watch = watch or Stopwatch()
    with watch.stage("simulate"):
        mission = simulated(plan)
        write_csv(folder / RECORDS, mission.records, plan.experiment.request(measured=True).channels)
    with watch.stage("calibrate"):
        path = before_launch(plan, folder, progress)
        calibration = Calibration.load(path, registry)
    with watch.stage("recalibrate"):
        log = recalibrated(mission, path, plan.recalibrate, session, folder / RECALIBRATION)
    settings, experiment = plan.settings, plan.experiment
    system, evaluator, start = experiment.system, experiment.settings.evaluator, calibration.parameters
    with watch.stage("refit"):
        at_launch = experiment.parameters.with_nominal(start.nominal())
        references = refits(system, at_launch, mission, settings.refit, evaluator)
    with watch.stage("judge"):
        curve = error_curve(system, start, mission, log, settings, evaluator, references)
        judged = judge(mission, log, curve, settings.limit, settings.recovered)
    return MissionResult(mission, calibration, log, judged)
