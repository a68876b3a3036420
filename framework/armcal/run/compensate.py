"""From a file of targets to a file of commands: where they lead, how sure that is, and what nominal ones would do."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from armcal.arm.statics import LOAD_CHANNELS
from armcal.base.arrays import Array
from armcal.base.config_text import ConfigText
from armcal.base.dataset import Dataset
from armcal.base.quaternions import quaternion_of, rotation_matrix, rpy_matrices
from armcal.base.units import DIMENSIONLESS, UNITS, split_suffix
from armcal.calibration.calibration import Calibration, arm_named
from armcal.calibration.compensation import Commands, Compensator, Options, Reach, Targets, nominal_arm, sent
from armcal.calibration.inverse import FARTHEST_M
from armcal.calibration.rigid_chain import turn_between
from armcal.calibration.tool_expression import (
    APPROACH,
    MeasuredPoint,
    Point,
    ToolExpression,
    measured_point,
    tool_point,
)
from armcal.errors import ArmcalError, ConfigError, DataError, Location
from armcal.functions.batch_function import EvaluatorChoice
from armcal.measure.checks import noticed, records_of
from armcal.measure.reader import ReadRequest, RequestedChannel, requested_channels, surroundings
from armcal.measure.tables import write_csv
from armcal.plugins import PluginRegistry
from armcal.run.plan import options_within

_WORTH_COMPILING = 5000  # From this many targets on, waiting for the compiler costs less than doing without it
_QUATERNION = ("qw", "qx", "qy", "qz")
_RPY = ("roll", "pitch", "yaw")
_NORM = 1e-3
_FARTHER, _NEARER = 10.0, 100.0
_AS_DOCUMENTED = (
    "Give columns x_mm, y_mm, z_mm, for a rotation roll_deg, pitch_deg, yaw_deg or qw, qx, qy, qz as well, with commas "
    "between them and decimal points."
)
_KINDS = {"quaternion": _QUATERNION, "angles": _RPY}


def check_units(path: Path, targets: Targets, reach: Reach) -> None:
    """Positions ten times farther out than the arm reaches, or a hundredth of that: a unit is wrong."""
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
    pose += [(name, DIMENSIONLESS, False) for name in _QUATERNION] + [(name, "angle", False) for name in _RPY]
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
        line = dataset.rows[bad[0]] if dataset.rows else int(bad[0]) + 1
        raise DataError(
            f"its quaternion has the norm {norms[bad[0]]:.4g}, expected 1.",
            where=Location(str(path), line=line, field=", ".join(_QUATERNION)),
            hint="Give unit quaternions, the real part first.",
        )
    return np.stack([rotation_matrix(q) for q in (stacked / norms).T])


@dataclass(frozen=True)
class Bench:
    """An arm of a calibration, where it may go and how its commands are chosen."""

    calibration: Calibration
    arm: str  # its instance name
    options: Options  # of compensation, with where it may go
    target: MeasuredPoint | None  # what its instrument reads, if it reads a point of the tool
    point: Point = "tool"  # what is brought to targets

    @classmethod
    def of(
        cls,
        calibration: Calibration,
        arm: str | None,
        within: Path | None,
        registry: PluginRegistry,
        point: Point = "tool",
    ) -> Self:
        """One arm (the only one if no name is given), with the limits and the clearance of a configuration's plan."""
        name = arm_named(calibration.system.arms, arm)
        joints = tuple(calibration.system.arms[name].commanded)
        target = measured_point(calibration.system, name, calibration.parameters.with_free(calibration.free))
        options = options_within(within, joints, registry) if within else Options()
        return cls(calibration, name, options, target, point)

    @property
    def is_judged(self) -> bool:
        """Whether measurements judge the point that arrives: not a tool's origin beside a target that was fitted."""
        return self.point == "target" or self.target is None or not self.target.fitted

    def read(self, path: Path, registry: PluginRegistry) -> tuple[Targets, Dataset]:
        """Targets from a CSV; and the file's content: ids, columns that nothing asked for, rows set aside.

        Columns ``x_mm, y_mm, z_mm``, or ``target_x_mm`` and so on, which alone counts where a joint is called ``x``;
        for a rotation too ``qw, qx, qy, qz`` or ``roll_deg, pitch_deg, yaw_deg`` (about the base frame's x, then y,
        then z). Load, gravity, surroundings and approach stand as in measured data.
        """
        expression = self.calibration.expression(self.arm, self.calibration.system.arms[self.arm].conditions)
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
                where=Location(str(path), line=dataset.rows[row] if dataset.rows else int(row) + 1, field="xyz"[axis]),
                hint="Check the number and the unit in the column's name.",
            )
        joints = len(expression.joints)
        loads, approaches = acting[2 * joints : 2 * joints + len(LOAD_CHANNELS)], acting[joints : 2 * joints]
        conditions = {name: dataset.column(name) for name in expression.arm.conditions if dataset.has(name)}
        targets = Targets(positions, _rotations(path, dataset), loads, approaches, conditions)
        self.calibration.require_payload(dataset.has("payload"), str(path))
        return targets, dataset

    def compensator(self, targets: Targets | None = None) -> Compensator:
        choice: EvaluatorChoice = "compiled" if targets is not None and len(targets) >= _WORTH_COMPILING else "auto"
        conditions = () if targets is None else tuple(targets.conditions)
        try:
            expression = self.calibration.expression(self.arm, conditions, self.point)
            return Compensator(expression, self.calibration.parameters, self.options, choice)
        except ValueError as fault:
            raise ConfigError(f"{fault}.", hint="Correct the limits in the plan.") from fault

    @cached_property
    def nominal(self) -> Compensator:
        """The arm as its controller has it."""
        system, nominal = self.calibration.system, self.calibration.nominal
        at = tool_point(self.point, system, self.arm, nominal)
        return nominal_arm(system.arms[self.arm], nominal, system.environment, replace(self.options, allowed=None), at)


