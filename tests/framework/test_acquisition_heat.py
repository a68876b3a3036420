from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from armcal_bench.bench import ServoHeatSettings
from armcal_bench.drive import PathPlanner, travel
from armcal_bench.hazards import NEVER, HeatModel
from armcal_bench.preparation import LeaveOut, Measure, Rest, Scheduler, forecast_schedule
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

JOINTS = ("q1", "q2")


def torques(pose: np.ndarray) -> np.ndarray:
    """A level arm: joint 2 carries 2 N m when it lies flat and nothing when it hangs."""
    return np.array([0.1, 2.0 * np.sin(pose[1])])


HEAT = HeatModel.of(JOINTS, {"q2": ServoHeatSettings.si(continuous=1.0, case_time=600.0, budget=0.6)}, torques)


def scheduler(poses: np.ndarray, model: HeatModel = HEAT, check=None) -> Scheduler:
    limits = np.array([[-np.pi, np.pi]] * 2)
    park = np.zeros(2)
    planner = PathPlanner(check, limits, np.vstack([park, poses]), 0.02)
    names = tuple(f"p{i}" for i in range(len(poses)))
    return Scheduler(poses, names, 0 * poses, park, planner, model, np.deg2rad(20), 8.0)


def test_heat_follows_its_differential_equations() -> None:
    thermal_state, torque = np.array([[0.0, 0.0], [0.2, 0.1]]), np.array([0.3, 0.9])
    found = HEAT.heat(HEAT.after(thermal_state, torque, 400.0))

    def rise(time: float, parts: np.ndarray) -> np.ndarray:
        return (0.81 - parts) / [60.0, 600.0]

    parts = solve_ivp(rise, (0, 400), [0.2, 0.1], rtol=1e-10, atol=1e-12).y[:, -1]
    assert found[1] == pytest.approx(0.3 * parts[0] + 0.7 * parts[1], rel=1e-8)
    assert found[0] == 0.0, "a joint that is not reckoned with stays cold"


@settings(max_examples=50, deadline=None)
@given(st.floats(0.1, 3.0), st.floats(0.0, 0.9), st.floats(1.0, 300.0), st.floats(1.0, 300.0))
def test_heat_does_not_hang_on_how_time_is_cut(torque: float, warm: float, first: float, second: float) -> None:
    load, now = np.array([0.0, torque]), np.full((2, 2), warm)
    whole = HEAT.after(now, load, first + second)
    assert np.allclose(HEAT.after(HEAT.after(now, load, first), load, second), whole, rtol=1e-12)


def test_the_time_to_cool_is_the_time_after_which_it_is_cool() -> None:
    hot, wanted, at_rest = np.full((2, 2), 0.9), np.array([0.5, 0.3]), np.array([0.0, 0.2])
    seconds = HEAT.cooled_in(np.array([[0.0, 0.0], [0.9, 0.9]]), at_rest, wanted)
    assert HEAT.heat(HEAT.after(hot, at_rest, seconds))[1] == pytest.approx(0.3, abs=1e-4)
    assert HEAT.cooled_in(hot * [[0], [1]], np.array([0.0, 0.8]), wanted) == NEVER, "held torque keeps it above 0.3"


def test_a_joint_that_is_not_there_is_refused() -> None:
    with pytest.raises(ValueError, match=r"'q9'; the joints are q1, q2"):
        HeatModel.of(JOINTS, {"q9": ServoHeatSettings.si(continuous=1.0)}, torques)


def test_rests_come_before_the_budget_is_spent() -> None:
    poses = np.array([[0.1 * i, 1.2] for i in range(-15, 15)])
    forecast = forecast_schedule(scheduler(poses), np.zeros(2), HEAT.cold, list(range(30)))
    assert sum(isinstance(step, Measure) for step in forecast.steps) == 30
    assert any(isinstance(step, Rest) for step in forecast.steps)
    assert forecast.hottest[1] <= 0.6
    never = replace(HEAT, budget=np.array([np.inf, np.inf]))
    hot = forecast_schedule(scheduler(poses, model=never), np.zeros(2), HEAT.cold, list(range(30)))
    assert hot.hottest[1] > 0.6 and hot.resting == 0, "without a budget there would have been no rest"
    assert forecast.seconds > hot.seconds


def test_a_pose_that_no_servo_bears_is_left_out_and_the_others_are_not() -> None:
    weak = replace(HEAT, continuous=np.array([np.inf, 0.05]), times=np.full((2, 2), 5.0))
    poses = np.array([[0.5, 0.0], [0.5, 1.5], [1.0, 0.0]])
    forecast = forecast_schedule(scheduler(poses, model=weak), np.zeros(2), weak.cold, [0, 1, 2])
    left = [step for step in forecast.steps if isinstance(step, LeaveOut)]
    assert [step.pose for step in left] == [1] and "even from cold" in left[0].why
    assert sorted(step.pose for step in forecast.steps if isinstance(step, Measure)) == [0, 2]


def test_each_step_begins_where_the_one_before_ended() -> None:
    poses = np.array([[0.1 * i, 1.2 * (-1) ** i] for i in range(-8, 8)])
    at = np.zeros(2)
    for step in forecast_schedule(scheduler(poses), at, HEAT.cold, list(range(16))).steps:
        assert not isinstance(step, LeaveOut)
        assert np.array_equal(step.path[0], at)
        at = step.path[-1]
        expected = travel(step.path) / np.deg2rad(20)
        assert step.seconds >= expected
