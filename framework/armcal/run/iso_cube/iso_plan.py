"""A plan of the test of ISO 9283 for a configured arm: cycles over five poses, then poses from several directions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armcal.arm.assembly import only_arm
from armcal.arm.joints import joint_limits
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.units import display_unit, to_unit
from armcal.calibration.compensation.compensator import Compensator
from armcal.calibration.compensation.request import Options
from armcal.calibration.tool_expression import arm_expression
from armcal.run.experiment import Experiment
from armcal.run.iso_cube.placement import DIRECTED, NAMES, Cube, Placed, placed
from armcal.run.plan import approach_channels, values_about
from armcal.run.plan_poses import JointSpace, clearance_of, spread
from armcal.run.settings import PlanSettings

PATH = "path"
"""The direction of poses that are come to one from another."""
_OF_SIZE, _FARTHEST = 0.1, 0.05
"""How far an approach begins: of the cube's edge, and at most (m)."""
_STILL = 1e-6
"""A joint that moves less (rad or m) does not come from a side."""
_POSTURES = 1024
_NO_CLEARANCE = "no clearance is stated (plan.clearance): nothing here keeps the arm from itself or the table."


@dataclass(frozen=True)
class Visit:
    """A pose, by which cycle and direction it is visited, and commands there and before (n each)."""

    pose: str
    cycle: int
    direction: str
    command: Array
    before: Array


def visits(
    compensator: Compensator, placed: Placed, cycles: int, directions: int
) -> tuple[tuple[Visit, ...], tuple[str, ...]]:
    """All visits in order, and warnings of directions that cannot be come from."""
    commands, table = placed.commands, list[Visit]()
    for cycle in range(1, cycles + 1):
        for i, name in enumerate(NAMES):
            table.append(Visit(name, cycle, PATH, commands[i], commands[i - 1]))
    warnings = []
    for axis in range(directions):
        begun = {name: _begun(compensator, placed, NAMES.index(name), axis) for name in DIRECTED}
        lost = [name for name, before in begun.items() if before is None]
        if lost:
            warnings.append(f"{', '.join(lost)}: no approach along {'xyz'[axis]} lies within limits; it is left out.")
        for cycle in range(1, cycles + 1):
            for name, before in begun.items():
                if before is not None:
                    table.append(Visit(name, cycle, "xyz"[axis], commands[NAMES.index(name)], before))
    return tuple(table), tuple(warnings)


def _begun(compensator: Compensator, placed: Placed, index: int, axis: int) -> Array | None:
    """Where an approach along an axis of the base frame begins (n): below the pose, else above it."""
    cube, far = placed.cube, min(_OF_SIZE * placed.cube.size, _FARTHEST)
    for side in (-1.0, 1.0):
        place = cube.points[index] + side * far * np.eye(3)[axis]
        target = compensator.targets(place, None if cube.rotation is None else cube.rotation[None])
        begun = compensator.onward(target, placed.commands[index])
        if begun.reached[0]:
            return np.asarray(begun.joint_angles[0])
    return None


def dataset_of_visits(table: Sequence[Visit], space: JointSpace, tools: Array) -> Dataset:
    """The table; beside joints and sides the pose, the cycle, the direction, whence joints come, where the tool is.

    ``tools`` is base_T_tool of each visit (N x 4 x 4).
    """
    commands = np.array([visit.command for visit in table]).T
    before = np.array([visit.before for visit in table]).T
    moves = commands - before
    sides = np.where(np.abs(moves) > _STILL, np.sign(moves), 0.0)
    channels = dict(zip((*space.channels, *approach_channels(space)), (*commands, *sides), strict=True))
    extra: dict[str, tuple[str, ...]] = {
        "pose": tuple(visit.pose for visit in table),
        "cycle": tuple(str(visit.cycle) for visit in table),
        "direction": tuple(visit.direction for visit in table),
    }
    for name, dimension, row in zip(space.names, space.dimensions, before, strict=True):
        unit = display_unit(dimension).name
        extra[f"from_{name}_{unit}"] = _texts(to_unit(row, unit))
    extra |= {f"tool_{axis}_mm": _texts(to_unit(tools[:, i, 3], "mm")) for i, axis in enumerate("xyz")}
    ids = tuple(f"{visit.pose}.{visit.direction}.{visit.cycle}" for visit in table)
    return Dataset(ids, channels, extra, source="plan")


def _texts(values: Array) -> tuple[str, ...]:
    return tuple(f"{value:.6f}" for value in values.tolist())


@dataclass(frozen=True)
class IsoPlan:
    """A cube and its test.

    Attributes:
        cube: where it stands.
        dataset: the visits, in order.
        motion: the largest motion of a joint between poses (rad or m).
        warnings: for the user.
    """

    cube: Cube
    dataset: Dataset
    motion: float
    warnings: tuple[str, ...]


def make_iso_plan(
    experiment: Experiment, size: float | None, cycles: int, directions: int, calibration: Path | None = None
) -> IsoPlan:
    """The test in a cube of this size (m), or the largest that fits; for the rigid nominal arm, or a calibrated one.

    Raises:
        ConfigError: there are several arms, or joints without limits.
        ProblemError: no cube fits.
    """
    hint = "Describe the arm that is to be tested alone."
    arm = only_arm(experiment.system.arms, "the test is of a single arm", hint)
    space = JointSpace.of(experiment)
    settings = experiment.settings.plan or PlanSettings()
    # Of each joint, stated or the model's own; ``spread`` refuses a joint without.
    own, stated, check = joint_limits(arm.nominal_chain), space.limits(settings), clearance_of(experiment)
    model = np.array([own.get(joint) or (-np.inf, np.inf) for joint in arm.commanded], dtype=float)
    limits = np.where(np.isfinite(stated), stated, model)
    parameters = values_about(experiment, calibration)
    plain = replace(arm, effects={}, masses=()) if calibration is None else arm
    compensator = Compensator(
        arm_expression(plain, parameters, experiment.system.environment),
        parameters,
        Options(limits={name: (low, high) for name, (low, high) in zip(space.names, limits.tolist(), strict=True)}),
        check,
    )
    pool = spread(settings.model_copy(update={"count": _POSTURES}), space, limits, check)
    chosen = placed(compensator, pool.dataset.stacked(space.channels), size)
    table, warnings = visits(compensator, chosen, cycles, directions)
    tools = compensator.forward(np.array([visit.command for visit in table]))
    return IsoPlan(
        chosen.cube,
        dataset_of_visits(table, space, tools),
        float(np.ptp(chosen.commands, axis=0).max()),
        warnings if check is not None else (*warnings, _NO_CLEARANCE),
    )
