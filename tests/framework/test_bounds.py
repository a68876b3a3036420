"""Estimates at and beyond bounds: honest intervals, what a bound does to others, and numbers that can be read."""

from __future__ import annotations

from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from armcal.calibration.calibration_file import parameter_records
from armcal.cli.common import Screen
from armcal.diagnose.verdict import shifts
from armcal.estimate.estimator import Estimate, estimate
from armcal.estimate.simulation import SimulationRequest, measured_without_noise, with_channels
from armcal.problem.problem import Problem
from armcal.report.run_document import parameters_table, principal_table
from armcal.run.experiment import Experiment
from fits import fit_that_found

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm"
NOISE_M = 0.0005


def fitted(free: str, truth: dict[str, float], *settings: str, seed: int = 3) -> Estimate:
    """A fit of the free parameters to 60 poses of an arm with these values; SI."""
    loaded = Experiment.load(CONFIGS / "demo.yaml", [f"parameters.free={free}", "evaluator=interpreted", *settings])
    system, parameters = loaded.system, loaded.parameters
    commands = loaded.read().subset(np.arange(0, 180, 3))
    values, random = parameters.nominal(), np.random.default_rng(seed)
    for name, value in truth.items():
        values[parameters.entry_names.index(name)] = value
    request = SimulationRequest(system.arms, system.measurements, parameters.with_nominal(values), system.environment)
    exact = measured_without_noise(request, commands)
    dataset = with_channels(commands, {n: x + random.normal(0, NOISE_M, len(x)) for n, x in exact.items()})
    problem = Problem.build(system.arms, system.measurements, parameters, system.environment, dataset, "interpreted")
    problem = problem.of(dataset)
    return estimate(problem, loaded.estimator.solve(problem, parameters.nominal()))


SPRINGS = '["arm.spring.k[2-4]", "arm.mdh.theta[2-4]"]'
BEYOND = {"arm.spring.k2": -0.01, "arm.spring.k3": 0.05, "arm.spring.k4": 0.05}


@pytest.fixture(scope="module")
def beyond() -> Estimate:
    """The second spring would have to push with its load: its estimate lies far beyond its bound at zero."""
    return fitted(SPRINGS, BEYOND)


def test_an_estimate_far_beyond_its_bound_keeps_an_interval_as_wide_as_its_deviation(beyond: Estimate) -> None:
    place = beyond.names.index("arm.spring.k2")
    interval, sd = beyond.intervals[place], beyond.deviations[place]
    assert beyond.unconstrained[place] < -5 * sd and "arm.spring.k2" in beyond.at_bound
    assert interval.bounds == ("lower",) and interval.lower == 0
    assert 1.9 * sd < interval.upper < 2.1 * sd


def test_what_a_bound_shifts_beside_itself_is_named(beyond: Estimate) -> None:
    (finding,) = shifts(fit_that_found(beyond, {}))
    assert finding.grade == "note" and "Bounds that hold arm.spring.k2 shift other estimates" in finding.text
    moved = (beyond.free_values - beyond.unconstrained) / beyond.deviations
    worst = max((n for n in beyond.names if n != "arm.spring.k2"), key=lambda n: abs(moved[beyond.names.index(n)]))
    assert f"{worst} ({moved[beyond.names.index(worst)]:+.1f} sd)" in finding.text
    free = fitted(SPRINGS, {**BEYOND, "arm.spring.k2": 0.05})
    assert not shifts(fit_that_found(free, {}))


@pytest.mark.parametrize(
    ("deviations", "remark"), [(0.5, "lower end at its bound"), (2.9, "lower end at its bound"), (3.1, "")]
)
def test_the_end_that_is_a_bound_is_not_guessed_from_where_the_value_lies(
    beyond: Estimate, deviations: float, remark: str
) -> None:
    place = beyond.names.index("arm.spring.k2")
    own = deviations * beyond.deviations[place]
    values, unconstrained = beyond.values.copy(), beyond.unconstrained.copy()
    values[beyond.free_entries[place]] = unconstrained[place] = own
    moved = replace(beyond, values=values, unconstrained=unconstrained)
    row, interval = parameters_table(moved).rows[place], moved.intervals[place]
    lower, upper = (float(end) for end in row[5].split(" to "))
    assert row[-1] == remark and (lower == 0) == bool(remark)
    assert (lower, upper) == pytest.approx((interval.lower, interval.upper), abs=1e-3)


