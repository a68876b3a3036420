"""What a plugin's parameter blocks and expressions must be, whatever the kind of component, and in which units."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import TypeVar

import casadi as ca
import numpy as np

from armcal.base.arrays import Array
from armcal.base.domains import Interval
from armcal.base.parameters import FIT_NAME, ParameterBlock, Parameters
from armcal.base.se3 import Expression
from armcal.base.units import UNITS, si_unit
from armcal.testing.results import ContractError, Recorder, expect

C = TypeVar("C")

JACOBIAN_TOLERANCE = 1e-6
_STEP = 1e-5
_LEAST_GAIN = 0.05
_LEAST_GAIN_M = 5e-3
_MOST_GAIN = 20.0
"""What a unit of a parameter moves, in the same unit: about one. A degree is 0.017 rad, a millimetre 0.001 m."""
_NOTHING = 1e-9
_LARGEST: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"m": (100.0, 1.0), "rad": (4 * math.pi, math.pi), "kpx": (20.0, 5.0)}
)
"""By unit: the largest nominal value, and the largest ordinary correction, that any arm could mean."""
_CHOICES = {
    getattr(ca, name): name.removeprefix("OP_").lower()
    for name in (
        *("OP_LT", "OP_LE", "OP_EQ", "OP_NE", "OP_NOT", "OP_AND", "OP_OR", "OP_IF_ELSE_ZERO"),
        *("OP_SIGN", "OP_FABS", "OP_FMIN", "OP_FMAX", "OP_FLOOR", "OP_CEIL", "OP_FMOD", "OP_COPYSIGN"),
        *("OP_REMAINDER", "OP_MMIN", "OP_MMAX"),
    )
}


def check_parameters(record: Recorder, declared: Callable[[], Sequence[ParameterBlock]]) -> tuple[ParameterBlock, ...]:
    """The blocks that a component declares."""
    with record.needed("its parameters are named, each once"):
        blocks = tuple(declared())
        for block in blocks:
            kind = type(block).__name__
            expect(isinstance(block, ParameterBlock), f"found {kind} among the parameters, expected ParameterBlock")
            expect(
                FIT_NAME.fullmatch(block.name) is not None,
                f"found the parameter {block.name!r}, expected a name without spaces, dots, quotes and * ? [ ] < > @",
            )
        names = [block.name for block in blocks]
        twice = sorted({name for name in names if names.count(name) > 1})
        expect(not twice, f"found {', '.join(twice)} more than once, expected every parameter once")
    with record.check("their units are SI"):
        for block in blocks:
            known = f"expected one of {', '.join(UNITS)}"
            expect(block.unit in UNITS, f"{block.name}: found the unit {block.unit!r}, {known}")
            text = si_unit(UNITS[block.unit].dimension).name
            expect(block.unit == text, f"{block.name}: found the unit {block.unit}, expected SI: {text}")
    with record.check("their values and scales are plausible in their units"):
        for _, block in scalars(blocks, *_LARGEST):
            _expect_plausible(block)
    with record.needed("their nominal values are finite and in their domains"):
        for block in blocks:
            values = np.array(block.nominal, dtype=float)
            sized = f"found {values.size} nominal numbers, expected {block.size}"
            expect(values.shape == (block.size,), f"{block.name}: {sized}")
            expect(bool(np.isfinite(values).all()), f"{block.name}: found the nominal value {block.nominal}")
            fault = block.domain.check(values)
            expect(not fault, f"{block.name}: {fault}")
    with record.needed("their scales are positive and move them"):
        for block in blocks:
            _expect_movable(block)
    return blocks


def _expect_plausible(block: ParameterBlock) -> None:
    """Raise ContractError if a length or an angle is of a size that only another unit explains."""
    largest, widest = _LARGEST[block.unit]
    worst = max((abs(number) for number in block.nominal), default=0.0)
    other = "mm" if block.unit == "m" else "deg"
    expect(
        worst <= largest and block.scale <= widest,
        f"{block.name}: found the nominal value {worst:g} and the scale {block.scale:g} {block.unit}, expected up "
        f"to {largest:.3g} and {widest:.3g}: is it in {other}?",
    )


def _expect_movable(block: ParameterBlock) -> None:
    expect(
        math.isfinite(block.scale) and block.scale > 0,
        f"{block.name}: found the scale {block.scale}, expected the size of an ordinary correction",
    )
    parameters, dof = Parameters((replace(block, free=True),)), block.domain.dof
    moves = np.linalg.matrix_rank(parameters.retract_jacobian(np.zeros(dof)))
    expect(moves == dof, f"{block.name}: only {moves} of {dof} increments move its nominal value; start elsewhere")
    delta = np.clip(0.5 * parameters.scales(), *parameters.increment_bounds())
    back = parameters.local(parameters.retract(delta))
    expect(
        bool(np.allclose(back, delta, rtol=1e-6, atol=1e-9 * block.scale)),
        f"{block.name}: an increment does not come back from its domain's retract and local",
    )


def near_nominal(blocks: Sequence[ParameterBlock], random: np.random.Generator) -> Array:
    parameters = Parameters(tuple(replace(block, free=True) for block in blocks))
    delta = random.uniform(-1, 1, len(parameters.scales())) * parameters.scales()
    return parameters.retract(np.clip(delta, *parameters.increment_bounds()))


def entry_names(blocks: Sequence[ParameterBlock]) -> tuple[str, ...]:
    return Parameters(tuple(blocks)).entry_names


def symbols(blocks: Sequence[ParameterBlock]) -> dict[str, Expression]:
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


def expect_repeated(picture: Callable[[C], Array], made: C, other: C) -> None:
    """Raise ContractError unless a component, asked twice, and a second one like it give the same numbers."""
    first, second, third = picture(made), picture(made), picture(other)
    expect(np.array_equal(first, second, equal_nan=True), "found other numbers when it was asked a second time")
    expect(
        np.array_equal(first, third, equal_nan=True),
        "found other numbers from a second component of equal settings: it keeps something between calls",
    )


def scalars(blocks: Sequence[ParameterBlock], *units: str) -> list[tuple[int, ParameterBlock]]:
    scalars, place = [], 0
    for block in blocks:
        if isinstance(block.domain, Interval) and block.unit in units:
            scalars.append((place, block))
        place += block.size
    return scalars


def expect_gain(gain: float, what: str, of: str, unit: str) -> None:
    """Raise ContractError if something moves by far more or less than about one for each unit of something else.

    Args:
        gain: how far it moves at most; none at all is no fault here.
        what: moves.
        of: by which.
        unit: of both.
    """
    least = _LEAST_GAIN_M if unit == "m" else _LEAST_GAIN
    expect(
        gain <= _NOTHING or least <= gain <= _MOST_GAIN,
        f"found that {what} changes by {gain:.4g} {unit} for each {unit} of {of}, expected about 1: "
        "is one of them in another unit?",
    )
