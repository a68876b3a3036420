"""Mistakes that users make, planted in simulated recordings of three arms, and what a run makes of them."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from functools import cached_property
from pathlib import Path

import numpy as np
from armcal.base.dataset import Dataset
from armcal.cli.main import cli
from armcal.errors import ArmcalError, NotConvergedError
from armcal.estimate.simulation import SimulationRequest, measured_without_noise
from armcal.measure.reader import requested_channels
from armcal.measure.tables import write_csv
from armcal.run.experiment import Experiment
from armcal.run.pipeline import calibrate
from click.testing import CliRunner

ROOT = Path(__file__).resolve().parents[1]
DEMO = ROOT / "configs" / "lrm_arm" / "demo.yaml"
MM = 1000.0
AXES = ("x", "y", "z")
INDUSTRIAL = """joint,alpha_deg,a_mm,theta_deg,d_mm,lower_deg,upper_deg
q1,90,0,0,128,-170,170
q2,0,-612,0,0,-150,-30
q3,0,-572,0,0,-140,140
q4,90,0,0,164,-170,170
q5,-90,0,0,116,-120,120
q6,0,0,0,92,-170,170
"""
"""Six joints as of a large industrial arm, 1.4 m of reach."""
THREE_JOINTS = """
name: three joints
arms:
  arm:
    model: {type: mdh, convention: standard, rows: [{d_mm: 200, alpha_deg: 90}, {a_mm: 400}, {a_mm: 300}]}
measurements: {tracker: {type: tip_position, noise_mm: 0.1}}
parameters: {free: ["arm.mdh.theta*", "arm.mdh.a[0-9]", "arm.mdh.alpha1"], priors: {"*theta*": 2 deg, "*alpha1": 2 deg}}
data: {type: csv, path: data.csv}
simulation:
  type: elastic_arm
  truth: truth.yaml
  seed: 1
  poses: {kind: random, count: 100, levels_deg: {q1: [-170, 170], q2: [-90, 20], q3: [-120, 120]}}
validation: {holdout: 0.25, seed: 1}
evaluator: interpreted
"""


@dataclass(frozen=True)
class PlantedArm:
    """An arm with a stated truth, and its recordings.

    Attributes:
        name: for people.
        config: of the calibration.
        base: globs of the parameters of where it stands.
        reach: of its tip (m), about.
    """

    name: str
    config: Path
    base: str
    reach: float
    overrides: tuple[str, ...] = ()

    def held_base(self) -> tuple[str, ...]:
        """Overrides that hold the base where the configuration has it."""
        free = [block.name for block in self.experiment.parameters.free]
        return (f"parameters.free={json.dumps([n for n in free if not fnmatch(n, self.base)])}",)

    @cached_property
    def experiment(self) -> Experiment:
        return Experiment.load(self.config, self.overrides)

    @property
    def joints(self) -> list[str]:
        (arm,) = self.experiment.system.arms.values()
        return [f"{arm.name}.{joint}" for joint in arm.commanded]

    def recording(self, seed: int) -> Dataset:
        """As the truth has it, with noise."""
        experiment = Experiment.load(self.config, [*self.overrides, f"simulation.seed={seed}"])
        system = experiment.system
        request = SimulationRequest(system.arms, system.measurements, experiment.parameters, system.environment)
        return experiment.simulator().simulate(request)

    @cached_property
    def fresh(self) -> Dataset:
        """Exact readings at poses of another recording."""
        overrides = [*self.overrides, "simulation.seed=9999", "simulation.noise_mm=0"]
        experiment = Experiment.load(self.config, overrides)
        system = experiment.system
        request = SimulationRequest(system.arms, system.measurements, experiment.parameters, system.environment)
        return experiment.simulator().simulate(request)

    def write(self, dataset: Dataset, path: Path) -> Path:
        system = self.experiment.system
        write_csv(path, dataset, list(requested_channels(system.arms, system.measurements, measured=True)))
        return path


@dataclass(frozen=True)
class Outcome:
    """What a run made of a recording: ``grade`` is the verdict's, or ``refused``; errors in mm, nan where unknown."""

    grade: str
    said: str
    claimed: float
    true: float
    seconds: float
    notes: str = ""


