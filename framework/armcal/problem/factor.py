"""One factor type as expressions: what one record says, as a function of values, record and elastic state.

The elastic equilibrium ``state = pass(state)`` is never unrolled. At a state d near it, with pass F and
residual r, everything follows from one pass and a small solve:

    A = dr/dd (I - dF/dd)^-1,    r* = r + A (F - d),    dr*/dv = d(r + A F)/dv  with A held,

the implicit function theorem in adjoint form [Griewank2008]: its cost hardly grows with the number of
parameters, and r* is the residual in equilibrium up to the square of what is left of the state's error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca

from armcal.arm.assembly import Arm, ArmInputs, ArmState, scoped
from armcal.arm.environment import STATICS, Environment, Vector3, tilted
from armcal.arm.statics import Load
from armcal.base import se3
from armcal.base.parameters import Parameters
from armcal.base.se3 import Expression
from armcal.errors import ProblemError
from armcal.measure.measurement import GroupedMeasurement, Measurement, noise_channels, residual_dimensions
from armcal.measure.partners import OTHER


@dataclass(frozen=True)
class Factor:
    """The expressions of one measurement.

    Attributes:
        name: the measurement's instance name.
        channels: the record channels it reads, in the order of ``record``.
        values: free canonical entries (symbols, n_v); fixed ones are numbers in the expressions.
        record: symbols, one a channel.
        state: deflections of all arms that take part (symbols, n_d).
        next_state: one elastic pass from ``state``.
        residual: m or rad (n_r).
        outputs: what the instrument would read (n_o), named by ``output_channels``.
        tools: each arm's base_T_tool without its last row, column by column (12 an arm; m).
        noise: standard deviation of each residual entry.
        noise_channels: of each residual entry, the channels that may carry a record's own one, the nearest first.
        dimensions: ``length`` or ``angle`` of each residual entry.
        told: what the record alone says of these, to start from; empty where it says nothing.
        nuisance_names: local names of the group's parameters that ``told`` holds the entries of, one an entry.
        mean_weight: how many times more the mean of a group's residuals weighs.
        springs: of each number of the state, what gives, in words.
        joints: channels of commanded joints, each with ``angle`` or ``length``.
    """

    name: str
    channels: tuple[str, ...]
    output_channels: tuple[str, ...]
    values: Expression
    record: Expression
    state: Expression
    next_state: Expression
    residual: Expression
    outputs: Expression
    tools: Expression
    noise: tuple[float, ...]
    noise_channels: tuple[tuple[str, ...], ...] = ()
    dimensions: tuple[str, ...] = ()
    told: Expression = None
    nuisance_names: tuple[str, ...] = ()
    mean_weight: float = 1.0
    springs: tuple[str, ...] = ()
    joints: tuple[tuple[str, str], ...] = ()

    @property
    def _inputs(self) -> list[Expression]:
        return [self.values, self.record, self.state]

    def pass_function(self) -> ca.Function:
        """(values, record, state) -> (next state, residual)."""
        return ca.Function("single_pass", self._inputs, [self.next_state, ca.densify(self.residual)], {"cse": True})

    def output_function(self) -> ca.Function:
        """(values, record, state) -> (next state, outputs and tools)."""
        shown = ca.densify(ca.vertcat(self.outputs, self.tools))
        return ca.Function("outputs", self._inputs, [self.next_state, shown], {"cse": True})

    def nuisance_function(self) -> ca.Function:
        """(values, record, state) -> (next state, what the record says of its group's parameters)."""
        return ca.Function("told", self._inputs, [self.next_state, ca.densify(self.told)], {"cse": True})

    def linearise_function(self) -> ca.Function:
        """(values, record, state) -> (next state, residual, Jacobian transposed), in equilibrium to second order."""
        residual, jacobian = self.residual, ca.jacobian(self.residual, self.values)
        if self.state.numel():
            adjoint = ca.SX.sym("adjoint", self.residual.numel(), self.state.numel())
            solved = self._solve_left(ca.jacobian(self.residual, self.state))
            held = ca.jacobian(self.residual + ca.mtimes(adjoint, self.next_state), self.values)
            jacobian = ca.substitute(held, adjoint, solved)
            residual = self.residual + ca.mtimes(solved, self.next_state - self.state)
        outputs = [self.next_state, ca.densify(residual), ca.densify(jacobian.T)]
        return ca.Function("linearise", self._inputs, outputs, {"cse": True})

    def slope_function(self) -> ca.Function:
        """(values, record, state) -> (next state, its slope by the state)."""
        slope = ca.densify(ca.jacobian(self.next_state, self.state))
        return ca.Function("slope", self._inputs, [self.next_state, slope], {"cse": True})

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
        """(values, record, state, W) -> exact Hessian (n_v x n_v) of half of |W residual|^2, in equilibrium.

        W (n_r x n_r) is the whitening.
        The second derivative of the Lagrangian along the equilibrium's tangent. [Griewank2008]
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
        lagrangian = ca.substitute(lagrangian, adjoint, self._solve_left(ca.jacobian(cost, self.state)))
        slope = se3.solve_near_identity(self._one_minus_slope(), ca.densify(ca.jacobian(self.next_state, self.values)))
        tangent = ca.vertcat(ca.SX.eye(self.values.numel()), slope)
        hessian = ca.mtimes(tangent.T, ca.mtimes(lagrangian, tangent))
        return ca.Function("hessian", inputs, [ca.densify(hessian)], {"cse": True})

    def channel_slope_function(self, channels: tuple[str, ...]) -> ca.Function:
        """(values, record, state) -> d residual / d record channels, transposed (n_c x n_r), in equilibrium."""
        places = [self.channels.index(channel) if channel in self.channels else None for channel in channels]
        slope = ca.jacobian(self.residual, self.record)
        chosen_ones = [self.record[place] for place in places if place is not None]
        if self.state.numel() and ca.depends_on(self.next_state, ca.vertcat(ca.SX(0, 1), *chosen_ones)):
            solved = self._solve_left(ca.jacobian(self.residual, self.state))
            slope = slope + ca.mtimes(solved, ca.jacobian(self.next_state, self.record))
        none = ca.SX.zeros(self.residual.numel(), 1)
        chosen = ca.horzcat(*[none if place is None else slope[:, place] for place in places])
        return ca.Function("channel_slope", self._inputs, [ca.densify(chosen).T], {"cse": True})

    def _one_minus_slope(self) -> Expression:
        return ca.SX.eye(self.state.numel()) - ca.densify(ca.jacobian(self.next_state, self.state))

    def _solve_left(self, rows: Expression) -> Expression:
        """rows (I - dF/dd)^-1."""
        return se3.solve_near_identity(self._one_minus_slope().T, ca.densify(rows).T).T


class _Records:
    """Hands out a symbol for each channel that is asked for, and remembers their order."""

    def __init__(self, available: frozenset[str]) -> None:
        self._available = available
        self.symbols: dict[str, Expression] = {}

    def number(self, channel: str) -> Expression:
        return self.symbols.setdefault(channel, ca.SX.sym(channel))

    def has(self, channel: str) -> bool:
        """Whether the records carry a channel."""
        return channel in self._available

    def optional(self, channel: str, default: float) -> Expression:
        return self.number(channel) if channel in self._available else ca.SX(default)

    def used_by(self, expression: Expression) -> dict[str, Expression]:
        """The symbols that an expression depends on."""
        return {name: symbol for name, symbol in self.symbols.items() if ca.depends_on(expression, symbol)}

    def vector(self, channel: str, defaults: Vector3) -> Expression:
        """Three channels ``channel_x`` to ``channel_z``."""
        parts = [self.optional(f"{channel}_{axis}", d) for axis, d in zip("xyz", defaults, strict=True)]
        return ca.sparsify(ca.vertcat(*parts))


def build_factor(
    name: str,
    measurement: Measurement,
    arms: Mapping[str, Arm],
    parameters: Parameters,
    environment: Environment,
    available: frozenset[str],
) -> Factor:
    """The expressions of one measurement; ``available`` are the channels of the records, ``environment`` the rest."""
    symbols, values = _value_expressions(parameters)
    group, of_group = _group_expressions(measurement)
    records = _Records(available)
    load = tilted(_load(records, environment), scoped(values, f"{STATICS}."))
    states, deflections = {}, []
    for arm_name in measurement.arms:
        arm = arms[arm_name.removesuffix(OTHER)]
        deflections.append(ca.SX.sym(f"deflection_{arm_name}", arm.deflection_size))
        which = arm_name.removeprefix(arm.name)
        states[arm_name] = _arm_state(arm, which, values, records, load, deflections[-1])
    local = {**scoped(values, f"{name}."), **of_group}
    predicted = measurement.outputs(states, local)
    measured = {c.name: records.optional(f"{name}.{c.name}", 0.0) for c in measurement.channels()}
    residual = measurement.residual(states, measured, local)
    next_state = ca.densify(ca.vertcat(*[states[a].next_deflection for a in measurement.arms]))
    outputs = ca.vertcat(*predicted.values())
    tools = ca.vertcat(*[ca.vec(states[a].base_T_tool.matrix()[:3, :]) for a in measurement.arms])
    told, nuisance_names = _told(measurement, states, local)
    _check_rows(name, measurement, residual)
    used = records.used_by(ca.vertcat(residual, next_state, outputs, tools, told))
    return Factor(
        name=name,
        channels=tuple(used),
        output_channels=tuple(f"{name}.{channel}" for channel in predicted),
        values=ca.vertcat(symbols, group),
        record=ca.vertcat(*used.values()),
        state=ca.vertcat(*deflections),
        next_state=next_state,
        residual=residual,
        outputs=outputs,
        tools=tools,
        told=told,
        nuisance_names=nuisance_names,
        **_of_arms(measurement, arms),
        **_of_residual(name, measurement),
    )


def _check_rows(name: str, measurement: Measurement, residual: Expression) -> None:
    """Refuse a measurement whose noise, dimensions or noise columns are not those of its residual's entries.

    Raises:
        ProblemError: with what differs.
    """
    rows, dimensions, own = residual.numel(), residual_dimensions(measurement), noise_channels(measurement)
    found = {"noise": len(measurement.noise()), "dimensions": len(dimensions), "noise columns": len(own) or rows}
    odd = [f"{kind} of {count} entries" for kind, count in found.items() if count != rows]
    odd += [f"dimension {kind!r}" for kind in dimensions if kind not in ("length", "angle")]
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


def _of_arms(measurement: Measurement, arms: Mapping[str, Arm]) -> dict[str, Any]:
    """What a state's numbers and commanded joints are called."""
    own = [(name, arms[name.removesuffix(OTHER)]) for name in measurement.arms]
    joints = [(a.name + "." + j + n.removeprefix(a.name), dim) for n, a in own for j, dim in a.commanded.items()]
    return {"springs": tuple(spring for _, arm in own for spring in arm.spring_names), "joints": tuple(joints)}


def _of_residual(name: str, measurement: Measurement) -> dict[str, Any]:
    """What a measurement says of its residual's entries."""
    return {
        "noise": tuple(measurement.noise()),
        "noise_channels": tuple(tuple(f"{name}.{c.name}" for c in own) for own in noise_channels(measurement)),
        "dimensions": residual_dimensions(measurement),
        "mean_weight": measurement.mean_weight if isinstance(measurement, GroupedMeasurement) else 1.0,
    }


def _told(
    measurement: Measurement, states: Mapping[str, ArmState], local: Mapping[str, Expression]
) -> tuple[Expression, tuple[str, ...]]:
    """What a record says of its group's parameters, and whose entries these are."""
    if not isinstance(measurement, GroupedMeasurement):
        return ca.SX(0, 1), ()
    expressions = {name: ca.SX(entries) for name, entries in measurement.told(states, local).items()}
    if not expressions:
        return ca.SX(0, 1), ()
    return ca.densify(ca.vertcat(*expressions.values())), tuple(
        n for n, e in expressions.items() for _ in range(e.numel())
    )


def _load(records: _Records, environment: Environment) -> Load:
    return Load(
        gravity=records.vector("gravity", environment.gravity),
        payload_mass=records.optional("payload", environment.payload_mass),
        payload_com=records.vector("payload", environment.payload_com),
        force=records.vector("force", environment.force),
        torque=records.vector("torque", environment.torque),
    )


def _value_expressions(parameters: Parameters) -> tuple[Expression, dict[str, Expression]]:
    """Symbols for the free canonical entries, and every block's value with fixed ones as numbers; groups aside."""
    main = [block for block in parameters.blocks if not block.nuisance]
    symbols = ca.SX.sym("values", sum(block.size for block in main if block.free))
    values, start = {}, 0
    for block in main:
        if block.free:
            values[block.name] = symbols[start : start + block.size]
            start += block.size
        else:
            values[block.name] = ca.SX(list(block.nominal))
    return symbols, values


def _group_expressions(measurement: Measurement) -> tuple[Expression, dict[str, Expression]]:
    """Symbols for the entries of a group's parameters, whether free or not, and the parameters by local name."""
    if not isinstance(measurement, GroupedMeasurement):
        return ca.SX(0, 1), {}
    blocks = [(block.name, block.size) for block in measurement.group_parameters("")]
    symbols, start, values = ca.SX.sym("group", sum(size for _, size in blocks)), 0, {}
    for name, size in blocks:
        values[name] = symbols[start : start + size]
        start += size
    return symbols, values


def _arm_state(
    arm: Arm, which: str, values: Mapping[str, Expression], records: _Records, load: Load, deflection: Expression
) -> ArmState:
    """An arm in a record, or where ``which`` is ``@other`` in the record's partner."""
    commands = [records.number(f"{arm.name}.{joint}{which}") for joint in arm.commanded]
    approaches = [records.optional(f"{arm.name}.approach.{joint}{which}", 0.0) for joint in arm.commanded]
    angles = ca.vertcat(*arm.joint_commands(commands))
    approach = ca.vertcat(*arm.joint_approaches(approaches))
    conditions = {name: records.number(name) for name in arm.conditions if records.has(name)}
    return arm.state(values, ArmInputs(angles, approach, load, deflection, conditions))
