"""The robust refits that a mission is compared with, against the estimator that calibrations use, and against truth."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from armcal.base.arrays import Array
from armcal.base.parameters import Parameters
from armcal.estimate.estimator import Solution, SolverVerdict
from armcal.estimate.robust import reweighted
from armcal.problem.problem import Problem
from armcal_online.mission import MissionLog, MissionPlan, Series, error_curve
from armcal_online.mission_simulator import DAY_S, Mission, with_payload

from tests.mission_refits import refits, robust_fit

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm" / "mission.yaml"
SLIP = "{kind: slip, day: 1, joint: arm.q3, changes: {arm.mdh.theta3: 5 deg}}"
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
    return plan().simulated()


def launch() -> Array:
    """The truth before the mission: a calibration that could not be better."""
    return mission().truth.values_at(np.zeros(1))[0]


def at_launch() -> Parameters:
    return with_payload(plan().experiment.parameters).with_nominal(launch())


@lru_cache
def problem() -> Problem:
    system = plan().experiment.system
    return Problem.build(system.arms, system.measurements, at_launch(), system.environment, mission().records, "auto")


def before_the_slip() -> Array:
    return np.flatnonzero(mission().times < DAY_S)


@lru_cache
def series() -> dict[str, Series]:
    return refits(plan(), at_launch(), mission(), 20, 30)


@pytest.mark.slow
def test_a_refit_is_where_the_estimator_of_calibrations_comes_to_rest() -> None:
    made = problem()
    records = made.of(mission().records).subset(before_the_slip()).records
    values = robust_fit(made.with_records(records), (launch(),))
    estimator = plan().experiment.estimator
    first = Solution(launch(), SolverVerdict("start", "", True, 0, 0.0))  # least squares would follow the outliers
    by_ipopt = reweighted(made.with_records(records), estimator, first, "cauchy").solution.values
    tips = [made.with_records(records).residuals(v)[0] for v in (values, by_ipopt)]
    assert np.abs(tips[0] - tips[1]).max() < 5e-6  # m


@pytest.mark.slow
def test_a_refit_from_a_start_far_off_goes_to_the_next_start() -> None:
    made = problem()
    records = made.of(mission().records).subset(before_the_slip()).records
    lost = launch()
    lost[made.parameters.entry_names.index("arm.mdh.theta2")] += 2.5
    values = robust_fit(made.with_records(records), (lost, launch()))
    assert np.median(np.linalg.norm(made.with_records(records).residuals(values)[0], axis=0)) < 0.002


@pytest.mark.slow
def test_refits_come_every_so_many_records_and_follow_a_slip() -> None:
    made, known = mission(), series()
    recent, all_ = known["refit_recent"], known["refit"]
    count = len(made.records)
    assert [time for time, _ in recent[1:]] == [made.times[last - 1] for last in range(20, count + 1, 30)]
    assert len(all_) >= 2 and all_[1][0] == recent[1][0]
    place = made.truth.parameters.entry_names.index("arm.mdh.theta3")
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
    values[mission().truth.parameters.entry_names.index("arm.spring.k2")] = 60.0
    log = MissionLog(estimates={0.0: {}}, levels=[(0.0, "nominal")])
    few = MissionPlan.load(CONFIG, (*SETTINGS, "mission.poses=10"))
    made = error_curve(few, at_launch(), mission(), log, {"refit": ((0.0, values),)})
    assert made.errors["refit"].min() > 0.3 and made.errors["refit"].max() < 1.5
    assert made.errors["frozen"].max() < 0.2


def test_too_few_records_make_no_refit() -> None:
    assert refits(plan(), at_launch(), mission(), 999) == {}