def outcome(arm: PlantedArm, dataset: Dataset, folder: Path, overrides: Sequence[str] = ()) -> Outcome:
    """Calibrate on a recording; judge by exact readings at fresh poses."""
    data, began = arm.write(dataset, folder / "data.csv"), time.perf_counter()
    try:
        experiment = Experiment.load(arm.config, [*arm.overrides, *overrides], data)
        result = calibrate(experiment)
    except NotConvergedError as fault:
        return Outcome("not converged", str(fault), np.nan, np.nan, time.perf_counter() - began)
    except ArmcalError as fault:
        return Outcome("refused", str(fault), np.nan, np.nan, time.perf_counter() - began)
    seconds, found = time.perf_counter() - began, result.estimate
    judged = result.table.calibrated["holdout" if len(result.split.holdout) else "cross_validated"]
    bad = [f for f in result.verdict.findings if f.grade == "bad"]
    warned = [f for f in result.verdict.findings if f.grade == "warning"]
    grade = "bad" if bad else "warning" if warned else "good"
    said = " | ".join(f.text for f in (bad or warned))
    values = found.parameters.with_nominal(found.values)
    notes = " | ".join(f.text for f in result.verdict.findings if f.grade == "note")
    return Outcome(grade, said, judged.mean or np.nan, true_error(arm, experiment, values), seconds, notes)


def true_error(arm: PlantedArm, experiment: Experiment, parameters) -> float:
    """Mean distance (mm) of predicted from exact tips at fresh poses."""
    fresh, system = arm.fresh, experiment.system
    request = SimulationRequest(system.arms, system.measurements, parameters, system.environment)
    try:
        shown = measured_without_noise(request, fresh)
    except NotConvergedError:
        return np.nan
    off = [shown[f"tracker.{axis}"] - fresh.column(f"tracker.{axis}") for axis in AXES]
    return float(np.mean(np.linalg.norm(off, axis=0))) * MM


def arms(folder: Path) -> tuple[PlantedArm, ...]:
    """A printed arm on its bench, an industrial one, and one of seven joints; the last two as armcal makes them new."""
    seven = _new(folder, "seven", "--urdf", str(ROOT / "configs" / "ball" / "arm7.urdf"))
    printed = PlantedArm("printed", DEMO, "arm.mdh.base_*", 0.42)
    return printed, industrial_arm(folder), PlantedArm("seven", seven, "arm.placement_*", 1.2)


def industrial_arm(folder: Path) -> PlantedArm:
    """Begun from its table of lengths and angles."""
    (folder / "industrial.csv").write_text(INDUSTRIAL)
    config = _new(folder, "industrial", "--convention", "standard", "--dh", str(folder / "industrial.csv"))
    return PlantedArm("industrial", config, "arm.mdh.base_*", 1.4)


def three_joint_arm(folder: Path) -> PlantedArm:
    """Rigid, on its base, its calibration and its recordings in a fraction of a second."""
    (folder / "truth.yaml").write_text("arm.mdh.theta2: 0.4 deg\narm.mdh.a3: 301 mm\n")
    (folder / "three.yaml").write_text(THREE_JOINTS)
    return PlantedArm("three", folder / "three.yaml", "arm.mdh.base_*", 0.7)


def _new(folder: Path, name: str, *flags: str) -> Path:
    made = CliRunner().invoke(cli, ["new", "robot", name, *flags, "--out", str(folder / name)])
    assert made.exit_code == 0, made.output
    return folder / name / "simulated.yaml"


# ---------------------------------------------------------------- mistakes

Maker = Callable[[PlantedArm, Dataset, np.random.Generator], Dataset]


@dataclass(frozen=True)
class Mistake:
    """A mistake: what it does to a recording, and to the configuration.

    ``visible`` is whether data can show it at all: what it cannot must be stated as a limit.
    """

    name: str
    make: Maker
    overrides: Callable[[PlantedArm], Sequence[str]] = lambda arm: ()
    visible: bool = True


def tips(data: Dataset) -> np.ndarray:
    """Measured positions (3 x N, m)."""
    return data.stacked([f"tracker.{axis}" for axis in AXES])


def with_tips(data: Dataset, positions: np.ndarray) -> Dataset:
    return with_columns(data, {f"tracker.{axis}": row for axis, row in zip(AXES, positions, strict=True)})


def with_columns(data: Dataset, columns: Mapping[str, np.ndarray]) -> Dataset:
    return replace(data, channels={**data.channels, **columns})


def reordered(order: Callable[[int], Sequence[int]]) -> Maker:
    """Joints' columns in another order: ``order`` gives which one each is taken from."""

    def make(arm: PlantedArm, data: Dataset, random: np.random.Generator) -> Dataset:
        names = arm.joints
        taken = [names[i] for i in order(len(names))]
        parts = [
            (f"{n.replace('.', '.approach.')}", f"{t.replace('.', '.approach.')}")
            for n, t in zip(names, taken, strict=True)
        ]
        pairs = [*zip(names, taken, strict=True), *parts]
        return with_columns(data, {name: data.column(source) for name, source in pairs})

    return make


