"""Checks on measurements: channels, noise, residual, derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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


def check_measurement(record: Recorder, subject: Subject) -> None:
    """Everything that a factor asks of a measurement, on planar arms."""
    built = record.check("it builds for one arm, or for two", lambda: _build(subject))
    if built is None:
        return
    measurement, arms = built
    blocks = check_parameters(record, measurement.parameters)
    channels = record.check("its channels have names and dimensions", lambda: _channels(measurement))
    if blocks is None or channels is None:
        return
    factor = record.check("it makes a residual", lambda: _factor(measurement, arms, blocks, channels))
    if factor is None:
        return
    record.check("noise is positive", lambda: _noise(factor))
    record.check("residuals depend on what is given", lambda: _closed(factor))
    measured = [f"{_INSTRUMENT}.{channel.name}" for channel in channels]
    record.check("outputs are channels", lambda: _outputs(factor, measured))
    record.check(
        "the residual is zero where outputs are measured", lambda: _zero(factor, measurement, arms, blocks, measured)
    )
    record.check(
        "its Jacobian is finite and agrees with differences", lambda: _jacobian(factor, measurement, arms, blocks)
    )
    record.check("it is the same each time", lambda: _repeated(subject, factor, measurement, arms, blocks))
    skewed = skewed_arms(tuple(arms))
    general = record.check("it makes a residual of any arm", lambda: _factor(measurement, skewed, blocks, channels))
    if general is None:
        return
    record.check("every parameter has an influence", lambda: _all_used(general, measurement, arms, blocks))
    record.check("its residual is in m and rad", lambda: _gains(general, measurement, arms, blocks, channels))
    if general.output_channels:
        _check_readings(record, general, measurement, arms, blocks)
    if isinstance(measurement, GroupedMeasurement):
        record.check("all groups have the same parameters", lambda: _groups(measurement))
        record.check("what a record says of its group fits it", lambda: _told(factor, measurement, arms, blocks))


def _build(subject: Subject) -> tuple[Measurement, dict[str, Arm]]:
    refused = []
    for names in ARM_NAMES:
        try:
            measurement: Measurement = subject.made(subject.settings, names)
        except PLUGIN_FAULTS as fault:
            refused.append(f"{', '.join(names)}: {fault}")
            continue
        unknown = [name for name in measurement.arms if name.removesuffix(OTHER) not in names]
        expect(
            len(measurement.arms) > 0 and not unknown,
            f"found the arms {tuple(measurement.arms)}, expected some of {names}",
        )
        return measurement, planar_arms(names)
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


def _factor(
    measurement: Measurement,
    arms: Mapping[str, Arm],
    blocks: Sequence[ParameterBlock],
    channels: Sequence[Channel],
) -> Factor:
    parameters = _parameters(arms, blocks)
    available = frozenset(f"{_INSTRUMENT}.{channel.name}" for channel in channels)
    factor = build_factor(_INSTRUMENT, measurement, arms, parameters, GRAVITY, available)
    rows, columns = factor.residual.shape
    expect(rows > 0 and columns == 1, f"found a residual of {rows} x {columns}, expected n x 1")
    return factor


def _parameters(arms: Mapping[str, Arm], blocks: Sequence[ParameterBlock]) -> Parameters:
    own = prefixed(f"{_INSTRUMENT}.", blocks)
    all_blocks = Parameters((*(block for arm in arms.values() for block in arm.parameters()), *own))
    return all_blocks.with_free(all_blocks.names)


def _noise(factor: Factor) -> None:
    expect(
        all(np.isfinite(noise) and noise > 0 for noise in factor.noise),
        f"found the noise {factor.noise}, expected standard deviations above zero",
    )
    expect_small_noise(factor.noise, factor.dimensions)


def _closed(factor: Factor) -> None:
    shown = stacked([factor.residual, factor.outputs])
    expect_only(shown, [factor.values, factor.record])


def _outputs(factor: Factor, measured: Sequence[str]) -> None:
    unknown = [name for name in factor.output_channels if name not in measured]
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


def _told(factor: Factor, measurement: Measurement, arms: Mapping[str, Arm], blocks: Sequence[ParameterBlock]) -> None:
    """What a record says of its group fits that record."""
    own = _group_blocks(measurement)
    if not factor.nuisance_names or set(factor.nuisance_names) != {block.name for block in own}:
        raise NotRun("a record alone does not say all of its group's parameters")
    values, record = _point(factor, measurement, arms, blocks)
    said = np.asarray(_function(factor, factor.nuisance_starts)(np.concatenate([values, record]))).ravel()
    values[len(values) - len(said) :] = said
    residual = np.asarray(_function(factor, factor.residual)(np.concatenate([values, record]))).ravel()
    worst = float(np.abs(residual).max())
    expect(worst <= 1e-9, f"found a residual of {worst:.1e} with what the record itself says, expected zero")


def _point(
    factor: Factor, measurement: Measurement, arms: Mapping[str, Arm], blocks: Sequence[ParameterBlock], seed: int = 1
) -> tuple[Array, Array]:
    """Values, and a record with random joint angles whose measured channels say what would be read."""
    random = np.random.default_rng(seed)
    values = near_nominal((*_parameters(arms, blocks).blocks, *_group_blocks(measurement)), random)
    record = random.uniform(-1, 1, factor.record.numel())
    shown = np.asarray(_function(factor, factor.outputs)(np.concatenate([values, record]))).ravel()
    read = dict(zip(factor.output_channels, shown, strict=True))
    return values, np.array([read.get(name, record[i]) for i, name in enumerate(factor.channels)])


def _function(factor: Factor, expression: Expression) -> ca.Function:
    return ca.Function("shown", [stacked([factor.values, factor.record])], [stacked([expression])])


def _zero(
    factor: Factor,
    measurement: Measurement,
    arms: Mapping[str, Arm],
    blocks: Sequence[ParameterBlock],
    measured: Sequence[str],
) -> None:
    if not factor.output_channels:
        raise NotRun("it reads nothing")
    if set(factor.output_channels) != set(measured):
        raise NotRun("it has channels without an output")
    residual = np.asarray(
        _function(factor, factor.residual)(np.concatenate(_point(factor, measurement, arms, blocks)))
    ).ravel()
    worst = float(np.abs(residual).max())
    expect(worst <= 1e-9, f"found a residual of {worst:.1e}, expected zero")


def _jacobian(
    factor: Factor, measurement: Measurement, arms: Mapping[str, Arm], blocks: Sequence[ParameterBlock]
) -> None:
    values, record = _point(factor, measurement, arms, blocks)
    disturbed = record + 0.01 * np.random.default_rng(2).uniform(-1, 1, len(record))
    at = np.concatenate([values, disturbed])
    of_group = [name for block in _group_blocks(measurement) for name in block.entry_names]
    names = (*_parameters(arms, blocks).entry_names, *of_group, *factor.channels)
    expect_derivatives(_function(factor, factor.residual), at, "the residual", names)


def _repeated(
    subject: Subject,
    factor: Factor,
    measurement: Measurement,
    arms: Mapping[str, Arm],
    blocks: Sequence[ParameterBlock],
) -> None:
    def picture(made: Measurement) -> Array:
        same = tuple(made.parameters()) == tuple(blocks)
        expect(same, "found other parameters another time, expected them from its settings alone")
        own = _factor(made, arms, blocks, tuple(made.channels()))
        shown = stacked([own.residual, own.outputs, own.nuisance_starts])
        at = np.concatenate(_point(factor, measurement, arms, blocks))
        return np.concatenate([np.asarray(_function(own, shown)(at)).ravel(), own.noise])

    expect_repeated(lambda: picture(measurement), lambda: picture(subject.made(subject.settings, tuple(arms))))


def _own_entries(
    factor: Factor, measurement: Measurement, arms: Mapping[str, Arm], blocks: Sequence[ParameterBlock]
) -> tuple[tuple[ParameterBlock, ...], tuple[ParameterBlock, ...]]:
    """The arms' blocks, and the measurement's own with those of a group; together all entries in their order."""
    own = prefixed(f"{_INSTRUMENT}.", blocks)
    every = _parameters(arms, blocks).blocks
    return every[: len(every) - len(own)], (*every[len(every) - len(own) :], *_group_blocks(measurement))


def _all_used(
    factor: Factor, measurement: Measurement, arms: Mapping[str, Arm], blocks: Sequence[ParameterBlock]
) -> None:
    others, own = _own_entries(factor, measurement, arms, blocks)
    place, values = sum(block.size for block in others), {}
    for block in own:
        values[block.name.removeprefix(f"{_INSTRUMENT}.")] = factor.values[place : place + block.size]
        place += block.size
    expect_all_used(stacked([factor.residual, factor.outputs]), values)


def _check_readings(
    record: Recorder,
    factor: Factor,
    measurement: Measurement,
    arms: Mapping[str, Arm],
    blocks: Sequence[ParameterBlock],
) -> None:
    names = [name.rpartition(".")[2] for name in factor.output_channels]
    slopes = record.check(
        "the noise of every reading follows from its residual", lambda: _readings(factor, measurement, arms, blocks)
    )
    if slopes is not None and set("xyz") <= set(names):
        record.check("a position's residual is x, y, z, measured minus predicted", lambda: _position(names, slopes))


def _readings(
    factor: Factor, measurement: Measurement, arms: Mapping[str, Arm], blocks: Sequence[ParameterBlock]
) -> Array:
    """Slopes of the residual by the readings (n_r x outputs), from which noise in the readings is worked out."""
    function = _function(factor, factor.residual)
    at = np.concatenate(_point(factor, measurement, arms, blocks))
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


def _gains(
    factor: Factor,
    measurement: Measurement,
    arms: Mapping[str, Arm],
    blocks: Sequence[ParameterBlock],
    channels: Sequence[Channel],
) -> None:
    """What a length or an angle, of a parameter or as it is read, changes in a residual of the same dimension."""
    function, slopes = _function(factor, factor.residual), []
    for seed in range(_POINTS):
        at = np.concatenate(_point(factor, measurement, arms, blocks, seed))
        at[factor.values.numel() :] += 0.01
        slopes.append(np.abs(np.asarray(function.jacobian()(at, function(at)))))
    slope = np.max(slopes, axis=0)
    rows = {dimension: np.array([d == dimension for d in factor.dimensions]) for dimension in _UNITS}
    others, own = _own_entries(factor, measurement, arms, blocks)
    of_arms = [place for place, _ in scalars(others, "m", "rad")]
    both = scalars((*others, *own), "m", "rad")[len(of_arms) :]
    gains = [(dimension_of(b), b.name, slope[:, place]) for place, b in both]
    for unit, dimension in (("m", "length"), ("rad", "angle")):
        places = [place for place, _ in scalars(others, unit)]
        gains.append((dimension, "the arm's parameters", slope[:, places].max(axis=1)))
    for channel in channels:
        name = f"{_INSTRUMENT}.{channel.name}"
        if name in factor.channels and channel.dimension in _UNITS:
            column = factor.values.numel() + factor.channels.index(name)
            gains.append((channel.dimension, f"the channel {channel.name}", slope[:, column]))
    for dimension, name, column in gains:
        expect_gain(float(column[rows[dimension]].max(initial=0.0)), "the residual", name, _UNITS[dimension])
