"""Checks on joint effects: parameters, displacements, springs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from armcal.arm.assembly import Arm
from armcal.arm.effects import MOUNT, JointCommand, JointEffect, Spring, reshapes
from armcal.arm.model import Attachment, Chain, Joint
from armcal.base import se3
from armcal.base.domains import Array
from armcal.base.parameters import ParameterBlock
from armcal.base.se3 import Expression
from armcal.measure.reader import surroundings
from armcal.testing.expressions import (
    check_parameters,
    entry_names,
    expect_all_used,
    expect_derivatives,
    expect_no_choice,
    expect_only,
    expect_repeated,
    near_nominal,
    stacked,
    symbols,
)
from armcal.testing.planar import ARM, planar_arms
from armcal.testing.results import ContractError, Recorder, expect
from armcal.testing.settings_checks import Subject
from armcal.testing.unit_checks import expect_gain, scalars

JOINTS = ("q1", "q2", "q3")
_STATES = ([0.0, 0.0], [0.4, 1.0], [-1.2, -1.0])
"""Command and approach of a joint."""


def check_effect(record: Recorder, subject: Subject) -> None:
    """Everything that an arm asks of a joint effect, on joints q1, q2 and q3."""
    effect: JointEffect | None = record.check(f"it builds for the joints {', '.join(JOINTS)}", subject.build, JOINTS)
    derived = None if effect is None else record.check("it derives from armcal.JointEffect", _derived, effect)
    blocks = check_parameters(record, effect.parameters) if effect is not None and derived else None
    if effect is None or blocks is None:
        return
    values = symbols(blocks)
    given = stacked(list(values.values()))
    added = record.check("it gives a displacement for every joint", _displacement, effect, values)
    if added is not None:
        recorded, moved = added
        record.check("displacements depend on what is given", lambda: expect_only(moved, [recorded, given]))
        record.check("displacements do not branch on a parameter", expect_no_choice, moved, recorded, given)
        record.check("displacements are finite", _finite_displacement, blocks, given, recorded, moved)
        record.check("lengths and angles move a joint by as much", _displacement_gains, blocks, given, recorded, moved)
    record.check("it is the same each time", _repeated, subject, effect, blocks)
    record.check("every parameter has an influence", _all_used, effect, values)
    if reshapes(effect) or effect.conditions:
        record.check("the columns it reads are declared, each with its dimension", _columns, effect)
        record.check("its shape changes with every column it declares", _read, effect, values)
    springs = record.check("its springs have a site and unit directions", _springs, effect, values)
    if not springs:
        return
    loads = ca.SX.sym("loads", sum(spring.size for spring in springs))
    recorded = ca.SX.sym("recorded", 2 * len(JOINTS))
    laws = record.check("every law gives one deflection a coordinate", _laws, springs, loads, recorded)
    if laws is None:
        return
    record.check("laws depend on what is given", lambda: expect_only(laws, [loads, recorded, given]))
    record.check(
        "laws branch neither on a parameter nor on a load",
        lambda: expect_no_choice(laws, recorded, stacked([loads, given])),
    )
    expressions = [ca.substitute(laws, recorded, ca.SX(state * len(JOINTS))) for state in _STATES]
    record.check("laws are finite and smooth, at zero load too", _smooth, blocks, given, loads, expressions)
    record.check(
        "deflections are in rad, of loads in N m", lambda: _law_gains(blocks, given, loads, stacked(expressions))
    )


def _derived(effect: JointEffect) -> bool:
    bases = ", ".join(base.__name__ for base in type(effect).__bases__)
    expect(isinstance(effect, JointEffect), f"found that it derives from {bases}, expected JointEffect")
    return True


def _displacement(effect: JointEffect, values: Mapping[str, Expression]) -> tuple[Expression, Expression]:
    recorded = ca.SX.sym("recorded", 2 * len(JOINTS))
    parts = []
    for i, joint in enumerate(JOINTS):
        part = ca.SX(effect.displacement(JointCommand(i, recorded[2 * i], recorded[2 * i + 1]), values))
        expect(part.numel() == 1, f"found {part.numel()} numbers for {joint}, expected one (rad or m)")
        parts.append(part)
    return recorded, stacked(parts)


def _finite_displacement(
    blocks: Sequence[ParameterBlock], given: Expression, recorded: Expression, moved: Expression
) -> None:
    function = ca.Function("displacement", [given, recorded], [moved])
    random = np.random.default_rng(1)
    for approach in (-1.0, 0.0, 1.0):
        for command in (0.0, 0.3, -1.2):
            displacement = np.asarray(function(near_nominal(blocks, random), [command, approach] * len(JOINTS)))
            expect(
                bool(np.isfinite(displacement).all()),
                f"found {displacement.ravel()} for the command {command} from approach {approach:+.0f}",
            )


def _displacement_gains(
    blocks: Sequence[ParameterBlock], given: Expression, recorded: Expression, moved: Expression
) -> None:
    """What a parameter in m or rad adds to a joint, at commands and approaches of either sign."""
    slope = ca.Function("slope", [given, recorded], [ca.densify(ca.jacobian(moved, given))])
    entries = near_nominal(blocks, np.random.default_rng(3))
    points = [[command, side] * len(JOINTS) for command in (0.4, -1.2, 2.0) for side in (-1.0, 1.0)]
    gains = np.abs([np.asarray(slope(entries, at)) for at in points]).max(axis=(0, 1), initial=0.0)
    for place, block in scalars(blocks, "m", "rad"):
        expect_gain(float(gains[place]), "a joint's displacement", block.name, block.unit)


def _all_used(effect: JointEffect, values: Mapping[str, Expression]) -> None:
    """Every parameter changes a displacement, a law or the shape of an arm of the effect's joints."""
    loads = ca.SX.sym("loads", 3 * len(JOINTS) + 3)
    recorded = ca.SX.sym("recorded", 2 * len(JOINTS))
    laws = [spring.law(loads[: spring.size], _command(spring, recorded)) for spring in effect.springs(values)]
    shape = _shape(effect, {name: ca.SX.sym(name) for name in _arm_of(effect).conditions}, values)
    expect_all_used(stacked([_displacement(effect, values)[1], *laws, shape]), values)