def turned(*joints: int) -> Maker:
    """Joints (from 1) that turn the other way."""

    def make(arm: PlantedArm, data: Dataset, random: np.random.Generator) -> Dataset:
        names = [arm.joints[i - 1] for i in joints]
        names += [name.replace(".", ".approach.") for name in names]
        return with_columns(data, {name: -data.column(name) for name in names})

    return make


def placed(change: Callable[[np.ndarray, np.random.Generator], np.ndarray]) -> Maker:
    """Measured positions (3 x N, m) changed."""
    return lambda arm, data, random: with_tips(data, change(tips(data), random))


def commanded(joint: int, change: Callable[[np.ndarray, np.random.Generator], np.ndarray]) -> Maker:
    """A joint's (from 1) commands (rad) changed."""

    def make(arm: PlantedArm, data: Dataset, random: np.random.Generator) -> Dataset:
        name = arm.joints[joint - 1]
        return with_columns(data, {name: change(data.column(name), random)})

    return make


def both(*makers: Maker) -> Maker:
    def make(arm: PlantedArm, data: Dataset, random: np.random.Generator) -> Dataset:
        for maker in makers:
            data = maker(arm, data, random)
        return data

    return make


def axes(matrix: Sequence[Sequence[float]]) -> Maker:
    return placed(lambda p, random: np.array(matrix, dtype=float) @ p)


def some(share: float, off: Callable[[np.random.Generator, int], np.ndarray]) -> Maker:
    """A share of the positions off by something (3 x n, m)."""

    def change(p: np.ndarray, random: np.random.Generator) -> np.ndarray:
        chosen = random.choice(p.shape[1], round(share * p.shape[1]), replace=False)
        moved = p.copy()
        moved[:, chosen] += off(random, len(chosen))
        return moved

    return placed(change)


def directions(size: float) -> Callable[[np.random.Generator, int], np.ndarray]:
    def off(random: np.random.Generator, count: int) -> np.ndarray:
        drawn = random.normal(size=(3, count))
        return size * drawn / np.linalg.norm(drawn, axis=0)

    return off


def one_side(*metres: float) -> Callable[[np.random.Generator, int], np.ndarray]:
    return lambda random, count: np.tile(np.array(metres)[:, None], count)


def after(share: float, change: Callable[[np.ndarray], np.ndarray]) -> Callable[..., np.ndarray]:
    """A change of what was recorded after a share of the recording."""

    def changed(values: np.ndarray, random: np.random.Generator) -> np.ndarray:
        first = round(share * values.shape[-1])
        return np.concatenate([values[..., :first], change(values[..., first:])], axis=-1)

    return changed


def tilted(degrees: float) -> Maker:
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return axes([[1, 0, 0], [0, c, -s], [0, s, c]])


def half_the_angles_in_degrees(arm: PlantedArm, data: Dataset, random: np.random.Generator) -> Dataset:
    changed = after(0.5, np.deg2rad)
    return with_columns(data, {name: changed(data.column(name), random) for name in arm.joints})


def scaled_angles(factor: float) -> Maker:
    return lambda arm, data, random: with_columns(data, {n: factor * data.column(n) for n in arm.joints})


def coupled(arm: PlantedArm, data: Dataset, random: np.random.Generator) -> Dataset:
    one, other = arm.joints[1:3]
    return with_columns(data, {other: data.column(other) + data.column(one)})


