"""The robust refits that a mission is compared with, against the estimator that calibrations use, and against truth."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from armcal.base.arrays import Array
from armcal.estimate.estimator import Solution, SolverVerdict
from armcal.estimate.robust import reweighted
from armcal.estimate.simulation import DAY_S, Mission
from armcal.problem.problem import Problem
from armcal_online.mission.errors import error_curve
from armcal_online.mission.judge import ErrorCurve, judge
from armcal_online.mission.log import MissionLog
from armcal_online.mission.mission import simulated
from armcal_online.mission.references import Series, refits, robust_fit
from armcal_online.mission.settings import MissionPlan, RefitSettings

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm" / "mission.yaml"
SLIP = "{kind: slip, day: 1, joint: arm.q3, parameter: arm.mdh.theta3, angle_deg: 5}"
SETTINGS = (
    "simulation.days=3",
    "simulation.records.every_min=20",
    f"simulation.events=[{SLIP}]",
    "simulation.outliers={fraction: 0.2, size_mm: 30, largest_mm: 500}",
    "simulation.power_cuts=[]",
)


@lru_cache
def plan() -> MissionPlan:
    return MissionPlan.load(CONFIG, SETTINGS)


@lru_cache
def mission() -> Mission:
    return simulated(plan())


def launch() -> Array:
    """The truth before the mission: a calibration that could not be better."""
    return mission().truth.values_at(np.zeros(1))[0]


@lru_cache
def problem() -> Problem:
    system, parameters = plan().experiment.system, plan().experiment.parameters.with_nominal(launch())
    return Problem.build(system.arms, system.measurements, parameters, system.environment, mission().records, "auto")


def before_the_slip() -> Array:
    return np.flatnonzero(mission().times < DAY_S)


@lru_cache
def series() -> dict[str, Series]:
    system, parameters = plan().experiment.system, plan().experiment.parameters.with_nominal(launch())
    return refits(system, parameters, mission(), RefitSettings(records=20, every=30), "auto")


@pytest.mark.slow
def test_a_refit_is_where_the_estimator_of_calibrations_comes_to_rest() -> None:
    made = problem()
    records = made.subset(made.records(mission().records), before_the_slip())
    values = robust_fit(made, records, (launch(),))
    estimator = plan().experiment.estimator
    first = Solution(launch(), SolverVerdict("start", "", True, 0, 0.0))  # least squares would follow the outliers
    by_ipopt = reweighted(made, records, estimator, first, "cauchy").solution.values
    tips = [made.residuals(v, records)[0] for v in (values, by_ipopt)]
    assert np.abs(tips[0] - tips[1]).max() < 5e-6  # m


@pytest.mark.slow
def test_a_refit_from_a_start_far_off_goes_to_the_next_start() -> None:
    made = problem()
    records = made.subset(made.records(mission().records), before_the_slip())
    lost = launch()
    lost[made.parameters.entry_names.index("arm.mdh.theta2")] += 2.5
    values = robust_fit(made, records, (lost, launch()))
    assert np.median(np.linalg.norm(made.residuals(values, records)[0], axis=0)) < 0.002


@pytest.mark.slow
def test_refits_come_every_so_many_records_and_follow_a_slip() -> None:
    made, known = mission(), series()
    recent, all_ = known["refit_recent"], known["refit"]
    count = len(made.records)
    assert [time for time, _ in recent[1:]] == [made.times[last - 1] for last in range(20, count + 1, 30)]
    assert len(all_) >= 2 and all_[1][0] == recent[1][0]
    place = made.truth.names.index("arm.mdh.theta3")
    times = np.array([time for time, _ in recent])
    moved = np.degrees([values[place] - launch()[place] for _, values in recent])
    slipped = DAY_S
    after = np.searchsorted(made.times, slipped) + 20  # a window of records from after the slip alone
    late = times >= made.times[after]
    assert late.any() and np.abs(moved[late] - 5).max() < 1.5
    assert np.abs(moved[times < slipped]).max() < 1.5


def test_a_calibration_that_holds_the_arm_in_no_pose_is_as_far_off_as_the_tips_lie_apart() -> None:
    """A compliance of 60 rad/Nm lets a joint fall: no tip is predicted, and the mission is judged all the same."""
    values = launch()
    values[mission().truth.names.index("arm.spring.k2")] = 60.0
    log = MissionLog({}, ((0.0, {}),), ((0.0, "nominal"),), (), 0)
    system, parameters = plan().experiment.system, plan().experiment.parameters.with_nominal(launch())
    settings = plan().settings.model_copy(update={"poses": 10})
    made = error_curve(system, parameters, mission(), log, settings, "auto", {"refit": ((0.0, values),)})
    assert made.errors["refit"].min() > 0.3 and made.errors["refit"].max() < 1.5
    assert made.frozen.max() < 0.2


def test_too_few_records_make_no_refit() -> None:
    system, parameters = plan().experiment.system, plan().experiment.parameters
    assert refits(system, parameters, mission(), RefitSettings(records=999), "auto") == {}


def curve(filter_mm: Array, refit_mm: Array | None) -> ErrorCurve:
    hours = 3600.0 * np.arange(96)
    errors = {"frozen": np.full(96, 0.01)}
    errors |= {} if refit_mm is None else {"refit_recent": refit_mm / 1000}
    levels, whole = ("nominal",) * 96, np.ones(96, dtype=bool)
    return ErrorCurve(hours, whole, whole, {**errors, "recalibrated": filter_mm / 1000}, levels)


def test_the_worst_day_is_that_with_the_largest_ratio_since_the_first_refit() -> None:
    """Frozen for ten hours; the filter is at twice the refit's error on the third day, at 9 before any refit."""
    refit, filtered = np.full(96, 1.0), np.full(96, 0.5)
    refit[:10], filtered[:10] = 10.0, 90.0
    filtered[58:82] = 2.0
    log = MissionLog({}, ((0.0, {}),), ((0.0, "nominal"),), (), 0)
    made = replace(mission(), events=(), seconds=4 * DAY_S)
    judged = judge(made, log, curve(filtered, refit), 0.003, 1.5)
    assert judged.worst is not None and judged.worst.ratio == pytest.approx(2.0)
    assert judged.worst.since == 58 * 3600.0
    assert judged.within("recalibrated") == pytest.approx(86 / 96) and judged.within("frozen") == 0.0
    assert judged.quiet == pytest.approx(4 * DAY_S)
    assert judge(made, log, curve(filtered, None), 0.003, 1.5).worst is None
