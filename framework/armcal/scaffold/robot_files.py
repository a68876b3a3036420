"""The files of a new robot: its arm, what to calibrate, a plan, a simulated truth and records of it, and a trial."""

import fnmatch
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armcal.arm.statics import plausible_compliance
from armcal.base.dataset import Dataset
from armcal.base.domains import Rotation
from armcal.base.parameters import Parameters
from armcal.base.units import display_unit, shown_unit, to_unit
from armcal.errors import InputError
from armcal.estimate.estimator import Progress, no_progress
from armcal.estimate.identifiability import MinimalSet, minimal_set
from armcal.estimate.simulation import measured_without_noise
from armcal.measure.tables import write_csv
from armcal.plugins import PluginRegistry
from armcal.problem.variants import factor_at_zero
from armcal.report.page import page
from armcal.report.run_document import plugin_sections, run_document
from armcal.run import result as results
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, assemble, calibrate
from armcal.run.result import RunResult
from armcal.scaffold.plugin_files import number, rendered, staged, write_texts
from armcal.scaffold.robot import Robot, RobotJoint, Steps, Unit

MOST_UNCERTAIN = 0.5  # in typical scales: what the declared noise leaves less certain is fixed
SIMULATED, RECORDS = "simulated.yaml", "simulated.csv"
NOISE_MM, NOISE_SEED = 0.1, 4
GRAVITY_M_S2 = 9.81
_SMALLEST_REACH_M = 0.01
_TRIED_POSES = 60
_NEARLY_HALF_A_TURN = 3.0
RECORDS_MADE = 600
"""Of so many, chance makes one verdict in twenty warn; of 100 to 200 it is one in five, for each finding has a level of
its own."""
RESULTS = "runs/simulated"
MOST_ERROR = 1.5  # times what the noise alone makes: what misses held-out tips by more has not found the arm
NOISE_ALONE_MM = NOISE_MM * math.sqrt(8 / math.pi)  # mean length of three independent normal numbers
SEED = 1
LENGTH_SD_M, ANGLE_SD_RAD = 0.001, 0.003
UNSTATED_TARGET = {"tracker.target_x": 0.06, "tracker.target_y": -0.04, "tracker.target_z": 0.03}
"""Of the reach: where a target sits whose place was not stated. Most sit beside the last axis, and show more there."""
_MOST_SD = 2.0
_SPRING = (0.5, 1.5)
_UNITS = frozenset({"m", "rad", "rad_per_Nm"})


def write_robot(robot: Robot, folder: Path, registry: PluginRegistry) -> MinimalSet:
    """Write a new robot's folder, with simulated records of it; gives the parameters chosen."""
    with staged(folder) as place:
        try:
            return _fill(place, robot, registry)
        except InputError as fault:
            text = str(fault).replace(str(place.resolve()), str(folder)).replace(str(place), str(folder))
            reason = f"the files of {robot.name} would be refused: {text}"  # nobody sees them, as they are not kept
            raise InputError(reason, hint="Correct what they are made from.") from fault


def _fill(place: Path, robot: Robot, registry: PluginRegistry) -> MinimalSet:
    """First with nothing free, to see what there is; then with everything; then with what the records determine."""
    nothing = MinimalSet((), (), (), {})
    if robot.urdf:
        (place / robot.urdf_file).write_bytes(robot.urdf)
    _write(place, robot, nothing, {})
    experiment = Experiment.load(place / SIMULATED, registry=registry)
    parameters = experiment.parameters
    masses = [b for b in parameters.blocks if b.name.startswith("arm.links.") and b.name.endswith(".mass")]
    weight_N = GRAVITY_M_S2 * sum(block.nominal[0] for block in masses)
    random = np.random.default_rng(SEED)
    commands = {f"arm.{j.name}": random.uniform(*j.limits, _TRIED_POSES) for j in robot.joints}
    poses = Dataset(tuple(str(i) for i in range(_TRIED_POSES)), commands)
    exact = measured_without_noise(experiment.simulation_request, poses)
    tips = np.array([exact[f"tracker.{axis}"] for axis in "xyz"])
    reach = float(np.linalg.norm(tips - tips.mean(axis=1, keepdims=True), axis=0).max())  # from the middle of all
    if not reach > _SMALLEST_REACH_M:
        raise InputError(
            f"in all poses the tip stays within {1000 * reach:.3g} mm.",
            hint="Check the lengths a and d and their units.",
        )
    target = {} if robot.target else {name: share * reach for name, share in UNSTATED_TARGET.items()}
    true = _made_up(parameters, weight_N * reach, target, robot.widths)
    _write(place, robot, nothing, _as_text(parameters, true))
    experiment = Experiment.load(place / SIMULATED, registry=registry)
    dataset = experiment.simulator().simulate(experiment.simulation_request)
    write_csv(place / RECORDS, dataset, experiment.request(measured=True).channels)
    freed = f"parameters.free={json.dumps(_candidates(parameters))}"
    chosen = _choose_free(Experiment.load(place / SIMULATED, [freed], registry=registry), robot, target)
    _write(place, robot, chosen, _as_text(parameters, true))
    return chosen