HELD = PlantedArm.held_base
MISTAKES = (
    Mistake("random positions", placed(lambda p, random: random.uniform(-0.4, 0.4, p.shape))),
    Mistake("rows of positions shuffled", placed(lambda p, random: p[:, random.permutation(p.shape[1])])),
    Mistake("positions one row late", placed(lambda p, random: np.roll(p, 1, axis=1))),
    Mistake("positions of another recording's order", placed(lambda p, random: p[:, ::-1])),
    Mistake("one sign", turned(2)),
    Mistake("two signs", turned(2, 4)),
    Mistake("three signs", turned(2, 3, 5)),
    Mistake("all signs", turned(1, 2, 3, 4, 5, 6)),
    Mistake("x and y exchanged", axes([[0, 1, 0], [1, 0, 0], [0, 0, 1]])),
    Mistake("x and y exchanged, one sign", both(axes([[0, 1, 0], [1, 0, 0], [0, 0, 1]]), turned(4))),
    Mistake("a mirrored axis", axes([[-1, 0, 0], [0, 1, 0], [0, 0, 1]])),
    Mistake(
        "a mirrored axis, two joints exchanged",
        both(axes([[1, 0, 0], [0, -1, 0], [0, 0, 1]]), reordered(lambda n: [0, 2, 1, *range(3, n)])),
    ),
    Mistake("two joints exchanged", reordered(lambda n: [0, 2, 1, *range(3, n)])),
    Mistake("joints in reverse order", reordered(lambda n: list(range(n))[::-1])),
    Mistake("joints shifted by one column", reordered(lambda n: [*range(1, n), 0])),
    Mistake("z in centimetres", axes([[1, 0, 0], [0, 1, 0], [0, 0, 10]])),
    Mistake("z in centimetres for millimetres", axes([[1, 0, 0], [0, 1, 0], [0, 0, 0.1]])),
    Mistake("x in metres", axes([[0.001, 0, 0], [0, 1, 0], [0, 0, 1]])),
    Mistake("positions in inches", placed(lambda p, random: p / 25.4)),
    Mistake("half the rows in metres", placed(after(0.5, lambda p: p / 1000))),
    Mistake("a quarter of the rows in metres", placed(after(0.75, lambda p: p / 1000))),
    Mistake("half the rows in centimetres", placed(after(0.5, lambda p: p / 10))),
    Mistake("half the angles in radians", half_the_angles_in_degrees),
    Mistake("angles in radians", scaled_angles(np.pi / 180)),
    Mistake("angles in turns", scaled_angles(1 / 360)),
    Mistake("base 200 mm off and held", placed(lambda p, random: p + np.array([[0.2], [0], [0]])), HELD),
    Mistake("base 30 mm off and held", placed(lambda p, random: p + np.array([[0], [0.03], [0]])), HELD),
    Mistake("base turned by 3 deg and held", tilted(3), HELD),
    Mistake("base turned by 40 deg and held", tilted(40), HELD),
    Mistake("30 % off by 50 mm", some(0.3, directions(0.05))),
    Mistake("40 % off by 50 mm", some(0.4, directions(0.05))),
    Mistake("30 % off by 200 mm", some(0.3, directions(0.2))),
    Mistake("45 % off by 50 mm to one side", some(0.45, one_side(0.05, 0, 0))),
    Mistake("45 % off by 20 mm to one side", some(0.45, one_side(0, 0.012, 0.016))),
    Mistake("a slip of 10 deg half way", commanded(2, after(0.5, lambda q: q + np.deg2rad(10)))),
    Mistake("a slip of 10 deg near the end of the arm", commanded(5, after(0.5, lambda q: q + np.deg2rad(10)))),
    Mistake("a slip of 3 deg after a third", commanded(3, after(0.33, lambda q: q + np.deg2rad(3)))),
    Mistake("the base moved by 30 mm half way", placed(after(0.5, lambda p: p + np.array([[0], [0], [0.03]])))),
    Mistake(
        "the tracker turned by 5 deg half way",
        both(placed(after(0.5, lambda p: np.array([[1, 0, 0], [0, 0.9962, -0.0872], [0, 0.0872, 0.9962]]) @ p))),
    ),
    Mistake("a joint's column all zero", commanded(3, lambda q, random: 0 * q)),
    Mistake("a joint's column of noise", commanded(4, lambda q, random: random.permutation(q))),
    Mistake("a joint's angles doubled", commanded(3, lambda q, random: 2 * q)),
    Mistake("a joint's angles 10 % large", commanded(3, lambda q, random: 1.1 * q)),
    Mistake("a coupled joint", coupled),
    Mistake(
        "commands rounded to 10 deg",
        both(
            *(
                commanded(
                    i,
                    lambda q, random: np.deg2rad(10 * np.round(np.rad2deg(q) / 10 + random.uniform(-0.5, 0.5, len(q)))),
                )
                for i in range(1, 6)
            )
        ),
    ),
    Mistake("a tracker's scale off by 10 %", placed(lambda p, random: 1.1 * p), visible=False),
    Mistake("a tracker's scale off by 1 %", placed(lambda p, random: 1.01 * p), visible=False),
    Mistake("a joint's zero off by 90 deg", commanded(4, lambda q, random: q + np.pi / 2), visible=False),
    Mistake("a joint's zero off by 25 deg", commanded(2, lambda q, random: q + np.deg2rad(25)), visible=False),
    Mistake("a base off by 1 m", placed(lambda p, random: p + np.array([[1.0], [0], [0]])), visible=False),
)
"""What is planted; data of the wrong kind are refused, the others graded."""