@dataclass(frozen=True)
class Answer:
    """Commands for targets, and what is known about them."""

    bench: Bench
    compensator: Compensator  # that found the commands
    targets: Targets
    commands: Commands

    @cached_property
    def nominal_distances(self) -> Array:
        """From each target to the real arm with the nominal arm's command (N; m); nan where that has none."""
        targets, commands = self.targets, self.commands
        thought = self.bench.nominal.solve(replace(targets, conditions={}), commands.joint_angles)
        reached = self.compensator.stand(thought.joint_angles, targets, commands.approach)
        away = np.linalg.norm(reached.base_T_tool[:, :3, 3] - targets.positions, axis=1)
        return np.where(thought.reached & reached.settled, away, np.nan)

    @cached_property
    def dataset(self) -> Dataset:
        name, joints, commands = self.compensator.expression.name, self.compensator.joints, self.commands
        channels: dict[str, Array] = {f"{name}.{joint}": commands.joint_angles[:, i] for i, joint in enumerate(joints)}
        channels |= {f"{name}.{APPROACH}{joint}": commands.approach[:, i] for i, joint in enumerate(joints)}
        channels |= dict(zip(LOAD_CHANNELS, self.targets.acting, strict=True))
        channels |= self.targets.conditions
        return Dataset(tuple(str(i) for i in range(1, len(commands) + 1)), channels)

    @cached_property
    def radii(self) -> Array | None:
        """Of the ball about the expected place that holds a measurement of it with 95 % (N; m).

        Of the first position that is measured of this arm alone. None if unknown, as for a tool's origin that no
        measurement judges.
        """
        calibration, radii = self.bench.calibration, np.full(len(self.commands), np.nan)
        alone = len(calibration.system.arms) == 1 and calibration.readable and calibration.record.prediction is not None
        if not (self.bench.is_judged and alone):
            return None
        settled = np.flatnonzero(self.commands.reached)
        if not settled.size:
            return radii
        try:
            plus_minus = calibration.plus_minus(self.dataset.subset(settled))
        except ArmcalError:  # such as a record without an equilibrium: commands are worth having without radii
            return None
        if not plus_minus.radii:
            return None
        radii[settled] = next(iter(plus_minus.radii.values()))
        return radii

    def summary(self) -> Mapping[str, float | int | None]:
        """In mm, over the targets that are reached."""
        reached = self.commands.reached
        away = 1000 * self.commands.distances[reached]
        nominal = 1000 * self.nominal_distances[reached & np.isfinite(self.nominal_distances)]
        radii = None if self.radii is None else 1000 * self.radii[reached]
        return {
            "targets": len(reached),
            "reached": int(reached.sum()),
            "error_mm": float(away.mean()) if away.size else None,
            "largest_error_mm": float(away.max()) if away.size else None,
            "nominal_error_mm": float(nominal.mean()) if nominal.size else None,
            "radius_95_mm": float(np.median(radii)) if radii is not None and radii.size else None,
        }