def _choose_free(experiment: Experiment, robot: Robot, target: Mapping[str, float]) -> MinimalSet:
    """A minimal set of the experiment's free parameters, for its training records (see ``armcal identify``).

    A target whose place was not stated is taken to sit there (m): on the last axis it would not show all that it does.
    """
    ready = assemble(experiment, Stopwatch())
    parameters = ready.problem.parameters
    values = experiment.parameters.nominal()  # as drawn, not where the records place it: springs would seem loaded
    for name, place in target.items():
        values[parameters.entries_of(name)] = place
    triangle = factor_at_zero(ready.training, values)
    free = [block.name for block in parameters.free]
    preferred = [
        [name for name in free if any(fnmatch.fnmatchcase(name, glob) for glob in globs)] for globs in robot.preferred
    ]
    return minimal_set(triangle, parameters, preferred, most_uncertain=MOST_UNCERTAIN)


def _write(place: Path, robot: Robot, choice: MinimalSet, true: Mapping[str, str]) -> None:
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
        "truth_seed": SEED,
        "seed": NOISE_SEED,
        "shown": _shown,
        "levels": _levels,
        "steps": _steps,
        "turning": [joint for joint in robot.joints if joint.turns],
        "sliding": [joint for joint in robot.joints if not joint.turns],
        "assumed": [joint.name for joint in robot.joints if joint.assumed],
    }
    write_texts(place, rendered("robot", context))


def _shown(value: float, dimension: str) -> str:
    return number(to_unit(value, display_unit(dimension).name))


def _steps(steps: Steps) -> str:
    units = {name: ("angle", "deg") if len(name) == 2 else ("length", "mm") for name, _ in steps}
    return ", ".join(f"{{{name}_{units[name][1]}: {_shown(value, units[name][0])}}}" for name, value in steps)


def _levels(joint: RobotJoint) -> list[str]:
    """Low, middle and high, in deg or mm; a third of a turn apart where the ends would be one angle, or beyond it."""
    middle, half = 0.5 * sum(joint.limits), 0.5 * (joint.limits[1] - joint.limits[0])
    if joint.turns and half > _NEARLY_HALF_A_TURN:
        half = 2 * math.pi / 3
    return [_shown(value, "angle" if joint.turns else "length") for value in (middle - half, middle, middle + half)]


@dataclass(frozen=True)
class Trial:
    """How the calibration went, and tip errors on held-out records (mm)."""

    result: RunResult
    nominal_mm: float
    calibrated_mm: float

    @property
    def fault(self) -> str:
        """What is wrong; empty if the files work."""
        verdict = self.result.estimate.verdict
        bad = [finding.text for finding in self.result.verdict.findings if finding.grade == "bad"]
        if not verdict.converged:
            return f"{verdict.name} did not converge ({verdict.status})"
        if bad or self.calibrated_mm <= MOST_ERROR * NOISE_ALONE_MM:
            return bad[0] if bad else ""
        error = f"the error at held-out tips is {self.calibrated_mm:.3f} mm"
        return f"{error}, and the noise alone makes {NOISE_ALONE_MM:.3f} mm"


def try_out(folder: Path, registry: PluginRegistry, command: str = "", progress: Progress = no_progress) -> Trial:
    """Calibrate on the simulated records, as ``armcal run`` does."""
    watch, experiment = Stopwatch(), Experiment.load(folder / SIMULATED, registry=registry)
    result = calibrate(experiment, command, progress, watch)
    result.seconds["total"] = watch.total()
    document = run_document(result, plugin_sections(result, registry)[0])
    with results.reserved(folder / RESULTS) as held:
        results.write(held, result, experiment, page(document))
    held_out = (of["holdout"].mean for of in (result.table.nominal, result.table.calibrated))
    return Trial(result, *(math.nan if error is None else error for error in held_out))


def _candidates(parameters: Parameters) -> tuple[str, ...]:
    """What a first calibration may look for: placement, geometry, springs, the target; no masses, no gravity."""
    return tuple(
        block.name
        for block in parameters.blocks
        if block.unit in _UNITS
        and (block.size == 1 or isinstance(block.domain, Rotation))
        and not fnmatch.fnmatch(block.name, "arm.links.*")
        and not block.name.startswith("statics.")
    )


def _made_up(
    parameters: Parameters, load_Nm: float, target: Mapping[str, float], widths: Mapping[Unit, float]
) -> dict[str, float]:
    """True values (SI) of every candidate that is one number; a rotation stays as it was stated.

    A joint bears ``load_Nm``, the moment of the arm's whole weight at its full reach; 0 if its masses are not known.
    Parameters of the target are off by ``target`` (m) beside that. Errors are no larger than the priors' ``widths``.
    """
    random = np.random.default_rng(SEED)
    deviations = {"m": min(LENGTH_SD_M, 1e-3 * widths["mm"]), "rad": min(ANGLE_SD_RAD, math.radians(widths["deg"]))}
    names = [name for name in _candidates(parameters) if parameters[name].size == 1]
    values = {}
    for name in names:
        block = parameters[name]
        if block.unit == "rad_per_Nm":
            drawn = float(random.uniform(*_SPRING))
            error = drawn * plausible_compliance(load_Nm) if load_Nm > 0 else 0.0
        else:
            error = deviations[block.unit] * float(np.clip(random.normal(), -_MOST_SD, _MOST_SD))
        values[name] = float(block.nominal[0]) + error + target.get(name, 0.0)
    return values


def _as_text(parameters: Parameters, values: Mapping[str, float]) -> dict[str, str]:
    lines = {}
    for name, value in values.items():
        factor, unit = shown_unit(parameters[name].unit)
        lines[name] = f"{number(float(f'{factor * value:.6g}'))} {unit}"
    return lines
