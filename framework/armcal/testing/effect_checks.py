"""Checks on joint effects: parameters, displacements, springs."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from armcal.arm.assembly import Arm
from armcal.arm.effects import MOUNT, JointCommand, JointEffect, Spring, check_springs, reshapes
from armcal.arm.model import Attachment, Chain, Joint
from armcal.base import se3
from armcal.base.arrays import Array
from armcal.base.parameters import ParameterBlock
from armcal.base.se3 import Expression
from armcal.measure.reader import surroundings
from armcal.testing.expressions import (
    check_parameters,
    entry_names,
    expect_all_used,
    expect_derivatives,
    expect_gain,
    expect_no_choice,
    expect_only,
    expect_repeated,
    near_nominal,
    scalars,
    stacked,
    symbols,
)
from armcal.testing.planar import ARM, planar_arms
from armcal.testing.results import ContractError, Recorder, expect
from armcal.testing.settings_checks import Subject

JOINTS = ("q1", "q2", "q3")
_STATES = ([0.0, 0.0], [0.4, 1.0], [-1.2, -1.0])
"""Command and approach of a joint."""


def check_effect(record: Recorder, subject: Subject) -> None:
    """Everything that an arm asks of a joint effect, on joints q1, q2 and q3."""
    with record.needed(f"it builds for the joints {', '.join(JOINTS)}"):
        effect: JointEffect = subject.build(JOINTS)
    with record.needed("it derives from armcal.JointEffect"):
        bases = ", ".join(base.__name__ for base in type(effect).__bases__)
        expect(isinstance(effect, JointEffect), f"found that it derives from {bases}, expected JointEffect")
    blocks = check_parameters(record, effect.parameters)
    values = symbols(blocks)
    with record.group():
        _check_displacements(record, effect, blocks, values)
    with record.check("it is the same each time"):
        expect_repeated(lambda made: _picture(made, blocks), effect, subject.build(JOINTS))
    with record.check("every parameter has an influence"):
        loads, recorded = ca.SX.sym("loads", 3 * len(JOINTS) + 3), ca.SX.sym("recorded", 2 * len(JOINTS))
        laws = [spring.law(loads[: spring.size], _command(spring, recorded)) for spring in effect.springs(values)]
        shape = _shape(effect, _condition_symbols(effect), values)
        expect_all_used(stacked([_displacement(effect, values)[1], *laws, shape]), values)
    if reshapes(effect) or effect.conditions:
        _check_columns(record, effect, values)
    with record.needed("its springs have a site and unit directions"):
        springs = check_springs(effect.springs, effect.springs(values), len(JOINTS))
    if springs:
        _check_laws(record, springs, blocks, stacked(list(values.values())))


def _check_displacements(
    record: Recorder, effect: JointEffect, blocks: Sequence[ParameterBlock], values: Mapping[str, Expression]
) -> None:
    given = stacked(list(values.values()))
    with record.needed("it gives a displacement for every joint"):
        recorded, moved = _displacement(effect, values)
    with record.check("displacements depend on what is given"):
        expect_only(moved, [recorded, given])
    with record.check("displacements do not branch on a parameter"):
        expect_no_choice(moved, recorded, given)
    with record.check("displacements are finite"):
        function, random = ca.Function("displacement", [given, recorded], [moved]), np.random.default_rng(1)
        for approach in (-1.0, 0.0, 1.0):
            for command in (0.0, 0.3, -1.2):
                shown = np.asarray(function(near_nominal(blocks, random), [command, approach] * len(JOINTS)))
                state = f"for the command {command} from approach {approach:+.0f}"
                expect(bool(np.isfinite(shown).all()), f"found {shown.ravel()} {state}")
    with record.check("lengths and angles move a joint by as much"):  # at commands and approaches of either sign
        slope = ca.Function("slope", [given, recorded], [ca.densify(ca.jacobian(moved, given))])
        entries = near_nominal(blocks, np.random.default_rng(3))
        points = [[command, side] * len(JOINTS) for command in (0.4, -1.2, 2.0) for side in (-1.0, 1.0)]
        gains = np.abs([np.asarray(slope(entries, at)) for at in points]).max(axis=(0, 1), initial=0.0)
        for place, block in scalars(blocks, "m", "rad"):
            expect_gain(float(gains[place]), "a joint's displacement", block.name, block.unit)


def _check_columns(record: Recorder, effect: JointEffect, values: Mapping[str, Expression]) -> None:
    with record.check("the columns it reads are declared, each with its dimension"):
        try:
            surroundings({ARM: _arm_of(effect)})
        except ValueError as fault:
            raise ContractError(str(fault)) from fault
    with record.check("its shape changes with every column it declares"):
        given = _condition_symbols(effect)
        expect_all_used(_shape(effect, given, values), given)
        try:
            _shape(effect, {}, values)  # known without them, or the missing name is a KeyError
        except KeyError as fault:
            expect(fault.args[0] in given, f"found that it reads {fault.args[0]!r}, expected it among its conditions")


def _check_laws(
    record: Recorder, springs: Sequence[Spring], blocks: Sequence[ParameterBlock], given: Expression
) -> None:
    loads = ca.SX.sym("loads", sum(spring.size for spring in springs))
    recorded = ca.SX.sym("recorded", 2 * len(JOINTS))
    with record.needed("every law gives one deflection a coordinate"):
        parts, start = [], 0
        for spring in springs:
            part = ca.SX(spring.law(loads[start : start + spring.size], _command(spring, recorded)))
            start += spring.size
            result = f"the spring at site {spring.site} gives {part.shape}"
            expect(part.shape == (spring.size, 1), f"{result}, expected {spring.size} x 1")
            parts.append(part)
        laws = stacked(parts)
    with record.check("laws depend on what is given"):
        expect_only(laws, [loads, recorded, given])
    with record.check("laws branch neither on a parameter nor on a load"):
        expect_no_choice(laws, recorded, stacked([loads, given]))
    expressions = stacked([ca.substitute(laws, recorded, ca.SX(state * len(JOINTS))) for state in _STATES])
    with record.check("laws are finite and smooth, at zero load too"):
        function, random = ca.Function("laws", [stacked([loads, given])], [expressions]), np.random.default_rng(2)
        entries = near_nominal(blocks, random)
        names = (*(f"load {i}" for i in range(1, loads.numel() + 1)), *entry_names(blocks))
        for load in (np.zeros(loads.numel()), random.uniform(-2, 2, loads.numel())):
            at = np.concatenate([load, entries])
            shown = np.asarray(function(at)).ravel()
            expect(bool(np.isfinite(shown).all()), f"found the deflections {shown} under the loads {load}")
            expect_derivatives(function, at, "the deflections", names)
    with record.check("deflections are in rad, of loads in N m"):
        _expect_law_gains(blocks, given, loads, expressions)


def _displacement(effect: JointEffect, values: Mapping[str, Expression]) -> tuple[Expression, Expression]:
    recorded = ca.SX.sym("recorded", 2 * len(JOINTS))
    parts = []
    for i, joint in enumerate(JOINTS):
        part = ca.SX(effect.displacement(JointCommand(i, recorded[2 * i], recorded[2 * i + 1]), values))
        expect(part.numel() == 1, f"found {part.numel()} numbers for {joint}, expected one (rad or m)")
        parts.append(part)
    return recorded, stacked(parts)


def _shape(effect: JointEffect, conditions: Mapping[str, Expression], values: Mapping[str, Expression]) -> Expression:
    links = [se3.translation_along("x", ca.SX.sym(f"l{i}")) for i in range(len(JOINTS) + 1)]
    joints = tuple(Joint(name, link) for name, link in zip(JOINTS, links, strict=False))
    shaped = effect.shaped(Chain(se3.identity(), joints, Attachment(len(JOINTS), links[-1])), conditions, values)
    moved = [ca.SX(joint.offset) for joint in shaped.joints]
    return stacked([shaped.tool.joint_T_frame.matrix(), *(j.parent_T_joint.matrix() for j in shaped.joints), *moved])


def _arm_of(effect: JointEffect) -> Arm:
    return replace(planar_arms((ARM,))[ARM], effects={"effect": effect})


def _condition_symbols(effect: JointEffect) -> dict[str, Expression]:
    return {name: ca.SX.sym(name) for name in _arm_of(effect).conditions}


def _picture(effect: JointEffect, blocks: tuple[ParameterBlock, ...]) -> Array:
    expect(tuple(effect.parameters()) == blocks, "found other parameters another time")
    values = symbols(blocks)
    entries = near_nominal(blocks, np.random.default_rng(4))
    recorded, moved = _displacement(effect, values)
    springs = effect.springs(values)
    laws = [spring.law(ca.SX(np.linspace(0.3, 1.1, spring.size)), _command(spring, recorded)) for spring in springs]
    function = ca.Function("all", [stacked(list(values.values())), recorded], [stacked([moved, *laws])])
    return np.asarray(function(entries, [0.4, 1.0] * len(JOINTS)))


def _expect_law_gains(blocks: Sequence[ParameterBlock], given: Expression, loads: Expression, laws: Expression) -> None:
    """What a parameter in rad adds to a deflection; one in rad/(N m), for each N m."""
    slope = ca.Function("slope", [given, loads], [ca.densify(ca.jacobian(laws, given))])
    random = np.random.default_rng(3)
    entries, gains = near_nominal(blocks, random), []
    for _ in range(3):
        load = random.uniform(0.5, 2, loads.numel()) * random.choice([-1, 1], loads.numel())
        gains.append(np.abs(np.asarray(slope(entries, load))) / np.array([[1.0], [np.abs(load).max()]])[:, :, None])
    per = np.array(gains).max(axis=(0, 2), initial=0.0)
    for row, unit in enumerate(("rad", "rad_per_Nm")):
        for place, block in scalars(blocks, unit):
            expect_gain(float(per[row, place]), "a deflection", block.name, "rad")


def _command(spring: Spring, recorded: Expression) -> JointCommand:
    """What the joint of a spring was commanded, of the commands and approaches of all (6x1)."""
    at = 2 * (spring.site - 1)
    return JointCommand(spring.site - 1, recorded[at], recorded[at + 1]) if spring.site else MOUNT
