"""Checks on measurements: channels, noise, residual, derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import casadi as ca
import numpy as np

from armcal.arm.assembly import Arm, prefixed
from armcal.base.domains import Array
from armcal.base.parameters import ParameterBlock, Parameters
from armcal.base.se3 import Expression
from armcal.base.units import units_of
from armcal.measure.measurement import Channel, GroupedMeasurement, Measurement
from armcal.measure.partners import OTHER
from armcal.problem.factor import Factor, build_factor
from armcal.problem.readings import readings_by_residual
from armcal.testing.expressions import (
    check_parameters,
    expect_all_used,
    expect_derivatives,
    expect_only,
    expect_repeated,
    near_nominal,
    stacked,
)
from armcal.testing.planar import ARM, GRAVITY, planar_arms, skewed_arms
from armcal.testing.results import PLUGIN_FAULTS, ContractError, NotRun, Recorder, expect
from armcal.testing.settings_checks import Subject
from armcal.testing.unit_checks import dimension_of, expect_gain, expect_small_noise, scalars

ARM_NAMES = ((ARM,), ("left", "right"))
"""The arms that a measurement is built for: one, or if it refuses that, two."""
_RATIO = "1"
_UNITS: Mapping[str, str] = MappingProxyType({"length": "m", "angle": "rad"})
_POINTS = 6
_INSTRUMENT = "instrument"
_GROUP = "front/hole"


@dataclass(frozen=True)
class _Case:
    """A measurement on arms, the parameters of both (all free, the arms' first), and the factor made of them."""

    measurement: Measurement
    own: Sequence[ParameterBlock]
    channels: Sequence[Channel]
    parameters: Parameters
    factor: Factor

    @property
    def arm_blocks(self) -> tuple[ParameterBlock, ...]:
        """The arms' parameters."""
        return self.parameters.blocks[: len(self.parameters.blocks) - len(self.own)]

    @property
    def other_blocks(self) -> tuple[ParameterBlock, ...]:
        """The measurement's own, then those of one group that is not known beforehand."""
        own = self.parameters.blocks[len(self.parameters.blocks) - len(self.own) :]
        return (*own, *_group_blocks(self.measurement))

    def point(self, seed: int = 1) -> tuple[Array, Array]:
        """Values, and a record with random joint angles whose measured channels have what would be read."""
        random = np.random.default_rng(seed)
        values = near_nominal((*self.arm_blocks, *self.other_blocks), random)
        record = random.uniform(-1, 1, self.factor.record.numel())
        shown = self.numbers(self.factor.outputs, (values, record))
        read = dict(zip(self.factor.output_channels, shown, strict=True))
        return values, np.array([read.get(name, record[i]) for i, name in enumerate(self.factor.channels)])

    def function(self, expression: Expression) -> ca.Function:
        """An expression as a function of values and record, one below the other."""
        return ca.Function("shown", [stacked([self.factor.values, self.factor.record])], [stacked([expression])])

    def numbers(self, expression: Expression, at: tuple[Array, Array]) -> Array:
        """An expression's numbers (n) at values and a record."""
        return np.asarray(self.function(expression)(np.concatenate(at))).ravel()


def check_measurement(record: Recorder, subject: Subject) -> None:
    """Everything that a factor asks of a measurement, on planar arms."""
    built = record.check("it builds for one arm, or for two", _build, subject)
    if built is None:
        return
    measurement, names = built
    blocks = check_parameters(record, measurement.parameters)
    channels = record.check("its channels have names and dimensions", _channels, measurement)
    if blocks is None or channels is None:
        return
    case = record.check("it makes a residual", _case, measurement, planar_arms(names), blocks, channels)
    if case is None:
        return
    record.check("noise is positive", _noise, case.factor)
    shown = stacked([case.factor.residual, case.factor.outputs])
    record.check("residuals depend on what is given", expect_only, shown, [case.factor.values, case.factor.record])
    record.check("outputs are channels", _outputs, case)
    record.check("the residual is zero where outputs are measured", _zero, case)
    record.check("its Jacobian is finite and agrees with differences", _jacobian, case)
    record.check("it is the same each time", _repeated, subject, case, names)
    skewed = skewed_arms(names)
    general = record.check("it makes a residual of any arm", _case, measurement, skewed, blocks, channels)
    if general is None:
        return
    record.check("every parameter has an influence", _all_used, general)
    record.check("its residual is in m and rad", _gains, general)
    if general.factor.output_channels:
        slopes = record.check("the noise of every reading follows from its residual", _readings, general)
        axes = [name.rpartition(".")[2] for name in general.factor.output_channels]
        if slopes is not None and set("xyz") <= set(axes):
            record.check("a position's residual is x, y, z, measured minus predicted", _position, axes, slopes)
    if isinstance(measurement, GroupedMeasurement):
        record.check("all groups have the same parameters", _groups, measurement)
        record.check("what a record says of its group fits it", _fits_group, case)


def _build(subject: Subject) -> tuple[Measurement, tuple[str, ...]]:
    refused = []
    for names in ARM_NAMES:
        try:
            measurement: Measurement = subject.build(names)
        except PLUGIN_FAULTS as fault:
            refused.append(f"{', '.join(names)}: {fault}")
            continue
        unknown = [name for name in measurement.arms if name.removesuffix(OTHER) not in names]
        expect(
            len(measurement.arms) > 0 and not unknown,
            f"found the arms {tuple(measurement.arms)}, expected some of {names}",
        )
        return measurement, names
    raise ContractError("it refuses every choice of arms; " + "; ".join(refused))


def _channels(measurement: Measurement) -> tuple[Channel, ...]:
    channels = tuple(measurement.channels())
    names = [channel.name for channel in channels]
    expect(len(set(names)) == len(names), f"found the channels {', '.join(names)}, expected every name once")
    for channel in channels:
        expect(
            channel.name.isidentifier(), f"found the channel {channel.name!r}, expected letters, digits, underscores"
        )
        if channel.dimension != _RATIO:
            units_of(channel.dimension)
    return channels


def _case(
    measurement: Measurement, arms: Mapping[str, Arm], own: Sequence[ParameterBlock], channels: Sequence[Channel]
) -> _Case:
    of_arms = (block for arm in arms.values() for block in arm.parameters())
    parameters = Parameters((*of_arms, *prefixed(f"{_INSTRUMENT}.", own)))
    parameters = parameters.with_free(parameters.names)
    available = frozenset(f"{_INSTRUMENT}.{channel.name}" for channel in channels)
    factor = build_factor(_INSTRUMENT, measurement, arms, parameters, GRAVITY, available)
    rows, columns = factor.residual.shape
    expect(rows > 0 and columns == 1, f"found a residual of {rows} x {columns}, expected n x 1")
    return _Case(measurement, own, channels, parameters, factor)


def _noise(factor: Factor) -> None:
    expect(
        all(np.isfinite(noise) and noise > 0 for noise in factor.noise),
        f"found the noise {factor.noise}, expected standard deviations above zero",
    )
    expect_small_noise(factor.noise, factor.dimensions)


def _outputs(case: _Case) -> None:
    measured = [f"{_INSTRUMENT}.{channel.name}" for channel in case.channels]
    unknown = [name for name in case.factor.output_channels if name not in measured]
    expect(not unknown, f"found the outputs {', '.join(unknown)}, expected names of channels")


def _group_blocks(measurement: Measurement) -> tuple[ParameterBlock, ...]:
    """Of one group that is not known beforehand."""
    return tuple(measurement.group_parameters(_GROUP)) if isinstance(measurement, GroupedMeasurement) else ()


def _groups(measurement: GroupedMeasurement) -> None:
    """Every group has the same parameters, and ties hold groups that are there."""
    shapes = {tuple((b.name, b.domain, b.unit) for b in measurement.group_parameters(key)) for key in ("", _GROUP)}
    expect(len(shapes) == 1, "found groups with different parameters, expected the same names, domains and units")
    keys = (_GROUP, f"{_GROUP}_2")
    strange = [tie.groups for tie in measurement.ties(keys) if not set(tie.groups) <= set(keys)]
    expect(not strange, f"found a tie of {strange}, expected only groups it was given")
    expect(measurement.mean_weight >= 1, f"found the mean weight {measurement.mean_weight}, expected at least 1")


def _fits_group(case: _Case) -> None:
    """The values that a record gives its group make that record's residual zero."""
    names = case.factor.nuisance_names
    if not names or set(names) != {block.name for block in _group_blocks(case.measurement)}:
        raise NotRun("a record alone does not say all of its group's parameters")
    values, record = case.point()
    starts = case.numbers(case.factor.nuisance_starts, (values, record))
    values[len(values) - len(starts) :] = starts
    worst = float(np.abs(case.numbers(case.factor.residual, (values, record))).max())
    expect(worst <= 1e-9, f"found a residual of {worst:.1e} with what the record itself says, expected zero")


def _zero(case: _Case) -> None:
    if not case.factor.output_channels:
        raise NotRun("it reads nothing")
    if set(case.factor.output_channels) != {f"{_INSTRUMENT}.{channel.name}" for channel in case.channels}:
        raise NotRun("it has channels without an output")
    worst = float(np.abs(case.numbers(case.factor.residual, case.point())).max())
    expect(worst <= 1e-9, f"found a residual of {worst:.1e}, expected zero")


def _jacobian(case: _Case) -> None:
    values, record = case.point()
    disturbed = record + 0.01 * np.random.default_rng(2).uniform(-1, 1, len(record))
    of_group = [name for block in _group_blocks(case.measurement) for name in block.entry_names]
    names = (*case.parameters.entry_names, *of_group, *case.factor.channels)
    expect_derivatives(case.function(case.factor.residual), np.concatenate([values, disturbed]), "the residual", names)


def _repeated(subject: Subject, case: _Case, names: tuple[str, ...]) -> None:
    def picture(made: Measurement) -> Array:
        same = tuple(made.parameters()) == tuple(case.own)
        expect(same, "found other parameters another time, expected them from its settings alone")
        again = _case(made, planar_arms(names), case.own, tuple(made.channels()))
        shown = stacked([again.factor.residual, again.factor.outputs, again.factor.nuisance_starts])
        return np.concatenate([again.numbers(shown, case.point()), again.factor.noise])

    expect_repeated(lambda: picture(case.measurement), lambda: picture(subject.build(names)))


def _all_used(case: _Case) -> None:
    place, values = sum(block.size for block in case.arm_blocks), {}
    for block in case.other_blocks:
        values[block.name.removeprefix(f"{_INSTRUMENT}.")] = case.factor.values[place : place + block.size]
        place += block.size
    expect_all_used(stacked([case.factor.residual, case.factor.outputs]), values)


def _readings(case: _Case) -> Array:
    """Slopes of the residual by the readings (n_r x outputs), from which noise in the readings is worked out."""
    factor, function = case.factor, case.function(case.factor.residual)
    at = np.concatenate(case.point())
    slope, start = np.asarray(function.jacobian()(at, function(at))), factor.values.numel()
    places = [factor.channels.index(name) if name in factor.channels else None for name in factor.output_channels]
    none = np.zeros(len(slope))
    by_reading = np.array([none if place is None else slope[:, start + place] for place in places]).T
    names = [name.rpartition(".")[2] for name in factor.output_channels]
    idle = [name for name, column in zip(names, by_reading.T, strict=True) if not np.any(column)]
    expect(not idle, f"found that no residual depends on the reading {', '.join(idle)}, expected its noise in one")
    expect(
        readings_by_residual(by_reading[None], np.array(factor.noise)) is not None,
        f"found {len(slope)} residuals that the readings {', '.join(names)} do not each determine, expected that noise "
        "of the residual can be worked out as noise of the readings",
    )
    return by_reading


def _position(names: Sequence[str], slopes: Array) -> None:
    slope = slopes[:3, [names.index(axis) for axis in "xyz"]]
    expect(
        bool(np.allclose(slope, np.eye(3), atol=1e-6)),
        f"found residuals that change by {np.round(slope, 3).tolist()} with x, y and z, expected measured minus "
        "predicted of x, y and z in this order: a run tells by them how the arm and the instrument are mistaken",
    )


def _gains(case: _Case) -> None:
    """What a length or an angle, of a parameter or as it is read, changes in a residual of the same dimension."""
    factor, function, slopes = case.factor, case.function(case.factor.residual), []
    for seed in range(_POINTS):
        at = np.concatenate(case.point(seed))
        at[factor.values.numel() :] += 0.01
        slopes.append(np.abs(np.asarray(function.jacobian()(at, function(at)))))
    slope = np.max(slopes, axis=0)
    rows = {dimension: np.array([d == dimension for d in factor.dimensions]) for dimension in _UNITS}
    others, own = case.arm_blocks, case.other_blocks
    of_arms = [place for place, _ in scalars(others, "m", "rad")]
    both = scalars((*others, *own), "m", "rad")[len(of_arms) :]
    gains = [(dimension_of(b), b.name, slope[:, place]) for place, b in both]
    for unit, dimension in (("m", "length"), ("rad", "angle")):
        places = [place for place, _ in scalars(others, unit)]
        gains.append((dimension, "the arm's parameters", slope[:, places].max(axis=1)))
    for channel in case.channels:
        name = f"{_INSTRUMENT}.{channel.name}"
        if name in factor.channels and channel.dimension in _UNITS:
            column = factor.values.numel() + factor.channels.index(name)
            gains.append((channel.dimension, f"the channel {channel.name}", slope[:, column]))
    for dimension, name, column in gains:
        expect_gain(float(column[rows[dimension]].max(initial=0.0)), "the residual", name, _UNITS[dimension])
