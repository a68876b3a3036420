"""Checks on measurements: channels, noise, residual, derivatives."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import casadi as ca
import numpy as np

from armcal.arm.assembly import Arm, prefixed
from armcal.base.arrays import Array
from armcal.base.parameters import ParameterBlock, Parameters
from armcal.base.se3 import Expression
from armcal.base.units import ERROR_UNITS, display_unit, si_unit, units_of
from armcal.measure.measurement import Channel, GroupedMeasurement, Measurement
from armcal.measure.partners import OTHER
from armcal.problem.factor import Factor, build_factor
from armcal.problem.readings import readings_by_residual
from armcal.testing.expressions import (
    check_parameters,
    expect_all_used,
    expect_derivatives,
    expect_gain,
    expect_only,
    expect_repeated,
    near_nominal,
    scalars,
    stacked,
)
from armcal.testing.planar import ARM, GRAVITY, planar_arms, skewed_arms
from armcal.testing.results import PLUGIN_FAULTS, ContractError, NotRun, Recorder, expect
from armcal.testing.settings_checks import Subject

ARM_NAMES = ((ARM,), ("left", "right"))
"""The arms that a measurement is built for: one, or if it refuses that, two."""
_RATIO = "1"
_NOISIEST: Mapping[str, float] = MappingProxyType({"length": 0.1, "angle": 0.5, "image": 0.05})
"""By dimension: the largest standard deviation (m, rad, kpx) of an example that is worth calibrating with."""
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
        return self.parameters.blocks[: len(self.parameters.blocks) - len(self.own)]

    @property
    def other_blocks(self) -> tuple[ParameterBlock, ...]:
        """The measurement's own, then those of one group that is not known beforehand."""
        own = self.parameters.blocks[len(self.parameters.blocks) - len(self.own) :]
        return (*own, *_group_blocks(self.measurement))

    def point(self, seed: int = 1) -> tuple[Array, Array]:
        random = np.random.default_rng(seed)
        values = near_nominal((*self.arm_blocks, *self.other_blocks), random)
        record = random.uniform(-1, 1, self.factor.record.numel())
        shown = self.numbers(self.factor.outputs, (values, record))
        read = dict(zip(self.factor.output_channels, shown, strict=True))
        return values, np.array([read.get(name, record[i]) for i, name in enumerate(self.factor.channels)])

    def function(self, expression: Expression) -> ca.Function:
        return ca.Function("shown", [stacked([self.factor.values, self.factor.record])], [stacked([expression])])

    def numbers(self, expression: Expression, at: tuple[Array, Array]) -> Array:
        """An expression's numbers (n) at values and a record."""
        return np.asarray(self.function(expression)(np.concatenate(at))).ravel()


def check_measurement(record: Recorder, subject: Subject) -> None:
    """Everything that a factor asks of a measurement, on planar arms."""
    with record.needed("it builds for one arm, or for two"):
        measurement, names = _build(subject)
    blocks = check_parameters(record, measurement.parameters)
    with record.needed("its channels have names and dimensions"):
        channels = tuple(measurement.channels())
        listed = [channel.name for channel in channels]
        expect(len(set(listed)) == len(listed), f"found the channels {', '.join(listed)}, expected every name once")
        for channel in channels:
            called = f"found the channel {channel.name!r}"
            expect(channel.name.isidentifier(), f"{called}, expected letters, digits, underscores")
            if channel.dimension != _RATIO:
                units_of(channel.dimension)
    with record.needed("it makes a residual"):
        case = _case(measurement, planar_arms(names), blocks, channels)
    _check_residual(record, case)
    with record.check("it is the same each time"):
        expect_repeated(lambda made: _picture(made, case, names), measurement, subject.build(names))
    with record.group():
        with record.needed("it makes a residual of any arm"):
            general = _case(measurement, skewed_arms(names), blocks, channels)
        _check_influence(record, general)
    if isinstance(measurement, GroupedMeasurement):
        _check_groups(record, measurement, case)


def _check_residual(record: Recorder, case: _Case) -> None:
    factor = case.factor
    with record.check("noise is plausible in its unit"):
        for number, dimension in zip(factor.noise, factor.dimensions, strict=False):
            largest = _NOISIEST.get(dimension, math.inf)
            unit = si_unit(dimension).name
            most = f"expected up to {largest:g} {unit} in an example: is it in {display_unit(dimension).name}?"
            expect(number <= largest, f"found a noise of {number:g} {unit}, {most}")
    with record.check("residuals depend on what is given"):
        expect_only(stacked([factor.residual, factor.outputs]), [factor.values, factor.record])
    measured = {f"{_INSTRUMENT}.{channel.name}" for channel in case.channels}
    with record.check("the residual is zero where outputs are measured"):
        if not factor.output_channels:
            raise NotRun("it reads nothing")
        if set(factor.output_channels) != measured:
            raise NotRun("it has channels without an output")
        worst = float(np.abs(case.numbers(factor.residual, case.point())).max())
        expect(worst <= 1e-9, f"found a residual of {worst:.1e}, expected zero")
    with record.check("its Jacobian is finite and agrees with differences"):
        values, reading = case.point()
        disturbed = reading + 0.01 * np.random.default_rng(2).uniform(-1, 1, len(reading))
        of_group = [name for block in _group_blocks(case.measurement) for name in block.entry_names]
        names = (*case.parameters.entry_names, *of_group, *factor.channels)
        expect_derivatives(case.function(factor.residual), np.concatenate([values, disturbed]), "the residual", names)


