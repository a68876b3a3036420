"""The run that melted joint 4: 15 s a pose, loaded, without a pause; judged by a servo that is not the planner's."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest
from armcal.run.experiment import Experiment
from armcal_bench.bench import ServoHeatSettings
from armcal_bench.drive import travel
from armcal_bench.hazards import HeatModel
from armcal_bench.preparation import (
    LeaveOut,
    Measure,
    Rest,
    ScheduleForecast,
    Scheduler,
    forecast_schedule,
    prepare,
)
from armcal_simulation.servos import ServoHeat, ServoJointSettings

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm"
TRUTH = ServoJointSettings.si(continuous=0.3, winding_time=60.0, case_time=900.0, winding_share=0.3)
"""A winding inside its case, as the simulated bench has it for joint 4."""
POSES, CAPTURE_S = 190, 12.0
Q4 = 3
BUDGET = ServoHeatSettings.si(continuous=1.0).budget


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Scheduler:
    plan = tmp_path_factory.mktemp("loaded") / "plan.csv"
    lines = (CONFIGS / "demo.csv").read_text().splitlines()
    plan.write_text("\n".join(lines[: POSES + 1]) + "\n")
    experiment = Experiment.load(CONFIGS / "bench.yaml", ("plan.clearance=null",))
    return replace(prepare(experiment, plan).scheduler, capture=CAPTURE_S)


def with_constants(scheduler: Scheduler, wrong: np.ndarray, budget: float) -> Scheduler:
    """The planner's constants of joint 4 (continuous, winding, case, share) as a part of the true ones."""
    model = scheduler.model
    continuous, times, shares, budgets = (a.copy() for a in (model.continuous, model.times, model.shares, model.budget))
    continuous[Q4] = TRUTH.continuous * wrong[0]
    times[Q4] = TRUTH.winding_time * wrong[1], TRUTH.case_time * wrong[2]
    share = TRUTH.winding_share * wrong[3]
    shares[Q4], budgets[Q4] = (share, 1 - share), budget
    return replace(scheduler, model=HeatModel(continuous, times, shares, budgets, model.torques))


def truly(scheduler: Scheduler, forecast: ScheduleForecast) -> np.ndarray:
    """Time (s) and true heat of joint 4 after each step, and where it was hottest (steps x 3)."""
    servo, heat, now = ServoHeat(TRUTH), [], 0.0
    for step in forecast.steps:
        if isinstance(step, LeaveOut):
            continue
        hottest = 0.0
        for start, goal in pairwise(step.path):
            for part in (np.arange(6) + 0.5) / 6:
                torque = scheduler.model.torques(start + part * (goal - start))[Q4]
                servo.advance(travel((start, goal)) / scheduler.rate / 6, float(torque))
                hottest = max(hottest, servo.winding)
        servo.advance(
            step.seconds - travel(step.path) / scheduler.rate, float(scheduler.model.torques(step.path[-1])[Q4])
        )
        now += step.seconds
        heat.append((now, servo.winding, max(hottest, servo.winding)))
    return np.array(heat)


def whole_forecast(scheduler: Scheduler) -> ScheduleForecast:
    return forecast_schedule(scheduler, scheduler.park, scheduler.model.cold, list(range(POSES)))


@pytest.mark.slow
def test_without_reckoning_with_heat_joint_4_fails_after_about_half_an_hour(scheduler: Scheduler) -> None:
    careless = with_constants(scheduler, np.ones(4), np.inf)
    forecast = whole_forecast(careless)
    heat = truly(careless, forecast)
    assert not any(isinstance(step, Rest) for step in forecast.steps)
    failed = heat[heat[:, 2] > 1.0, 0]
    assert len(failed) and 20 < failed[0] / 60 < 40


@pytest.mark.parametrize("wrong", list(product([0.7, 1.3], repeat=4)))
@pytest.mark.quick("wrong10")
def test_with_rests_it_stays_below_its_limit_though_every_constant_is_wrong_by_up_to_30_percent(
    scheduler: Scheduler, wrong: tuple[float, ...]
) -> None:
    careful = with_constants(scheduler, np.array(wrong), BUDGET)
    forecast = whole_forecast(careful)
    heat = truly(careful, forecast)
    assert any(isinstance(step, Rest) for step in forecast.steps)
    assert heat[:, 2].max() < 1.0
    left_out = [step.why for step in forecast.steps if isinstance(step, LeaveOut)]
    assert sum(isinstance(step, Measure) for step in forecast.steps) + len(left_out) == POSES
    assert all("even from cold" in why or "do not cool enough" in why for why in left_out)
    assert len(left_out) < 0.25 * POSES and not (left_out and wrong[0] > 1)