def write_commands(path: Path, answer: Answer, given: Dataset, angle_unit: str, for_nominal: bool = False) -> None:
    """Write commands beside the targets' own ids, angles in ``deg`` or ``rad``; or what a nominal controller is sent.

    Loads and surroundings are written where the targets state them, approaches where they are known.
    """
    compensator, commands, targets = answer.compensator, answer.commands, answer.targets
    arm, name, joints = compensator.expression.arm, compensator.expression.name, compensator.joints
    channels = {
        channel: values
        for channel, values in answer.dataset.channels.items()
        if (not for_nominal and channel.removeprefix(f"{name}.") in joints)
        or (given.has(channel) if channel in LOAD_CHANNELS else "." not in channel)
        or (not for_nominal and APPROACH in channel and values.any())
    }
    extra: dict[str, tuple[str, ...]] = {}
    if for_nominal:  # poses that the controller is sent, and how far the targets are shifted and turned to these
        poses = sent(answer.bench.nominal, commands)
        extra |= _pose("", poses)
        for axis, shifts in zip("xyz", poses[:, :3, 3].T - targets.positions.T, strict=True):
            extra[f"d{axis}_mm"] = _exact(1000 * shifts)
        if targets.rotations is not None:
            for axis, turns in zip("xyz", turn_between(targets.rotations, poses[:, :3, :3]).T, strict=True):
                extra[f"turn_{axis}_rad"] = _exact(turns)
    elif commands.counts is not None:
        for joint, counts in zip(joints, commands.counts.T, strict=True):
            if joint in compensator.expression.servos:
                extra[f"{joint}_counts"] = tuple(str(count) for count in counts)
                extra[f"{joint}_pulse_us"] = short_texts(1e6 * compensator.expression.servos[joint][1].tick * counts)
    extra["reached"] = tuple("yes" if reached else "no" for reached in commands.reached)
    extra |= _pose("tool_", commands.base_T_tool)
    extra["error_mm"] = short_texts(1000 * commands.distances)
    extra["error_deg"] = short_texts(np.asarray(np.degrees(commands.turns)))
    if answer.radii is not None:
        extra["radius95_mm"] = short_texts(1000 * answer.radii)
    extra["nominal_error_mm"] = short_texts(1000 * answer.nominal_distances)
    if commands.moves is not None:
        for kind, unit, scale in (("angle", "deg", 180 / np.pi), ("length", "mm", 1000.0)):
            if own := [i for i, joint in enumerate(joints) if arm.commanded[joint] == kind]:
                longest = np.abs(commands.moves[:, own]).max(axis=1)
                extra[f"longest_move_{unit}"] = short_texts(scale * longest)
    extra |= {"bound_mm": short_texts(1000 * commands.bounds), "reason": commands.reasons}
    requested = requested_channels({name: arm}, {}, measured=False)
    # A target file may be a pose file: its commands, in whatever unit, give way to those that were found.
    replaced = {f"{joint}_{unit}" for joint in joints for unit in UNITS}
    kept = {column: texts for column, texts in given.extra.items() if column not in extra and column not in replaced}
    dataset = replace(given, channels=channels, extra={**extra, **kept})
    write_csv(path, dataset, [c for c in requested if c.channel in channels], {"angle": angle_unit})


def _pose(prefix: str, poses: Array) -> dict[str, tuple[str, ...]]:
    turns = np.array([quaternion_of(pose[:3, :3]) for pose in poses]).reshape(-1, 4)
    columns = {f"{prefix}{axis}_mm": _exact(1000 * poses[:, i, 3]) for i, axis in enumerate("xyz")}
    return columns | {f"{prefix}q{axis}": _exact(turns[:, i]) for i, axis in enumerate("wxyz")}


def _exact(values: Array) -> tuple[str, ...]:
    return tuple(repr(float(value)) if np.isfinite(value) else "" for value in values)


def short_texts(values: NDArray[Any]) -> tuple[str, ...]:
    return tuple(f"{value:.6g}" if np.isfinite(value) else "" for value in values.tolist())
