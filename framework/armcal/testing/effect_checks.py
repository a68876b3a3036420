"""Checks on joint effects: parameters, displacements, springs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from armcal.arm.effects import JointCommand, JointEffect, Spring
from armcal.base.parameters import ParameterBlock
from armcal.base.se3 import Expression
from armcal.testing.expressions import (
    check_parameters,
    entry_names,
    expect_derivatives,
    expect_no_choice,
    expect_only,
    near_nominal,
    stacked,
    symbols,
)
from armcal.testing.results import Recorder, expect
from armcal.testing.settings_checks import Subject

JOINTS = ("q1", "q2", "q3")


def check_effect(record: Recorder, subject: Subject) -> None:
    """Everything that an arm asks of a joint effect, on joints q1, q2 and q3."""
    effect: JointEffect | None = record.check(
        f"it builds for the joints {', '.join(JOINTS)}", lambda: subject.made(subject.settings, JOINTS)
    )
    blocks = None if effect is None else check_parameters(record, effect.parameters)
    if effect is None or blocks is None:
        return
    values = symbols(blocks)
    given = stacked(list(values.values()))
    added = record.check("it gives a displacement for every joint", lambda: _displacement(effect, values))
    if added is not None:
        recorded, moved = added
        record.check("displacements depend on what is given", lambda: expect_only(moved, [recorded, given]))
        record.check("displacements do not branch on a parameter", lambda: expect_no_choice(moved, recorded, given))
        record.check("displacements are finite", lambda: _finite_displacement(blocks, given, recorded, moved))
    springs = record.check("its springs have a site and unit directions", lambda: _springs(effect, values))
    if not springs:
        return
    loads = ca.SX.sym("loads", sum(spring.size for spring in springs))
    laws = record.check("every law gives one deflection a coordinate", lambda: _laws(springs, loads))
    if laws is None:
        return
    record.check("laws depend on what is given", lambda: expect_only(laws, [loads, given]))
    record.check(
        "laws branch neither on a parameter nor on a load",
        lambda: expect_no_choice(laws, ca.SX(0, 1), stacked([loads, given])),
    )
    record.check("laws are finite and smooth, at zero load too", lambda: _smooth(blocks, given, loads, laws))


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
            found = np.asarray(function(near_nominal(blocks, random), [command, approach] * len(JOINTS)))
            expect(
                bool(np.isfinite(found).all()),
                f"found {found.ravel()} for the command {command} from approach {approach:+.0f}",
            )


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


def _laws(springs: Sequence[Spring], loads: Expression) -> Expression:
    parts, start = [], 0
    for spring in springs:
        part = ca.SX(spring.law(loads[start : start + spring.size]))
        start += spring.size
        expect(
            part.shape == (spring.size, 1),
            f"the spring at site {spring.site} gives {part.shape}, expected {spring.size} x 1",
        )
        parts.append(part)
    return stacked(parts)


def _smooth(blocks: Sequence[ParameterBlock], given: Expression, loads: Expression, laws: Expression) -> None:
    function = ca.Function("laws", [stacked([loads, given])], [laws])
    random = np.random.default_rng(2)
    entries = near_nominal(blocks, random)
    names = (*(f"load {i}" for i in range(1, loads.numel() + 1)), *entry_names(blocks))
    for load in (np.zeros(loads.numel()), random.uniform(-2, 2, loads.numel())):
        at = np.concatenate([load, entries])
        found = np.asarray(function(at)).ravel()
        expect(bool(np.isfinite(found).all()), f"found the deflections {found} under the loads {load}")
        expect_derivatives(function, at, "the deflections", names)
