"""Targets as a CSV: where the tool shall be, with what load."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armcal.arm.statics import LOAD_CHANNELS
from armcal.base.arrays import Array
from armcal.base.config_text import ConfigText
from armcal.base.dataset import Dataset
from armcal.base.quaternions import rotation_matrix, rpy_matrices
from armcal.base.units import DIMENSIONLESS, split_suffix
from armcal.calibration.compensation.reach import Reach
from armcal.calibration.compensation.request import FARTHEST_M, Targets
from armcal.calibration.tool_expression import APPROACH, ToolExpression
from armcal.errors import DataError, Location
from armcal.measure.checks import records_of
from armcal.measure.environment import noticed
from armcal.measure.reader import ReadRequest, RequestedChannel, surroundings
from armcal.plugins import PluginRegistry

QUATERNION = ("qw", "qx", "qy", "qz")
RPY = ("roll", "pitch", "yaw")
_NORM = 1e-3
_FARTHER, _NEARER = 10.0, 100.0
_AS_DOCUMENTED = (
    "Give columns x_mm, y_mm, z_mm, for a rotation roll_deg, pitch_deg, yaw_deg or qw, qx, qy, qz as well, with commas "
    "between them and decimal points."
)


@dataclass(frozen=True)
class TargetFile:
    """Targets, and the file's content: ids, columns that nothing asked for, rows set aside."""

    targets: Targets
    dataset: Dataset


def read_targets(path: Path, expression: ToolExpression, registry: PluginRegistry) -> TargetFile:
    """Targets of one arm.

    Columns ``x_mm, y_mm, z_mm``, or ``target_x_mm`` and so on, which alone counts where a joint is called ``x``; for a
    rotation too ``qw, qx, qy, qz`` or ``roll_deg, pitch_deg, yaw_deg`` (about the base frame's x, then y, then z).
    Load, gravity, surroundings and approach stand as in measured data.

    Raises:
        DataError: the file cannot be read, or a rotation is given in part, or twice, or is none.
    """
    dataset = _read(path, expression, registry)
    if not len(dataset):
        raise DataError("it has no targets.", where=Location(str(path)), hint="Give a row for each target.")
    acting = np.repeat(expression.defaults[:, None], len(dataset), axis=1)
    for i, channel in enumerate(expression.channels):
        name = f"{expression.name}.{channel}" if channel.startswith(APPROACH) else channel
        if channel not in expression.joints and dataset.has(name):
            acting[i] = dataset.column(name)
    positions = np.stack([dataset.column(axis) for axis in "xyz"], axis=1)
    row, axis = np.unravel_index(np.abs(positions).argmax(), positions.shape)
    if abs(positions[row, axis]) > FARTHEST_M:
        raise DataError(
            f"found {positions[row, axis]:g} m, expected a place that an arm could have.",
            where=Location(str(path), line=_line(dataset, int(row)), field="xyz"[axis]),
            hint="Check the number and the unit in the column's name.",
        )
    joints = len(expression.joints)
    loads, approaches = acting[2 * joints : 2 * joints + len(LOAD_CHANNELS)], acting[joints : 2 * joints]
    conditions = {name: dataset.column(name) for name in expression.arm.conditions if dataset.has(name)}
    return TargetFile(Targets(positions, _rotations(path, dataset), loads, approaches, conditions), dataset)


def check_units(path: Path, targets: Targets, reach: Reach) -> None:
    """Positions ten times farther out than the arm reaches, or a hundredth of that: a unit is wrong.

    Raises:
        DataError: they are so.
    """
    away = float(np.median(np.linalg.norm(targets.positions, axis=1)))
    if np.isfinite(reach.farthest) and not reach.farthest / _NEARER < away < _FARTHER * reach.farthest:
        raise DataError(
            f"targets are typically {away:.4g} m from the base frame, the arm reaches {reach.farthest:.4g} m.",
            where=Location(str(path)),
            hint="Check the unit in the column names: x_mm or x_m.",
        )


def _read(path: Path, expression: ToolExpression, registry: PluginRegistry) -> Dataset:
    """The columns that mean something to this arm; a warning names those with a unit that do not."""
    # The short name of a column is the joint's where one has it.
    pose = [(axis, "length", True) for axis in "xyz"]
    pose += [(name, DIMENSIONLESS, False) for name in QUATERNION] + [(name, "angle", False) for name in RPY]
    channels = []
    for name, dimension, needed in pose:
        names = (f"target_{name}", name) if name not in expression.joints else (f"target_{name}",)
        channels.append(RequestedChannel(name, names, dimension, needed))
    for name, dimension in surroundings({expression.name: expression.arm}).items():
        if name not in ("time", "sequence"):
            channels.append(RequestedChannel(name, (name,), dimension, False))
    for index, joint in enumerate(expression.joints, start=1):
        names = (f"approach{index}", f"approach_{joint}")
        channels.append(RequestedChannel(f"{expression.name}.{APPROACH}{joint}", names, DIMENSIONLESS, False))
    reader_class = registry.find("reader", "csv").load()
    reader = reader_class(reader_class.Settings(path=ConfigText(str(path))))
    dataset = noticed(records_of(reader, ReadRequest({}, {}, tuple(channels), layout_hint=_AS_DOCUMENTED)))
    units = {name: split_suffix(name) for name in dataset.extra if not any(name in w for w in dataset.warnings)}
    # Commands that stand in the file already give way to those that are found.
    idle = [name for name, split in units.items() if split is not None and split[0] not in expression.joints]
    if not idle:
        return dataset
    text = f"columns that mean nothing to this arm are not used: {', '.join(idle)}."
    return replace(dataset, warnings=(*dataset.warnings, text))


def _line(dataset: Dataset, row: int) -> int:
    return dataset.rows[row] if dataset.rows else row + 1


def _rotations(path: Path, dataset: Dataset) -> Array | None:
    present = {kind: [name for name in names if dataset.has(name)] for kind, names in _KINDS.items()}
    given = [kind for kind, columns in present.items() if columns]
    if not given:
        return None
    if len(given) == 2:
        raise DataError(
            f"it gives the rotation twice, by {', '.join(present[given[0]])} and by {', '.join(present[given[1]])}.",
            where=Location(str(path)),
            hint="Leave one of them out.",
        )
    kind = given[0]
    missing = [name for name in _KINDS[kind] if name not in present[kind]]
    if missing:
        raise DataError(
            f"it gives {', '.join(present[kind])} and not {', '.join(missing)}: that is no rotation.",
            where=Location(str(path)),
            hint="Give all columns, or none where only positions count.",
        )
    stacked = dataset.stacked(_KINDS[kind])
    if kind == "angles":
        return rpy_matrices(stacked.T)
    norms = np.linalg.norm(stacked, axis=0)
    bad = np.flatnonzero(np.abs(norms - 1) > _NORM)
    if bad.size:
        raise DataError(
            f"its quaternion has the norm {norms[bad[0]]:.4g}, expected 1.",
            where=Location(str(path), line=_line(dataset, int(bad[0])), field=", ".join(QUATERNION)),
            hint="Give unit quaternions, the real part first.",
        )
    return np.stack([rotation_matrix(q) for q in (stacked / norms).T])


_KINDS: Mapping[str, tuple[str, ...]] = {"quaternion": QUATERNION, "angles": RPY}
