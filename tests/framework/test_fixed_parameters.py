"""Fixed parameters that the records would rather have free: found where something is gained, none where nothing is."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from armcal.cli.main import cli
from armcal.estimate.identifiability import candidates, freeing
from armcal.measure.tables import write_csv
from armcal.plugins import discover
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, assemble
from armcal.run.study import FixedParameters, fixed_parameters
from armcal.scaffold.robot import SIMULATED, read_rows, robot_of_rows, write_robot
from click.testing import CliRunner

REGISTRY = discover()
ROWS = "alpha_deg,a_mm,theta_deg,d_mm\n90,0,0,120\n0,200,0,0\n90,160,0,0\n0,0,0,90\n"
OFF_THE_AXIS = ("arm.mdh.alpha3", "arm.mdh.a3")
"""Seen by a target off the axis of joint 4 alone; on it, the target and the other rows do as much."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An arm whose target sits beside its last axis, with records of it."""
    place = tmp_path_factory.mktemp("fixed")
    (place / "rows.csv").write_text(ROWS, encoding="utf-8")
    robot = replace(
        robot_of_rows("arm", "standard", read_rows(place / "rows.csv", discover())), target=(0.08, 0.04, 0.06)
    )
    choice = write_robot(robot, place / "arm", REGISTRY)
    assert set(OFF_THE_AXIS) <= set(choice.kept)
    return place / "arm"


def _free(experiment: Experiment) -> list[str]:
    return [f"parameters.free={json.dumps([block.name for block in experiment.parameters.free])}"]


def loaded(folder: Path, held: tuple[str, ...] = (), *overrides: str) -> Experiment:
    """The generated calibration with some of its parameters held."""
    free = [b.name for b in Experiment.load(folder / SIMULATED, registry=REGISTRY).parameters.free]
    chosen = json.dumps([name for name in free if name not in held])
    return Experiment.load(folder / SIMULATED, [f"parameters.free={chosen}", *overrides], registry=REGISTRY)


def judged(experiment: Experiment) -> FixedParameters:
    return fixed_parameters(experiment, assemble(experiment, Stopwatch()))


@pytest.mark.slow
def test_what_was_held_and_is_wrong_is_recommended_and_what_is_right_is_not(folder: Path) -> None:
    """The true ``alpha3`` is 0.1 deg off the drawing, the true ``a3`` 0.04 mm."""
    found = judged(loaded(folder, OFF_THE_AXIS))
    assert found.recommended == ("arm.mdh.alpha3",)
    assert found.determined_and_nothing_gained == ("arm.mdh.a3",)
    (freed,) = found.gaining
    assert freed.error < 0.9 * found.error  # type: ignore[operator]
    assert freed.change[0] == pytest.approx(math.radians(0.1029), abs=4 * freed.sd[0])


def test_the_command_says_what_to_write(folder: Path) -> None:
    ran = CliRunner().invoke(
        cli,
        ["identify", str(folder / SIMULATED), "--fixed", "--set", *_free(loaded(folder, OFF_THE_AXIS))],
        prog_name="armcal",
    )
    assert ran.exit_code == 0, ran.output
    assert ran.output.endswith("Add to parameters.free:\n  [arm.mdh.alpha3]\n")


def clean(folder: Path, seed: int) -> Experiment:
    """The arm as the model has it, and new noise."""
    experiment = loaded(folder, (), f"simulation.seed={seed}")
    dataset = experiment.simulator().simulate(experiment.simulation_request)
    write_csv(folder / f"clean{seed}.csv", dataset, experiment.request(measured=True).channels)
    return Experiment.load(experiment.source.path, _free(experiment), folder / f"clean{seed}.csv", REGISTRY)


@pytest.mark.slow
def test_nothing_is_recommended_where_the_model_is_right(folder: Path) -> None:
    assert judged(clean(folder, 11)).recommended == ()


@pytest.mark.slow
def test_of_twenty_right_models_at_most_one_gets_a_recommendation(folder: Path) -> None:
    found = [judged(clean(folder, seed)).recommended for seed in range(20, 40)]
    assert sum(bool(one) for one in found) <= 1, found


def test_what_free_parameters_do_already_is_no_candidate(folder: Path) -> None:
    """The zero and the offset of the first joint are those of the base."""
    experiment = loaded(folder)
    ready = assemble(experiment, Stopwatch())
    own = [block.name for block in ready.problem.parameters.free]
    names = candidates(ready.problem.parameters)
    assert {"arm.mdh.theta1", "arm.mdh.d1"} <= set(names)
    assert not [name for name in names if name in own or name.startswith("statics.")]
    wide = assemble(loaded(folder, (), f"parameters.free={json.dumps([*own, *names])}"), Stopwatch())
    gaining, others = freeing(wide.training, own, wide.problem.parameters.nominal())
    seen = {one.name for one in (*gaining, *others)}
    assert not {"arm.mdh.theta1", "arm.mdh.d1"} & seen
    assert all(np.all(one.sd > 0) for one in (*gaining, *others))
