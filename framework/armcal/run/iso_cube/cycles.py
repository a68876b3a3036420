"""The table of the test: cycles over the five poses, then single poses from several directions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.units import display_unit, to_unit
from armcal.calibration.compensation.compensator import Compensator
from armcal.run.iso_cube.cube import DIRECTED, NAMES
from armcal.run.iso_cube.placement import Placed
from armcal.run.plan_approaches import approach_channels
from armcal.run.plan_poses import JointSpace

PATH = "path"
"""The direction of poses that are come to one from another."""
_OF_SIZE, _FARTHEST = 0.1, 0.05
"""How far an approach begins: of the cube's edge, and at most (m)."""
_STILL = 1e-6
"""A joint that moves less (rad or m) does not come from a side."""


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
            warnings.append(f"{', '.join(lost)}: no approach along {'xyz'[axis]} within limits; left out.")
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