def _check_influence(record: Recorder, case: _Case) -> None:
    """What moves the residual of an arm every point of whose tool moves in a way of its own."""
    with record.check("every parameter has an influence"):
        place, values = sum(block.size for block in case.arm_blocks), {}
        for block in case.other_blocks:
            values[block.name.removeprefix(f"{_INSTRUMENT}.")] = case.factor.values[place : place + block.size]
            place += block.size
        expect_all_used(stacked([case.factor.residual, case.factor.outputs]), values)
    with record.check("its residual is in m and rad"):
        _expect_gains(case)
    if not case.factor.output_channels:
        return
    with record.needed("the noise of every reading follows from its residual"):
        slopes = _readings(case)
    axes = [name.rpartition(".")[2] for name in case.factor.output_channels]
    if set("xyz") <= set(axes):
        with record.check("a position's residual is x, y, z, measured minus predicted"):
            slope = slopes[:3, [axes.index(axis) for axis in "xyz"]]
            expect(
                bool(np.allclose(slope, np.eye(3), atol=1e-6)),
                f"found residuals that change by {np.round(slope, 3).tolist()} with x, y and z, expected measured "
                "minus predicted of x, y and z in this order: a run tells by them how the arm and the instrument are "
                "mistaken",
            )


def _check_groups(record: Recorder, measurement: GroupedMeasurement, case: _Case) -> None:
    with record.check("all groups have the same parameters"):
        keys = ("", _GROUP, f"{_GROUP}_2")
        shapes = {tuple((b.name, b.domain, b.unit) for b in measurement.group_parameters(key)) for key in keys[:2]}
        expect(len(shapes) == 1, "found groups with different parameters, expected the same names, domains and units")
        strange = [tie.groups for tie in measurement.ties(keys[1:]) if not set(tie.groups) <= set(keys[1:])]
        expect(not strange, f"found a tie of {strange}, expected only groups it was given")
        expect(measurement.mean_weight >= 1, f"found the mean weight {measurement.mean_weight}, expected at least 1")
    with record.check("what a record says of its group fits it"):
        names = case.factor.nuisance_names
        if not names or set(names) != {block.name for block in _group_blocks(case.measurement)}:
            raise NotRun("a record alone does not say all of its group's parameters")
        values, reading = case.point()
        starts = case.numbers(case.factor.nuisance_starts, (values, reading))
        values[len(values) - len(starts) :] = starts
        worst = float(np.abs(case.numbers(case.factor.residual, (values, reading))).max())
        expect(worst <= 1e-9, f"found a residual of {worst:.1e} with what the record itself says, expected zero")


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


def _case(
    measurement: Measurement, arms: Mapping[str, Arm], own: Sequence[ParameterBlock], channels: Sequence[Channel]
) -> _Case:
    of_arms = (block for arm in arms.values() for block in arm.parameters())
    parameters = Parameters((*of_arms, *prefixed(f"{_INSTRUMENT}.", own)))
    parameters = parameters.with_free(parameters.names)
    available = frozenset(f"{_INSTRUMENT}.{channel.name}" for channel in channels)
    factor = build_factor(_INSTRUMENT, measurement, arms, parameters, GRAVITY, available, unrolled=True)
    rows, columns = factor.residual.shape
    expect(rows > 0 and columns == 1, f"found a residual of {rows} x {columns}, expected n x 1")
    return _Case(measurement, own, channels, parameters, factor)


def _group_blocks(measurement: Measurement) -> tuple[ParameterBlock, ...]:
    return tuple(measurement.group_parameters(_GROUP)) if isinstance(measurement, GroupedMeasurement) else ()


def _picture(made: Measurement, case: _Case, names: tuple[str, ...]) -> Array:
    same = tuple(made.parameters()) == tuple(case.own)
    expect(same, "found other parameters another time, expected them from its settings alone")
    again = _case(made, planar_arms(names), case.own, tuple(made.channels()))
    shown = stacked([again.factor.residual, again.factor.outputs, again.factor.nuisance_starts])
    return np.concatenate([again.numbers(shown, case.point()), again.factor.noise])


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


def _expect_gains(case: _Case) -> None:
    """What a length or an angle, of a parameter or as it is read, changes in a residual of the same dimension."""
    factor, function, slopes = case.factor, case.function(case.factor.residual), []
    for seed in range(_POINTS):
        at = np.concatenate(case.point(seed))
        at[factor.values.numel() :] += 0.01
        slopes.append(np.abs(np.asarray(function.jacobian()(at, function(at)))))
    slope = np.max(slopes, axis=0)
    gains = []
    for unit in ("m", "rad"):
        of_arms = [place for place, _ in scalars(case.arm_blocks, unit)]
        others = scalars((*case.arm_blocks, *case.other_blocks), unit)[len(of_arms) :]
        gains += [(unit, block.name, slope[:, place]) for place, block in others]
        gains.append((unit, "the arm's parameters", slope[:, of_arms].max(axis=1)))
    for channel in case.channels:
        name = f"{_INSTRUMENT}.{channel.name}"
        if name in factor.channels and channel.dimension in ERROR_UNITS:
            column = factor.values.numel() + factor.channels.index(name)
            gains.append((si_unit(channel.dimension).name, f"the channel {channel.name}", slope[:, column]))
    units = np.array([si_unit(dimension).name for dimension in factor.dimensions])
    for unit, name, column in gains:
        expect_gain(float(column[units == unit].max(initial=0.0)), "the residual", name, unit)
