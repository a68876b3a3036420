"""One factor type as expressions: residuals of one record as a function of values, record and elastic state.

The elastic equilibrium ``state = pass(state)`` is never unrolled. At a state d near it, with pass F and
residual r, everything follows from one pass and a small solve:

    A = dr/dd (I - dF/dd)^-1,    r* = r + A (F - d),    dr*/dv = d(r + A F)/dv  with A held,

the implicit function theorem in adjoint form [Griewank2008]: its cost hardly grows with the number of
parameters, and r* is the residual in equilibrium up to the square of what is left of the state's error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
from typing_extensions import override

from armcal.arm.assembly import Arm, ArmInputs, ArmState, LocalValues, scoped
from armcal.arm.evaluator import ElasticPass
from armcal.arm.pose_residual import SURROUNDINGS, correction_names
from armcal.arm.statics import LOAD_CHANNELS, STATICS, Environment, Load, tilted
from armcal.base.arrays import Array
from armcal.base.parameters import ParameterBlock, Parameters
from armcal.base.se3 import Expression, column
from armcal.base.units import ERROR_UNITS
from armcal.errors import ProblemError
from armcal.measure.groups import OTHER
from armcal.measure.measurement import (
    GroupedMeasurement,
    LimitedView,
    Measurement,
    PointMeasurement,
    borrowed_names,
    noise_channels,
    residual_dimensions,
)
from armcal.plugins import expecting, refuse

_POINT = "point."


@dataclass(frozen=True)
class Factor(ElasticPass):
    """The expressions of one measurement.

    ``values`` are the free canonical entries (symbols, n_v; fixed ones are numbers in the expressions), ``record`` a
    symbol a channel, ``state`` the deflections of all arms that take part (symbols, n_d). Of a measurement that reads
    the same of many points, channels, noise and dimensions are those of all points, and ``of_point`` has the
    expressions: its channels are the shared ones, its own, and the k numbers of the point.
    """

    name: str  # the measurement's instance name
    channels: tuple[str, ...]  # the record channels it reads, in the order of ``record``
    output_channels: tuple[str, ...]
    residual: Expression  # m or rad (n_r)
    outputs: Expression  # what the instrument would read (n_o), named by ``output_channels``
    tools: Expression  # each arm's base_T_tool without its last row, column by column (12 an arm; m)
    noise: tuple[float, ...]  # standard deviation of each residual entry
    noise_channels: tuple[tuple[str, ...], ...] = ()  # of each entry, those that may carry its own one, nearest first
    dimensions: tuple[str, ...] = ()  # ``length`` or ``angle`` of each residual entry
    nuisance_starts: Expression = None  # entries of the group's parameters by the record alone; empty for none
    nuisance_names: tuple[str, ...] = ()  # local names of the parameters of these entries, one an entry
    mean_weight: float = 1.0  # how many times more the mean of a group's residuals weighs
    joints: tuple[tuple[str, str], ...] = ()  # channels of commanded joints, each with ``angle`` or ``length``
    points: Array | None = None  # what distinguishes them (P x k)
    of_point: Factor | None = None
    margin: Expression = None  # of one point, above zero where it is in view; None where the view is not limited

    @property
    def rows(self) -> int:
        return len(self.noise)

    @property
    def shared(self) -> int:
        return len(set(self.channels) & set(self.expressed.channels))

    @property
    def expressed(self) -> Factor:
        return self.of_point or self

    @property
    def position_channels(self) -> tuple[str, ...]:
        """Its first three readings where they are a position x, y, z; else none."""
        first = self.output_channels[:3]
        return first if [channel.rpartition(".")[2] for channel in first] == ["x", "y", "z"] else ()

    @property
    def _inputs(self) -> list[Expression]:
        return [self.values, self.record, self.state]

    @cached_property
    def pass_function(self) -> ca.Function:
        """(values, record, state) -> (next state, residual)."""
        return ca.Function("single_pass", self._inputs, [self.next_state, ca.densify(self.residual)], {"cse": True})

    @cached_property
    def linearise_function(self) -> ca.Function:
        """(values, record, state) -> (next state, residual, Jacobian transposed), in equilibrium to second order."""
        residual, jacobian = self.residual, ca.jacobian(self.residual, self.values)
        if self.state.numel():
            adjoint = ca.SX.sym("adjoint", self.residual.numel(), self.state.numel())
            solved = self.adjoint(ca.jacobian(self.residual, self.state))
            held = ca.jacobian(self.residual + ca.mtimes(adjoint, self.next_state), self.values)
            jacobian = ca.substitute(held, adjoint, solved)
            residual = self.residual + ca.mtimes(solved, self.next_state - self.state)
        outputs = [self.next_state, ca.densify(residual), ca.densify(jacobian.T)]
        return ca.Function("linearise", self._inputs, outputs, {"cse": True})

    @override
    def described(self, index: int, record: Array) -> str:
        return f"a record ({self.pose_of(record)})"

    def pose_of(self, record: Any) -> str:
        """The commanded joints of one record (n_c numbers), as people read them."""
        shown = []
        for channel, dimension in self.joints:
            if channel in self.channels:
                number = float(record[self.channels.index(channel)])
                size = f"{math.degrees(number):.1f} deg" if dimension == "angle" else f"{1000 * number:.1f} mm"
                shown.append(f"{channel.partition('.')[2]} {size}")
        return ", ".join(shown) or "no joint"

    def hessian_function(self) -> ca.Function:
        """(values, record, state, W) -> exact Hessian (n_v x n_v) of half of |W residual|^2, in equilibrium, W the
        whitening.

        The Lagrangian's second derivative along the equilibrium's tangent. [Griewank2008]
        """
        whitening = ca.SX.sym("whitening", self.residual.numel(), self.residual.numel())
        inputs = [*self._inputs, whitening]
        weighted = ca.mtimes(whitening, self.residual)
        cost = ca.dot(weighted, weighted) / 2
        if not self.state.numel():
            return ca.Function("hessian", inputs, [ca.densify(ca.hessian(cost, self.values)[0])])
        both = ca.vertcat(self.values, self.state)
        adjoint = ca.SX.sym("adjoint", 1, self.state.numel())
        lagrangian = ca.hessian(cost + ca.mtimes(adjoint, self.next_state), both)[0]
        lagrangian = ca.substitute(lagrangian, adjoint, self.adjoint(ca.jacobian(cost, self.state)))
        (slope,) = self.to_equilibrium(ca.jacobian(self.next_state, self.values))
        tangent = ca.vertcat(ca.SX.eye(self.values.numel()), slope)
        hessian = ca.mtimes(tangent.T, ca.mtimes(lagrangian, tangent))
        return ca.Function("hessian", inputs, [ca.densify(hessian)], {"cse": True})

    def channel_slope_function(self, channels: tuple[str, ...]) -> ca.Function:
        """(values, record, state) -> d residual / d record channels, transposed (n_c x n_r), in equilibrium."""
        places = [self.channels.index(channel) if channel in self.channels else None for channel in channels]
        slope = ca.jacobian(self.residual, self.record)
        chosen_ones = [self.record[place] for place in places if place is not None]
        if self.state.numel() and ca.depends_on(self.next_state, ca.vertcat(ca.SX(0, 1), *chosen_ones)):
            solved = self.adjoint(ca.jacobian(self.residual, self.state))
            slope = slope + ca.mtimes(solved, ca.jacobian(self.next_state, self.record))
        none = ca.SX.zeros(self.residual.numel(), 1)
        chosen = ca.horzcat(*[none if place is None else slope[:, place] for place in places])
        return ca.Function("channel_slope", self._inputs, [ca.densify(chosen).T], {"cse": True})


class _Records:
    """A symbol for each channel that an expression reads, in the order in which they are read first."""

    def __init__(self, available: frozenset[str]) -> None:
        self.available = available
        self.symbols: dict[str, Expression] = {}
        self.kept: set[str] = set()  # what pose residuals read

    def number(self, channel: str) -> Expression:
        return self.symbols.setdefault(channel, ca.SX.sym(channel))

    def optional(self, channel: str, default: float) -> Expression:
        return self.number(channel) if channel in self.available else ca.SX(default)

    def used_by(self, expression: Expression) -> dict[str, Expression]:
        return {n: own for n, own in self.symbols.items() if n in self.kept or ca.depends_on(expression, own)}


def build_factor(
    name: str,
    measurement: Measurement,
    arms: Mapping[str, Arm],
    parameters: Parameters,
    environment: Environment,
    available: frozenset[str],
    unrolled: bool = False,
) -> Factor:
    """The expressions of one measurement; ``available`` are the channels of the records, ``environment`` the rest.

    ``unrolled`` has those of all points of a measurement of many, as if it had no points."""
    # Each block's value is a number where it is fixed; nuisances are left out.
    symbols, values = _symbols("values", [block for block in parameters.free if not block.nuisance])
    values |= {b.name: ca.SX(list(b.nominal)) for b in parameters.blocks if not (b.free or b.nuisance)}
    groups = measurement if isinstance(measurement, GroupedMeasurement) else None
    group, of_group = _symbols("group", groups.group_parameters("") if groups else ())
    records, states, deflections = _arm_states(measurement, arms, values, environment, available)
    lent = {local: values[full] for local, full in borrowed_names(measurement).items()}
    local = LocalValues({**lent, **scoped(values, f"{name}."), **of_group})
    reading = _reading(name, measurement, records, states, local, unrolled)
    next_state = ca.densify(ca.vertcat(*[states[a].next_deflection for a in measurement.arms]))
    tools = ca.vertcat(*[ca.vec(states[a].base_T_tool.matrix()[:3, :]) for a in measurement.arms])
    starts = {n: ca.SX(entries) for n, entries in groups.group_starts(states, local).items()} if groups else {}
    nuisance_starts = ca.densify(ca.vertcat(ca.SX(0, 1), *starts.values()))
    margin = ca.SX(0, 1) if reading.margin is None else reading.margin
    used = records.used_by(ca.vertcat(reading.outputs, reading.residual, margin, next_state, tools, nuisance_starts))
    own = [(arm_name, arms[arm_name.removesuffix(OTHER)]) for arm_name in measurement.arms]
    factor = Factor(
        name=name,
        channels=tuple(used),
        output_channels=tuple(f"{name}.{channel}" for channel in reading.channels),
        values=ca.vertcat(symbols, group),
        record=ca.vertcat(*used.values()),
        state=ca.vertcat(*deflections),
        next_state=next_state,
        residual=reading.residual,
        outputs=reading.outputs,
        tools=tools,
        noise=tuple(measurement.noise()),
        noise_channels=tuple(tuple(f"{name}.{c.name}" for c in row) for row in noise_channels(measurement)),
        dimensions=residual_dimensions(measurement),
        margin=reading.margin,
        nuisance_starts=nuisance_starts,
        nuisance_names=tuple(n for n, entries in starts.items() for _ in range(entries.numel())),
        mean_weight=groups.mean_weight if groups else 1.0,
        springs=tuple(spring for _, arm in own for spring in arm.spring_names),
        joints=tuple((f"{a.name}.{j}{n.removeprefix(a.name)}", d) for n, a in own for j, d in a.commanded.items()),
    )
    return factor if reading.points is None else _of_points(factor, measurement, reading.points)


@dataclass(frozen=True)
class _Reading:
    channels: tuple[str, ...]
    outputs: Expression
    residual: Expression
    margin: Expression = None
    points: Array | None = None


def _reading(
    name: str,
    measurement: Measurement,
    records: _Records,
    states: Mapping[str, ArmState],
    local: Mapping[str, Expression],
    unrolled: bool,
) -> _Reading:
    if unrolled or not isinstance(measurement, PointMeasurement):
        shown = _checked_outputs(measurement, measurement.outputs(states, local))
        measured = {c.name: records.optional(f"{name}.{c.name}", 0.0) for c in measurement.channels()}
        residual = _checked_residual(name, measurement, measurement.residual(states, measured, local))
        return _Reading(tuple(shown), ca.vertcat(*shown.values()), residual)
    points = measurement.points
    point = ca.vertcat(*[records.number(f"{name}.{_POINT}{i}") for i in range(points.shape[1])])
    shown, own = measurement.point_outputs(states, local, point), [c.name for c in measurement.point_channels()]
    is_read = any(f"{name}.{channel.name}" in records.available for channel in measurement.channels())
    read = [records.number(f"{name}.{channel}") if is_read else ca.SX(0) for channel in own]
    margin = measurement.point_margin(states, local, point) if isinstance(measurement, LimitedView) else None
    return _Reading(tuple(own), shown, ca.vertcat(*read) - shown, margin, points)


def _of_points(factor: Factor, measurement: Measurement, points: Array) -> Factor:
    name, rows, own = factor.name, factor.residual.numel(), factor.output_channels
    numbers = {f"{name}.{_POINT}{i}": i for i in range(points.shape[1])}
    shared = tuple(channel for channel in factor.channels if channel not in own and channel not in numbers)
    used = tuple(channel for channel in factor.channels if channel in numbers)
    read = tuple(channel for channel in own if channel in factor.channels)
    order = [factor.channels.index(channel) for channel in (*shared, *read, *used)]
    of_point = replace(
        factor,
        channels=(*shared, *read, *used),
        record=ca.vertcat(*[factor.record[i] for i in order]),
        noise=factor.noise[:rows],
        dimensions=factor.dimensions[:rows],
    )
    every = tuple(f"{name}.{channel.name}" for channel in measurement.channels())
    return replace(
        factor,
        channels=(*shared, *every) if read else shared,
        output_channels=every,
        points=points[:, [numbers[channel] for channel in used]],
        of_point=of_point,
    )


def _symbols(name: str, blocks: Sequence[ParameterBlock]) -> tuple[Expression, dict[str, Expression]]:
    symbols, start, values = ca.SX.sym(name, sum(block.size for block in blocks)), 0, {}
    for block in blocks:
        values[block.name] = symbols[start : start + block.size]
        start += block.size
    return symbols, values


def _arm_states(
    measurement: Measurement,
    arms: Mapping[str, Arm],
    values: Mapping[str, Expression],
    environment: Environment,
    available: frozenset[str],
) -> tuple[_Records, dict[str, ArmState], list[Expression]]:
    """Each arm in a record under its load, ``@other`` ones in its partner; and symbols of their deflections."""
    records = _Records(available)
    acting = [records.optional(*pair) for pair in zip(LOAD_CHANNELS, environment.acting, strict=True)]
    load = tilted(Load.of(acting), scoped(values, f"{STATICS}."))
    states, deflections = {}, []
    for name in measurement.arms:
        arm = arms[name.removesuffix(OTHER)]
        which = name.removeprefix(arm.name)
        deflections.append(ca.SX.sym(f"deflection_{name}", arm.deflection_size))
        commands = [records.number(f"{arm.name}.{joint}{which}") for joint in arm.commanded]
        sides = [records.optional(f"{arm.name}.approach.{joint}{which}", 0.0) for joint in arm.commanded]
        angles, approach = ca.vertcat(*arm.joint_commands(commands)), ca.vertcat(*arm.joint_approaches(sides))
        conditions, correction = {c: records.number(c) for c in arm.conditions if c in available}, None
        if arm.residual is not None:
            names = correction_names(arm.joint_names)
            correction = ca.vertcat(*[records.number(f"{arm.name}.{own}{which}") for own in names])
            for surrounding in available.intersection(SURROUNDINGS):  # of which it may have learned later
                records.number(surrounding)
            records.kept |= {c for c in records.symbols if ".approach." in c or c in SURROUNDINGS}
        inputs = ArmInputs(angles, approach, load, deflections[-1], conditions, correction)
        states[name] = replace(arm, residual=None).state(values, inputs)  # records carry what it has learned
    return records, states, deflections


def _checked_outputs(measurement: Measurement, outputs: Any) -> dict[str, Expression]:
    channels = [channel.name for channel in measurement.channels()]
    expected = f"the expression of each channel by name: {', '.join(channels)}"
    with expecting(measurement.outputs, outputs, expected):
        if not set(outputs.keys()) <= set(channels):
            refuse(measurement.outputs, f"the channels {', '.join(outputs)}", expected)
        return {name: column(measurement.outputs, own, 1, f"one number as {name!r}") for name, own in outputs.items()}


def _checked_residual(name: str, measurement: Measurement, residual: Expression) -> Expression:
    """The residual of a measurement whose noise, dimensions and noise columns are those of its entries."""
    residual, noise = column(measurement.residual, residual, None, "a column of m or rad"), measurement.noise()
    expected = "a sequence of standard deviations above zero, one a residual entry"
    with expecting(measurement.noise, noise, expected):
        if not all(0 < sd < math.inf for sd in noise):
            refuse(measurement.noise, f"{noise}", expected)
    rows, dimensions, own = residual.numel(), residual_dimensions(measurement), noise_channels(measurement)
    counts = {"noise": len(noise), "dimensions": len(dimensions), "noise columns": len(own) or rows}
    odd = [f"{kind} of {count} entries" for kind, count in counts.items() if count != rows]
    odd += [f"dimension {kind!r}" for kind in dimensions if kind not in ERROR_UNITS]
    odd += [
        f"noise column {channel.name} of dimension {channel.dimension}"
        for channels, kind in zip(own, dimensions, strict=False)
        for channel in channels
        if channel.dimension != kind
    ]
    if odd:
        raise ProblemError(
            f"the measurement {name} has a residual of {rows} entries ({', '.join(dimensions)}), and {', '.join(odd)}.",
            hint="Correct noise(), dimensions() or noise_channels() in its plugin.",
        )
    return residual