def test_a_parameter_with_the_deviation_of_its_prior_is_not_determined_by_data() -> None:
    tight = fitted(SPRINGS, {"arm.spring.k2": 0.05}, "parameters.priors={arm.mdh.theta2: 0.0001 deg}")
    records = {record.name: record for record in parameter_records(tight)}
    held, free = records["arm.mdh.theta2"], records["arm.mdh.theta3"]
    assert held.sd == pytest.approx(np.radians(0.0001), rel=1e-2) and free.determined_by == "data"
    assert held.determined_by == "prior"


def test_names_and_values_pair(beyond: Estimate) -> None:
    assert len(beyond.names) == len(beyond.free_values) == len(beyond.intervals) < len(beyond.values)
    all_values = dict(zip(beyond.parameters.entry_names, beyond.values, strict=True))
    assert dict(zip(beyond.names, beyond.free_values, strict=True)) == {n: all_values[n] for n in beyond.names}


def printed(table) -> str:
    """As a terminal shows it."""
    screen = Screen(file=StringIO(), width=120)
    screen.part(table, verbose=True)
    return screen.file.getvalue()


def test_compliances_of_a_stiff_arm_are_printed_with_their_digits(beyond: Estimate) -> None:
    """A spring of 5e-6 rad/(N m), known to 2e-7."""
    place = beyond.names.index("arm.spring.k3")
    values, covariance = beyond.values.copy(), beyond.covariance * 1e-12
    values[beyond.free_entries[place]], covariance[place, place] = 5.04e-6, (2e-7) ** 2
    stiff = replace(beyond, values=values, unconstrained=values[list(beyond.free_entries)], covariance=covariance)
    assert "0.00000504" in next(line for line in printed(parameters_table(stiff)).splitlines() if "k3" in line)
    row = parameters_table(stiff).rows[place]
    assert (row[2], row[4]) == ("0.00000504", "0.00000020")


def test_principal_compliances_of_a_stiff_arm_are_printed_with_their_digits() -> None:
    flex = "arms.arm.effects.flex={type: compliance, compliance_rad_per_Nm: 4.0e-6}"
    loaded = Experiment.load(CONFIGS / "demo.yaml", ["parameters.free=[arm.flex.C2]", flex])
    values, parameters = loaded.parameters.nominal(), loaded.parameters

    row = next(
        line
        for line in printed(
            principal_table(type("Estimate", (), {"parameters": parameters, "values": values})())
        ).splitlines()
        if "arm.flex.C2" in line
    )
    assert row.count("4.00e-06") == 3


@pytest.mark.slow
def test_what_a_cone_shifts_beside_its_matrix_is_named() -> None:
    """A joint that would have to push one way: its matrix ends on the cone, and no entry of it on a bound."""
    give = "arms.arm.effects.flex={type: compliance, compliance_rad_per_Nm: 0.02}"
    free = '["arm.flex.C2", "arm.mdh.theta[2-4]"]'
    truth = {"arm.flex.C2[xx]": 0.02, "arm.flex.C2[yy]": 0.02}
    edge, inside = (
        fitted(free, {**truth, "arm.flex.C2[zz]": along}, "arms.arm.effects.spring=null", give)
        for along in (-0.01, 0.05)
    )
    assert not edge.at_bound
    (finding,) = shifts(fit_that_found(edge, {}))
    moved = dict(zip(edge.names, (edge.free_values - edge.unconstrained) / edge.deviations, strict=True))
    worst = max((n for n in edge.names if n.startswith("arm.mdh")), key=lambda n: abs(moved[n]))
    assert f"Bounds that hold arm.flex.C2 shift other estimates: {worst} ({moved[worst]:+.1f} sd)" in finding.text
    assert finding.grade == "note" and "C2[" not in finding.text
    assert not shifts(fit_that_found(inside, {}))
