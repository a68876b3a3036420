"""What a plugin's parameter blocks and expressions must be, whatever the kind of component."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from armcal.base.domains import Array
from armcal.base.parameters import FIT_NAME, ParameterBlock, Parameters
from armcal.base.se3 import Expression
from armcal.base.units import UNITS, si_unit
from armcal.testing.results import ContractError, Recorder, expect
from armcal.testing.unit_checks import expect_plausible

JACOBIAN_TOLERANCE = 1e-6
_STEP = 1e-5
_CHOICES = {
    getattr(ca, name): name.removeprefix("OP_").lower()
    for name in (
        *("OP_LT", "OP_LE", "OP_EQ", "OP_NE", "OP_NOT", "OP_AND", "OP_OR", "OP_IF_ELSE_ZERO"),
        *("OP_SIGN", "OP_FABS", "OP_FMIN", "OP_FMAX", "OP_FLOOR", "OP_CEIL", "OP_FMOD", "OP_COPYSIGN"),
        *("OP_REMAINDER", "OP_MMIN", "OP_MMAX"),
    )
}


def check_parameters(
    record: Recorder, declared: Callable[[], Sequence[ParameterBlock]]
) -> tuple[ParameterBlock, ...] | None:
    """The blocks that a component declares, if they can be worked with."""
    blocks = record.check("its parameters are named, each once", _named, declared)
    if blocks is None:
        return None
    well_valued = record.check("their nominal values are finite and in their domains", _valued, blocks)
    well_sized = record.check("their scales are positive and move them", _movable, blocks)
    record.check("their units are SI", _in_si, blocks)
    record.check("their values and scales are plausible in their units", expect_plausible, blocks)
    return None if well_valued is None or well_sized is None else blocks


def _named(declared: Callable[[], Sequence[ParameterBlock]]) -> tuple[ParameterBlock, ...]:
    blocks = tuple(declared())
    for block in blocks:
        expect(
            isinstance(block, ParameterBlock),
            f"found {type(block).__name__} among the parameters, expected ParameterBlock",
        )
        expect(
            FIT_NAME.fullmatch(block.name) is not None,
            f"found the parameter {block.name!r}, expected a name without spaces, dots, quotes and * ? [ ] < > @",
        )
    names = [block.name for block in blocks]
    twice = sorted({name for name in names if names.count(name) > 1})
    expect(not twice, f"found {', '.join(twice)} more than once, expected every parameter once")
    return blocks


def _valued(blocks: tuple[ParameterBlock, ...]) -> bool:
    for block in blocks:
        values = np.array(block.nominal, dtype=float)
        expect(
            values.shape == (block.size,),
            f"{block.name}: found {values.size} nominal numbers, expected {block.size}",
        )
        expect(bool(np.isfinite(values).all()), f"{block.name}: found the nominal value {block.nominal}")
        fault = block.domain.check(values)
        expect(not fault, f"{block.name}: {fault}")
    return True


def _movable(blocks: tuple[ParameterBlock, ...]) -> bool:
    for block in blocks:
        expect(
            math.isfinite(block.scale) and block.scale > 0,
            f"{block.name}: found the scale {block.scale}, expected the size of an ordinary correction",
        )
        parameters = Parameters((replace(block, free=True),))
        moves = np.linalg.matrix_rank(parameters.retract_jacobian(np.zeros(block.domain.dof)))
        expect(
            moves == block.domain.dof,
            f"{block.name}: only {moves} of {block.domain.dof} increments move its nominal value; start elsewhere",
        )
        delta = _within(parameters, 0.5 * parameters.scales())
        back = parameters.local(parameters.retract(delta))
        expect(
            bool(np.allclose(back, delta, rtol=1e-6, atol=1e-9 * block.scale)),
            f"{block.name}: an increment does not come back from its domain's retract and local",
        )
    return True


def _in_si(blocks: tuple[ParameterBlock, ...]) -> None:
    for block in blocks:
        expect(
            block.unit in UNITS,
            f"{block.name}: found the unit {block.unit!r}, expected one of {', '.join(UNITS)}",
        )
        text = si_unit(UNITS[block.unit].dimension).name
        expect(block.unit == text, f"{block.name}: found the unit {block.unit}, expected SI: {text}")


def _within(parameters: Parameters, delta: Array) -> Array:
    lower, upper = parameters.increment_bounds()
    return np.clip(delta, lower, upper)


def near_nominal(blocks: Sequence[ParameterBlock], random: np.random.Generator) -> Array:
    """Canonical entries an ordinary correction away from the nominal ones, in their domains."""
    parameters = Parameters(tuple(replace(block, free=True) for block in blocks))
    delta = random.uniform(-1, 1, len(parameters.scales())) * parameters.scales()
    return parameters.retract(_within(parameters, delta))


def entry_names(blocks: Sequence[ParameterBlock]) -> tuple[str, ...]:
    """The names of all canonical entries."""
    return Parameters(tuple(blocks)).entry_names


def symbols(blocks: Sequence[ParameterBlock]) -> dict[str, Expression]:
    """A symbol for every block, as a component is given its values."""
    return {block.name: ca.SX.sym(block.name, block.size) for block in blocks}


def stacked(parts: Sequence[Expression]) -> Expression:
    """Expressions of any shape as one dense column."""
    return ca.densify(ca.vertcat(ca.SX(0, 1), *[ca.vec(ca.SX(part)) for part in parts]))


def expect_only(expression: Expression, given: Sequence[Expression]) -> None:
    """Raise ContractError if an expression has symbols that it was not given."""
    known = {symbol.element_hash() for input_ in given for symbol in ca.symvar(input_)}
    foreign = sorted({str(s) for s in ca.symvar(ca.SX(expression)) if s.element_hash() not in known})
    expect(not foreign, f"found the symbols {', '.join(foreign)}, expected only those that were given")


def expect_no_choice(expression: Expression, recorded: Expression, estimated: Expression) -> None:
    """Raise ContractError if an expression chooses by anything but what was recorded."""
    function = ca.Function("choices", [stacked([recorded]), stacked([estimated])], [ca.densify(expression)])
    tainted: set[int] = set()
    for k in range(function.n_instructions()):
        operation, inputs = function.instruction_id(k), function.instruction_input(k)
        if operation == ca.OP_OUTPUT:
            continue
        if operation == ca.OP_INPUT:
            depends = inputs[0] == 1
        else:
            depends = any(i in tainted for i in inputs)
            conditions = inputs[:1] if operation == ca.OP_IF_ELSE_ZERO else inputs
            if operation in _CHOICES and any(i in tainted for i in conditions):
                raise ContractError(
                    f"found {_CHOICES[operation]} of a parameter or a result, expected a smooth expression "
                    "(it may branch on commands and approaches only)"
                )
        for place in function.instruction_output(k):
            (tainted.add if depends else tainted.discard)(place)


def expect_derivatives(function: ca.Function, at: Array, what: str, inputs: Sequence[str]) -> None:
    """Raise ContractError unless CasADi's Jacobian of a function of one vector is what differences say."""
    exact = np.asarray(function.jacobian()(at, function(at)), dtype=float)
    expect(bool(np.isfinite(exact).all()), f"the derivative of {what} is not finite")
    for column, name in enumerate(inputs):
        step = np.zeros(len(at))
        step[column] = _STEP * max(1.0, abs(float(at[column])))
        rise = np.asarray(function(at + step)).ravel() - np.asarray(function(at - step)).ravel()
        slope = rise / (2 * step[column])
        allowed = JACOBIAN_TOLERANCE * max(1.0, float(np.abs(slope).max(initial=0.0)))
        worst = float(np.abs(exact[:, column] - slope).max(initial=0.0))
        expect(
            worst <= allowed,
            f"the derivative of {what} by {name} is off by {worst:.1e}, expected {allowed:.1e}",
        )


def expect_all_used(expression: Expression, values: Mapping[str, Expression]) -> None:
    """Raise ContractError if a parameter has no influence on any of what is given."""
    idle = [name for name, symbol in values.items() if not ca.depends_on(ca.SX(expression), symbol)]
    expect(
        not idle,
        f"found that {', '.join(idle)} changes nothing, expected every parameter to have an influence: "
        "is a nominal value used in its place?",
    )


def expect_repeated(picture: Callable[[], Array], again: Callable[[], Array]) -> None:
    """Raise ContractError unless a component, asked again, and a second one like it give the same numbers."""
    first, second, other = picture(), picture(), again()
    expect(np.array_equal(first, second, equal_nan=True), "found other numbers when it was asked a second time")
    expect(
        np.array_equal(first, other, equal_nan=True),
        "found other numbers from a second component of equal settings: it keeps something between calls",
    )
