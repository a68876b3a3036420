"""The files of a new robot: its arm, what to calibrate, a plan, a simulated truth and records of it."""

import fnmatch
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armcal.base.dataset import Dataset
from armcal.base.units import display_unit, to_unit
from armcal.diagnose.minimal import minimal_set
from armcal.errors import InputError
from armcal.estimate.simulation import measured_without_noise
from armcal.measure.csv_writer import write_csv
from armcal.plugins import PluginRegistry
from armcal.problem.projection import factor_at_zero
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, assemble
from armcal.scaffold import truth
from armcal.scaffold.rendering import number, rendered, staged, write_texts
from armcal.scaffold.robot import Robot, RobotJoint

MOST_UNCERTAIN = 0.5
"""In typical scales: what the declared noise leaves less certain than this is held."""
SIMULATED, RECORDS = "simulated.yaml", "simulated.csv"
NOISE_MM, NOISE_SEED = 0.1, 4
GRAVITY_M_S2 = 9.81
_SMALLEST_REACH_M = 0.01
_TRIED_POSES = 60
RECORDS_MADE = 600
"""Of so many, chance makes one verdict in twenty warn; of 100 to 200 it is one in five, for each finding has a level of
its own."""


@dataclass(frozen=True)
class FreeChoice:
    """Names to free, names that these stand in for, names that the data hardly determines."""

    kept: tuple[str, ...]
    redundant: tuple[str, ...]
    left_out: tuple[str, ...]


@dataclass(frozen=True)
class RobotFolder:
    """What was written: where, the parameters chosen, and the noise that the simulated records have (mm)."""

    folder: Path
    choice: FreeChoice
    noise_mm: float = NOISE_MM


def write_robot(robot: Robot, folder: Path, registry: PluginRegistry) -> RobotFolder:
    """Write a new robot's folder, with simulated records of it.

    Raises:
        InputError: the folder cannot be written, or what it would hold is refused.
    """
    with staged(folder) as place:
        try:
            chosen = _fill(place, robot, registry)
        except InputError as fault:
            text = str(fault).replace(str(place.resolve()), str(folder)).replace(str(place), str(folder))
            reason = f"the files of {robot.name} would be refused: {text}"  # nobody sees them, as they are not kept
            raise InputError(reason, hint="Correct what they are made from.") from fault
    return RobotFolder(folder, chosen)


def _fill(place: Path, robot: Robot, registry: PluginRegistry) -> FreeChoice:
    """First with nothing free, to see what there is; then with everything; then with what the records determine."""
    nothing = FreeChoice((), (), ())
    if robot.urdf:
        (place / robot.urdf_file).write_bytes(robot.urdf)
    _write(place, robot, nothing, {})
    experiment = Experiment.load(place / SIMULATED, registry=registry)
    parameters = experiment.parameters
    masses = [b for b in parameters.blocks if b.name.startswith("arm.links.") and b.name.endswith(".mass")]
    weight_N = GRAVITY_M_S2 * sum(block.nominal[0] for block in masses)
    reach = _reach(experiment, robot)
    target = {} if robot.target else {name: share * reach for name, share in truth.UNSTATED_TARGET.items()}
    true = truth.made_up(parameters, weight_N * reach, target, robot.widths)
    _write(place, robot, nothing, truth.as_text(parameters, true))
    experiment = Experiment.load(place / SIMULATED, registry=registry)
    dataset = experiment.simulator().simulate(experiment.simulation_request)
    write_csv(place / RECORDS, dataset, experiment.request(measured=True).channels)
    freed = f"parameters.free={json.dumps(truth.candidates(parameters))}"
    chosen = _choose_free(Experiment.load(place / SIMULATED, [freed], registry=registry), robot, target)
    _write(place, robot, chosen, truth.as_text(parameters, true))
    return chosen


def _choose_free(experiment: Experiment, robot: Robot, target: Mapping[str, float]) -> FreeChoice:
    """A minimal set of the experiment's free parameters, for its training records (see ``armcal identify``).

    A target whose place was not stated is taken to sit there (m): on the last axis it would not show all that it does.
    """
    ready = assemble(experiment, Stopwatch())
    parameters = ready.problem.parameters
    values = experiment.parameters.nominal()  # as drawn, not where the records place it: springs would seem loaded
    for name, place in target.items():
        values[parameters.entries_of(name)] = place
    triangle = factor_at_zero(ready.problem, values, ready.training)
    free = [block.name for block in parameters.free]
    preferred = [
        [name for name in free if any(fnmatch.fnmatchcase(name, glob) for glob in globs)] for globs in robot.preferred
    ]
    minimal = minimal_set(triangle, parameters, preferred, most_uncertain=MOST_UNCERTAIN)
    return FreeChoice(
        minimal.kept,
        tuple(dropped.name for dropped in minimal.redundant),
        tuple(dropped.name for dropped in minimal.left_out),
    )


def _write(place: Path, robot: Robot, choice: FreeChoice, true: Mapping[str, str]) -> None:
    held = {glob: unit for glob, unit in robot.priors.items() if fnmatch.filter(choice.kept, glob)}
    priors = {glob: f"{number(robot.widths[unit])} {unit}" for glob, unit in held.items()}
    context: dict[str, Any] = {
        "robot": robot,
        "name": robot.name,
        "choice": choice,
        "priors": priors,
        "truth": true,
        "gravity": [number(-GRAVITY_M_S2 * along) for along in robot.up or ()],
        "noise_mm": number(NOISE_MM),
        "count": RECORDS_MADE,
        "truth_seed": truth.SEED,
        "seed": NOISE_SEED,
        "shown": _shown,
        "levels": _levels,
        "turning": [joint for joint in robot.joints if joint.turns],
        "sliding": [joint for joint in robot.joints if not joint.turns],
        "assumed": [joint.name for joint in robot.joints if joint.assumed],
    }
    write_texts(place, rendered("robot", context))


def _shown(value: float, dimension: str) -> str:
    """A number in the unit that people read."""
    return number(to_unit(value, display_unit(dimension).name))


def _levels(joint: RobotJoint) -> list[str]:
    """Low, middle and high, in deg or mm."""
    low, high = joint.limits
    return [_shown(value, "angle" if joint.turns else "length") for value in (low, 0.5 * (low + high), high)]


def _reach(experiment: Experiment, robot: Robot) -> float:
    random = np.random.default_rng(truth.SEED)
    commands = {f"arm.{j.name}": random.uniform(*j.limits, _TRIED_POSES) for j in robot.joints}
    poses = Dataset(tuple(str(i) for i in range(_TRIED_POSES)), commands)
    exact = measured_without_noise(experiment.simulation_request, poses)
    reach = truth.reach(np.array([exact[f"tracker.{axis}"] for axis in "xyz"]))
    if not reach > _SMALLEST_REACH_M:
        raise InputError(
            f"in all poses the tip stays within {1000 * reach:.3g} mm.",
            hint="Check the lengths a and d and their units.",
        )
    return reach