def _shape(effect: JointEffect, conditions: Mapping[str, Expression], values: Mapping[str, Expression]) -> Expression:
    """What an effect makes of a chain of links of any length."""
    links = [se3.translation_along("x", ca.SX.sym(f"l{i}")) for i in range(len(JOINTS) + 1)]
    joints = tuple(Joint(name, link) for name, link in zip(JOINTS, links, strict=False))
    shaped = effect.shaped(Chain(se3.identity(), joints, Attachment(len(JOINTS), links[-1])), conditions, values)
    return stacked([shaped.tool.joint_T_frame.matrix(), *(j.parent_T_joint.matrix() for j in shaped.joints)])


def _arm_of(effect: JointEffect) -> Arm:
    return replace(planar_arms((ARM,))[ARM], effects={"effect": effect})


def _columns(effect: JointEffect) -> None:
    try:
        surroundings({ARM: _arm_of(effect)})
    except ValueError as fault:
        raise ContractError(str(fault)) from fault


def _read(effect: JointEffect, values: Mapping[str, Expression]) -> None:
    """Each column has an influence, and without them the shape is known, or the missing name is a KeyError."""
    given = {name: ca.SX.sym(name) for name in _arm_of(effect).conditions}
    expect_all_used(_shape(effect, given, values), given)
    try:
        _shape(effect, {}, values)
    except KeyError as fault:
        expect(fault.args[0] in given, f"found that it reads {fault.args[0]!r}, expected it among its conditions")


def _repeated(subject: Subject, effect: JointEffect, blocks: tuple[ParameterBlock, ...]) -> None:
    def picture(made: JointEffect) -> Array:
        expect(tuple(made.parameters()) == blocks, "found other parameters another time")
        values = symbols(blocks)
        entries = near_nominal(blocks, np.random.default_rng(4))
        recorded, moved = _displacement(made, values)
        springs = made.springs(values)
        laws = [spring.law(ca.SX(np.linspace(0.3, 1.1, spring.size)), _command(spring, recorded)) for spring in springs]
        function = ca.Function("all", [stacked(list(values.values())), recorded], [stacked([moved, *laws])])
        return np.asarray(function(entries, [0.4, 1.0] * len(JOINTS)))

    expect_repeated(lambda: picture(effect), lambda: picture(subject.build(JOINTS)))


def _law_gains(blocks: Sequence[ParameterBlock], given: Expression, loads: Expression, laws: Expression) -> None:
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


def _springs(effect: JointEffect, values: Mapping[str, Expression]) -> tuple[Spring, ...]:
    springs = tuple(effect.springs(values))
    for spring in springs:
        expect(isinstance(spring, Spring), f"found {type(spring).__name__} among the springs, expected Spring")
        expect(0 <= spring.site <= len(JOINTS), f"found the site {spring.site}, expected 0 to {len(JOINTS)}")
        expect(
            spring.site > 0 or len(spring.directions) > 0,
            "found a spring at the base without directions; the base has no axis of its own",
        )
        for direction in spring.directions:
            length = float(np.linalg.norm(direction))
            expect(
                len(direction) == 3 and abs(length - 1) <= 1e-9,
                f"found the direction {direction} of length {length:g}, expected a unit vector",
            )
    return springs


def _command(spring: Spring, recorded: Expression) -> JointCommand:
    """What the joint of a spring was commanded, of the commands and approaches of all (6x1)."""
    at = 2 * (spring.site - 1)
    return JointCommand(spring.site - 1, recorded[at], recorded[at + 1]) if spring.site else MOUNT


def _laws(springs: Sequence[Spring], loads: Expression, recorded: Expression) -> Expression:
    parts, start = [], 0
    for spring in springs:
        part = ca.SX(spring.law(loads[start : start + spring.size], _command(spring, recorded)))
        start += spring.size
        expect(
            part.shape == (spring.size, 1),
            f"the spring at site {spring.site} gives {part.shape}, expected {spring.size} x 1",
        )
        parts.append(part)
    return stacked(parts)


def _smooth(blocks: Sequence[ParameterBlock], given: Expression, loads: Expression, laws: Sequence[Expression]) -> None:
    function = ca.Function("laws", [stacked([loads, given])], [stacked(laws)])
    random = np.random.default_rng(2)
    entries = near_nominal(blocks, random)
    names = (*(f"load {i}" for i in range(1, loads.numel() + 1)), *entry_names(blocks))
    for load in (np.zeros(loads.numel()), random.uniform(-2, 2, loads.numel())):
        at = np.concatenate([load, entries])
        values = np.asarray(function(at)).ravel()
        expect(bool(np.isfinite(values).all()), f"found the deflections {values} under the loads {load}")
        expect_derivatives(function, at, "the deflections", names)
