"""A table of corrections for a controller that only knows the nominal arm: what to give it instead of a target.

At each node of a grid the exact commands are found, and the pose that the nominal arm takes with them is what the
controller must be given. Between nodes corrections are interpolated linearly along each axis; how well that does is
tried at random points between them, through the controller's own inverse kinematics.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation

from armcal.base.arrays import Array, Indices, Mask
from armcal.base.dataset import Dataset
from armcal.base.settings import Angle3, Length3, Mass, Settings
from armcal.calibration.compensation.compensator import Compensator
from armcal.calibration.compensation.request import FARTHEST_M, Commands, Targets
from armcal.calibration.rigid_chain import turn_between
from armcal.config.validate import validate
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError, Location, ProblemError
from armcal.measure.csv_writer import write_csv
from armcal.measure.reader import RequestedChannel

_MOST_NODES = 200_000
_POSTURES = 4
_BEGINNINGS = 20


class TableSettings(Settings):
    """A grid in the base frame, between two corners, with ``nodes`` along each axis; the tool's rotation; the load."""

    low: Length3
    high: Length3
    nodes: tuple[Annotated[int, Field(ge=2)], Annotated[int, Field(ge=2)], Annotated[int, Field(ge=2)]]
    rpy: Angle3
    payload: Mass | None = None
    tried: Annotated[int, Field(ge=1, le=100_000)] = 1000
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if any(low >= high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError("low does not lie below high on every axis: give the smaller coordinates as low")
        if np.abs([self.low, self.high]).max() > FARTHEST_M:
            raise ValueError(f"found a corner beyond {FARTHEST_M:g} m: check the numbers and the unit in the keys")
        if np.prod(self.nodes) > _MOST_NODES:
            raise ValueError(
                f"found {np.prod(self.nodes)} nodes, expected {_MOST_NODES} at most: make the grid coarser"
            )
        return self


class TableFileSettings(Settings):
    """The file: ``table: {low_mm: ..., high_mm: ..., nodes: ..., rpy_deg: ...}``."""

    table: TableSettings


@dataclass(frozen=True)
class CorrectionTable:
    """Corrections at the nodes of a grid.

    Attributes:
        axes: the nodes' coordinates along x, y and z (m).
        reached: whether a node's pose can be reached (grid).
        shifts: what to add to a position (grid x 3; m); nan where the pose cannot be reached.
        turns: by what to turn a rotation, a rotation vector in the base frame (grid x 3; rad).
        tried: errors at random points between nodes that can be reached: with the table, and without it (N x 2; m).
    """

    axes: tuple[Array, Array, Array]
    reached: Mask
    shifts: Array
    turns: Array
    tried: Array


def read_table_settings(path: Path) -> TableSettings:
    """Read and check the settings of a table.

    Raises:
        ConfigError: with file, line and field.
    """
    return validate(TableFileSettings, load_config(path)).table


def correction_table(compensator: Compensator, nominal: Compensator, settings: TableSettings) -> CorrectionTable:
    """The table for an arm and what its controller takes it for.

    Raises:
        ConfigError: the arm has too few joints to keep a rotation.
        ProblemError: no node can be reached.
    """
    if len(compensator.joints) < 6:
        raise ConfigError(
            f"the arm has {len(compensator.joints)} joints, expected 6 or more to keep the rotation of a table.",
            where=Location(field="table"),
            hint="Correct targets one by one: the columns tell_nominal of --targets.",
        )
    axes = [np.linspace(*ends) for ends in zip(settings.low, settings.high, settings.nodes, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    commands = over_grid(compensator, _targets(compensator, nodes, settings), settings.nodes)
    if not commands.reached.any():
        raise ProblemError("no node of the grid can be reached.", hint="Move the grid, or change the rotation.")
    commanded = nominal.forward(commands.joint_angles)  # where the nominal arm takes these commands to lead
    shape = settings.nodes
    nothing = np.where(commands.reached, 1.0, np.nan)[:, None]
    rotations = np.repeat(_rotation(settings)[None], len(nodes), axis=0)
    table = CorrectionTable(
        axes=(axes[0], axes[1], axes[2]),
        reached=commands.reached.reshape(shape),
        shifts=((commanded[:, :3, 3] - nodes) * nothing).reshape(*shape, 3),
        turns=(turn_between(rotations, commanded[:, :3, :3]) * nothing).reshape(*shape, 3),
        tried=np.zeros((0, 2)),
    )
    starts = commands.joint_angles.reshape(*shape, -1)
    return _tried(compensator, nominal, settings, table, starts)


def write_table(path: Path, table: CorrectionTable) -> None:
    """One row a node: ``x_mm, y_mm, z_mm``, what to add, ``dx_mm`` ..., and by what to turn, ``turn_x_rad`` ...

    Raises:
        DataError: the file cannot be written.
    """
    nodes = np.stack(np.meshgrid(*table.axes, indexing="ij"), axis=-1).reshape(-1, 3)
    columns = {axis: nodes[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"d{axis}": table.shifts.reshape(-1, 3)[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"turn_{axis}": table.turns.reshape(-1, 3)[:, i] for i, axis in enumerate("xyz")}
    kinds = {name: "angle" if name.startswith("turn") else "length" for name in columns}
    requested_channels = [RequestedChannel(name, (name,), kind, True) for name, kind in kinds.items()]
    ids = tuple(str(i) for i in range(1, len(nodes) + 1))
    write_csv(path, Dataset(ids, columns), requested_channels, {"angle": "rad"})


def _tried(
    compensator: Compensator, nominal: Compensator, settings: TableSettings, table: CorrectionTable, starts: Array
) -> CorrectionTable:
    """The table, tried at random points of cells whose corners can all be reached."""
    random = np.random.default_rng(settings.seed)
    points = random.uniform(settings.low, settings.high, (settings.tried, 3))
    shift, turn, near = (
        RegularGridInterpolator(table.axes, grid, method="linear", bounds_error=False)(points)
        for grid in (table.shifts, table.turns, starts)
    )
    whole = np.isfinite(shift).all(axis=1)
    points, shift, turn, near = points[whole], shift[whole], turn[whole], near[whole]
    rotation = Rotation.from_matrix(_rotation(settings))
    errors = []
    for target, turned in ((points + shift, (Rotation.from_rotvec(turn) * rotation).as_matrix()), (points, None)):
        rotations = np.repeat(_rotation(settings)[None], len(points), axis=0) if turned is None else turned
        thought = nominal.solve(nominal.targets(target, rotations), near)
        targets = _targets(compensator, points, settings)
        stands = compensator.stand(thought.joint_angles, targets, np.zeros_like(thought.joint_angles))
        away = np.linalg.norm(stands.base_T_tool[:, :3, 3] - points, axis=1)
        errors.append(np.where(thought.reached & stands.settled, away, np.nan))
    return replace(table, tried=np.stack(errors, axis=1))


def _targets(compensator: Compensator, positions: Array, settings: TableSettings) -> Targets:
    rotations = np.repeat(_rotation(settings)[None], len(positions), axis=0)
    return compensator.targets(positions, rotations, payload=settings.payload)


def _rotation(settings: TableSettings) -> Array:
    return np.asarray(Rotation.from_euler("xyz", settings.rpy).as_matrix())


def over_grid(compensator: Compensator, targets: Targets, shape: Sequence[int]) -> Commands:
    """Commands for the nodes of a grid (targets in C order): of the postures that its middle allows, the widest."""
    nodes = np.indices(tuple(shape)).reshape(len(shape), -1).T
    middle = np.argsort(((nodes - (np.array(shape) - 1) / 2) ** 2).sum(axis=1), kind="stable")[:_BEGINNINGS]
    first = compensator.solve(targets.subset(middle))
    widest, most = np.full((len(targets), len(compensator.joints)), np.nan), 0
    for row in middle[first.reached][:1]:
        for begun in compensator.postures(targets.subset(np.array([row]))).T[:_POSTURES]:
            outward = _outward(compensator, targets, tuple(shape), int(row), begun)
            had = int(np.isfinite(outward[:, 0]).sum())
            widest, most = (outward, had) if had > most else (widest, most)
    known = np.isfinite(widest[:, 0])
    answer = compensator.onward(targets, np.where(known[:, None], widest, 0.0))
    return replace(answer, reached=answer.reached & known)


def _outward(compensator: Compensator, targets: Targets, shape: tuple[int, ...], begin: int, posture: Array) -> Array:
    """Commands (N x n) of the nodes that can be reached from a beginning, nan elsewhere."""
    commands = np.full((len(targets), len(compensator.joints)), np.nan)
    commands[begin] = posture
    tried: set[tuple[int, int]] = set()
    while True:
        had = np.isfinite(commands[:, 0])
        rows, neighbours = _edge(had.reshape(shape), tried)
        if not rows.size:
            return commands
        onward = compensator.onward(targets.subset(rows), commands[neighbours])
        commands[rows[onward.reached]] = onward.joint_angles[onward.reached]


def _edge(had: Mask, tried: set[tuple[int, int]]) -> tuple[Indices, Indices]:
    """Nodes beside such as are reached, each with one neighbour that it was not yet tried from."""
    index = np.arange(had.size).reshape(had.shape)
    pairs: dict[int, int] = {}
    for axis in range(had.ndim):
        low, high = (np.moveaxis(index, axis, 0)[part].ravel() for part in (slice(None, -1), slice(1, None)))
        for new, old in ((low, high), (high, low)):
            chosen = ~had.ravel()[new] & had.ravel()[old]
            pairs |= {
                int(a): int(b) for a, b in zip(new[chosen], old[chosen], strict=True) if (int(a), int(b)) not in tried
            }
    tried |= set(pairs.items())
    return np.array(list(pairs), dtype=np.intp), np.array(list(pairs.values()), dtype=np.intp)
