"""Checks on what is made of expressions: arm models, joint effects, pose residuals, measurements."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import casadi as ca
import numpy as np

from armcal.arm.assembly import Arm, MassiveModel, prefixed
from armcal.arm.effects import MOUNT, JointCommand, JointEffect, Spring, check_springs, reshapes
from armcal.arm.model import Attachment, Chain, Joint, check_chain, forward
from armcal.arm.pose_residual import OF_TOOL, SURROUNDINGS, ModelErrors, PoseResidual, Postures
from armcal.arm.statics import MOUNT_FRAME, TOOL_FRAME, frame_names
from armcal.base import se3
from armcal.base.arrays import Array
from armcal.base.domains import Interval
from armcal.base.parameters import ParameterBlock, Parameters, declared
from armcal.base.se3 import Expression, Transform
from armcal.base.units import ERROR_UNITS, display_unit, si_unit, units_of
from armcal.measure.groups import OTHER
from armcal.measure.measurement import Channel, GroupedMeasurement, Measurement
from armcal.measure.reader import surroundings
from armcal.problem.factor import Factor, build_factor
from armcal.problem.readings import readings_by_residual
from armcal.testing.checking import PLUGIN_FAULTS, ContractError, Subject, check, expect
from armcal.testing.planar import ARM, GRAVITY, planar_arms, skewed_arms

C = TypeVar("C")
JOINTS = ("q1", "q2", "q3")
_STEP, _JACOBIAN_TOLERANCE, _ROTATION_TOLERANCE = 1e-5, 1e-6, 1e-9
_LEAST_GAIN, _LEAST_GAIN_M, _MOST_GAIN, _NOTHING = 0.05, 5e-3, 20.0, 1e-9
"""What a unit of a parameter moves, in the same unit: about one. A degree is 0.017 rad, a millimetre 0.001 m."""
_LARGEST = {"m": (100.0, 1.0), "rad": (4 * math.pi, math.pi), "kpx": (20.0, 5.0)}
"""By unit: the largest nominal value, and the largest ordinary correction, that any arm could mean."""
_CHOICES = {
    getattr(ca, name): name.removeprefix("OP_").lower()
    for name in (
        *("OP_LT", "OP_LE", "OP_EQ", "OP_NE", "OP_NOT", "OP_AND", "OP_OR", "OP_IF_ELSE_ZERO"),
        *("OP_SIGN", "OP_FABS", "OP_FMIN", "OP_FMAX", "OP_FLOOR", "OP_CEIL", "OP_FMOD", "OP_COPYSIGN"),
        *("OP_REMAINDER", "OP_MMIN", "OP_MMAX"),
    )
}

# --- parameters and expressions of any component --------------------------------------------------------------------


def _declare(s: Subject) -> None:
    """The parameters of a component that was built, in SI units, plausible in them, and able to move."""
    s.blocks = declared(s.built)
    for _, block in scalars(s.blocks, *_LARGEST):
        (largest, widest), worst = _LARGEST[block.unit], max((abs(number) for number in block.nominal), default=0.0)
        expect(
            worst <= largest and block.scale <= widest,
            f"{block.name}: found the nominal value {worst:g} and the scale {block.scale:g} {block.unit}, "
            f"not plausible in their units: expected up to {largest:.3g} and {widest:.3g}: "
            f"is it in {'mm' if block.unit == 'm' else 'deg'}?",
        )
    for block in s.blocks:
        values = np.array(block.nominal, dtype=float)
        sized = f"found {values.size} nominal values, expected {block.size}"
        expect(values.shape == (block.size,), f"{block.name}: {sized}")
        fault = block.domain.check(values)
        expect(not fault, f"{block.name}: its nominal values are outside its domain: {fault}")
        parameters, dof = Parameters((replace(block, free=True),)), block.domain.dof
        moves = np.linalg.matrix_rank(parameters.retract_jacobian(np.zeros(dof)))
        expect(moves == dof, f"{block.name}: only {moves} of {dof} increments move its nominal value; start elsewhere")
        delta = np.clip(0.5 * parameters.scales(), *parameters.increment_bounds())
        back = parameters.local(parameters.retract(delta))
        expect(
            bool(np.allclose(back, delta, rtol=1e-6, atol=1e-9 * block.scale)),
            f"{block.name}: an increment does not come back from its domain's retract and local",
        )
    s.values = symbols(s.blocks)
    s.given = stacked(list(s.values.values()))


def symbols(blocks: Sequence[ParameterBlock]) -> dict[str, Expression]:
    return {block.name: ca.SX.sym(block.name, block.size) for block in blocks}


def near_nominal(blocks: Sequence[ParameterBlock], random: np.random.Generator) -> Array:
    parameters = Parameters(tuple(replace(block, free=True) for block in blocks))
    delta = random.uniform(-1, 1, len(parameters.scales())) * parameters.scales()
    return parameters.retract(np.clip(delta, *parameters.increment_bounds()))


def stacked(parts: Sequence[Expression]) -> Expression:
    """Expressions of any shape as one dense column."""
    return ca.densify(ca.vertcat(ca.SX(0, 1), *[ca.vec(ca.SX(part)) for part in parts]))


def scalars(blocks: Sequence[ParameterBlock], *units: str) -> list[tuple[int, ParameterBlock]]:
    """Blocks of one number in these units, each with its place."""
    places = np.cumsum([0, *(block.size for block in blocks)])
    listed = zip(places.tolist(), blocks, strict=False)
    return [(place, block) for place, block in listed if isinstance(block.domain, Interval) and block.unit in units]


def expect_only(expression: Expression, given: Sequence[Expression]) -> None:
    known = {symbol.element_hash() for input_ in given for symbol in ca.symvar(ca.SX(input_))}
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
        depends = inputs[0] == 1 if operation == ca.OP_INPUT else any(i in tainted for i in inputs)
        conditions = inputs[:1] if operation == ca.OP_IF_ELSE_ZERO else inputs
        if operation in _CHOICES and any(i in tainted for i in conditions):
            raise ContractError(
                f"found {_CHOICES[operation]} of a parameter or a result, which branches on it; expected a smooth "
                "expression (it may branch on commands and approaches only)"
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
        allowed = _JACOBIAN_TOLERANCE * max(1.0, float(np.abs(slope).max(initial=0.0)))
        worst = float(np.abs(exact[:, column] - slope).max(initial=0.0))
        expect(worst <= allowed, f"the derivative of {what} by {name} is off by {worst:.1e}, expected {allowed:.1e}")


def expect_all_used(expression: Expression, values: Mapping[str, Expression]) -> None:
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


def expect_gain(gain: float, what: str, of: str, unit: str) -> None:
    """Raise ContractError if ``what`` moves by far more or less than about one for each unit of ``of``, if at all."""
    least = _LEAST_GAIN_M if unit == "m" else _LEAST_GAIN
    expect(
        gain <= _NOTHING or least <= gain <= _MOST_GAIN,
        f"found that {what} changes by {gain:.4g} {unit} for each {unit} of {of}, expected about 1: "
        "is one of them in another unit?",
    )


# --- arm models -----------------------------------------------------------------------------------------------------

POSES = 20


@check("model", needed=True)
def the_model_builds_with_joints_and_parameters_in_si_units(s: Subject) -> None:
    s.built = s.build()
    names = s.names = tuple(s.built.joint_names)
    expect(len(names) > 0, "found no joints, expected at least one")
    for name in names:
        expect(isinstance(name, str) and bool(name), f"found the joint name {name!r}, expected text")
        expect("." not in name, f"found the joint name {name!r}, expected one without a dot")
    expect(len(set(names)) == len(names), f"found {', '.join(names)}, expected every name once")
    _declare(s)


@check("model", needed=True)
def its_chain_has_one_joint_for_each_name(s: Subject) -> None:
    s.chain = chain = s.built.chain(s.values)
    check_chain(s.built.chain, chain, s.names)
    expect(isinstance(chain, Chain), f"found a chain of type {type(chain).__name__}, expected Chain")
    for joint in chain.joints:
        turns, slides = (float(np.linalg.norm(axis)) for axis in (joint.angular, joint.linear))
        expect(min(turns, slides) == 0, f"joint {joint.name}: found an axis to turn about and one to slide along")
    taken = sorted({MOUNT_FRAME, TOOL_FRAME} & set(chain.frames))
    expect(not taken, f"found a frame called {', '.join(taken)}, which armcal uses itself")
    if isinstance(s.built, MassiveModel):
        frames, masses = frame_names(chain), tuple(s.built.masses())
        for mass in masses:
            expect("." not in mass.name, f"found the mass {mass.name!r}, expected a name without a dot")
            expect(mass.mass >= 0, f"the mass {mass.name} is {mass.mass} kg, expected 0 or more")
            known = f"expected one of {', '.join(frames)}"
            expect(mass.frame in frames, f"the mass {mass.name} is in {mass.frame!r}, {known}")
        names = [mass.name for mass in masses]
        expect(len(set(names)) == len(names), f"found {', '.join(names)}, expected every name once")


@check("model")
def its_chain_depends_on_its_parameters_and_does_not_branch_on_them(s: Subject) -> None:
    chain = s.chain
    transforms = [chain.base_T_mount, chain.tool.joint_T_frame, *(joint.parent_T_joint for joint in chain.joints)]
    transforms += [at.joint_T_frame for at in chain.frames.values()]
    twists = [part for joint in chain.joints if joint.twist is not None for part in joint.twist]
    parts = stacked([*(t.matrix() for t in transforms), *(joint.offset for joint in chain.joints), *twists])
    expect_only(parts, [s.given])
    expect_no_choice(parts, ca.SX(0, 1), s.given)
    expect_all_used(parts, s.values)


@check("model", needed=True)
def random_poses_are_rigid_motions(s: Subject) -> None:
    s.poses, random = _poses(s.given, s.chain), np.random.default_rng(1)
    s.reach = [2.0 if joint.is_revolute else 0.2 for joint in s.chain.joints]
    for _ in range(POSES):
        shown = np.asarray(s.poses(_point(s, random))).reshape(-1, 4, 3).transpose(0, 2, 1)
        expect(bool(np.isfinite(shown).all()), "found a pose that is not finite")
        rotation = shown[:, :, :3]
        off = float(np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max())
        expect(off <= _ROTATION_TOLERANCE, f"found a rotation off orthonormal by {off:.1e}")
        handed = float(np.abs(np.linalg.det(rotation) - 1).max())
        expect(handed <= _ROTATION_TOLERANCE, f"found a rotation with determinant off 1 by {handed:.1e}")


@check("model")
def the_model_is_the_same_each_time(s: Subject) -> None:
    def picture(model: Any) -> Array:
        expect(tuple(model.parameters()) == s.blocks, "found other parameters another time")
        values = symbols(s.blocks)
        poses = _poses(stacked(list(values.values())), model.chain(values))
        return np.asarray(poses(_point(s, np.random.default_rng(4))))

    expect_repeated(picture, s.built, s.build())


@check("model")
def derivatives_of_poses_agree_with_differences(s: Subject) -> None:
    names = (*Parameters(s.blocks).entry_names, *(joint.name for joint in s.chain.joints))
    expect_derivatives(s.poses, _point(s, np.random.default_rng(2)), "the poses", names)


@check("model")
def lengths_move_it_by_lengths_and_angles_by_angles(s: Subject) -> None:  # m for each m, rad for each rad
    random, jacobian = np.random.default_rng(5), s.poses.jacobian()
    points = [_point(s, random) for _ in range(3)]
    slopes = np.array([np.asarray(jacobian(at, s.poses(at)))[:12].reshape(4, 3, -1) for at in points])
    for place, block in scalars(s.blocks, "m"):
        moved = np.linalg.norm(slopes[:, 3, :, place], axis=1)
        expect_gain(float(moved.max()), "the tool's position", block.name, "m")
    for place, block in scalars(s.blocks, "rad"):
        turned = np.linalg.norm(slopes[:, :3, :, place], axis=(1, 2)) / np.sqrt(2)
        expect_gain(float(turned.max()), "the tool's orientation", block.name, "rad")


def _poses(given: Expression, chain: Chain) -> ca.Function:
    """Tool, named frames and sites as a function of all entries and displacements."""
    moved = ca.SX.sym("displacement", len(chain.joints))
    frames = forward(chain, [joint.offset + moved[i] for i, joint in enumerate(chain.joints)], {})
    shown = [frames.base_T_tool, *frames.named.values(), *(Transform(at.rotation, at.origin) for at in frames.sites)]
    return ca.Function("poses", [stacked([given, moved])], [stacked([pose.matrix()[:3, :] for pose in shown])])


def _point(s: Subject, random: np.random.Generator) -> Array:
    return np.concatenate([near_nominal(s.blocks, random), random.uniform(-1, 1, len(s.reach)) * s.reach])


# --- joint effects, on joints q1, q2 and q3 -------------------------------------------------------------------------


@check("effect", needed=True)
def the_effect_builds_with_parameters_in_si_units(s: Subject) -> None:
    s.built = s.build(JOINTS)
    bases = ", ".join(base.__name__ for base in type(s.built).__bases__)
    expect(isinstance(s.built, JointEffect), f"found that it derives from {bases}, expected armcal.JointEffect")
    s.recorded = ca.SX.sym("recorded", 2 * len(JOINTS))  # command and approach of each joint
    _declare(s)


@check("effect", needed=True)
def it_gives_a_displacement_for_every_joint(s: Subject) -> None:
    s.moved = _displacements(s.built, s.values, s.recorded)


@check("effect")
def its_displacements_are_finite_and_smooth_in_its_parameters(s: Subject) -> None:
    expect_only(s.moved, [s.recorded, s.given])
    expect_no_choice(s.moved, s.recorded, s.given)
    function, random = ca.Function("displacement", [s.given, s.recorded], [s.moved]), np.random.default_rng(1)
    for approach in (-1.0, 0.0, 1.0):
        for command in (0.0, 0.3, -1.2):
            shown = np.asarray(function(near_nominal(s.blocks, random), [command, approach] * len(JOINTS)))
            state = f"for the command {command} from approach {approach:+.0f}"
            expect(bool(np.isfinite(shown).all()), f"found {shown.ravel()} {state}, expected finite numbers")


@check("effect")
def lengths_and_angles_move_a_joint_by_as_much(s: Subject) -> None:  # at commands and approaches of either sign
    slope = ca.Function("slope", [s.given, s.recorded], [ca.densify(ca.jacobian(s.moved, s.given))])
    entries = near_nominal(s.blocks, np.random.default_rng(3))
    points = [[command, side] * len(JOINTS) for command in (0.4, -1.2, 2.0) for side in (-1.0, 1.0)]
    gains = np.abs([np.asarray(slope(entries, at)) for at in points]).max(axis=(0, 1), initial=0.0)
    for place, block in scalars(s.blocks, "m", "rad"):
        expect_gain(float(gains[place]), "a joint's displacement", block.name, block.unit)


@check("effect")
def the_effect_is_the_same_each_time(s: Subject) -> None:
    entries = near_nominal(s.blocks, np.random.default_rng(4))

    def picture(effect: JointEffect) -> Array:
        expect(tuple(effect.parameters()) == s.blocks, "found other parameters another time")
        values = symbols(s.blocks)
        laws = [
            spring.law(ca.SX(np.linspace(0.3, 1.1, spring.size)), _command(spring, s.recorded))
            for spring in effect.springs(values)
        ]
        moved = _displacements(effect, values, s.recorded)
        function = ca.Function("all", [stacked(list(values.values())), s.recorded], [stacked([moved, *laws])])
        return np.asarray(function(entries, [0.4, 1.0] * len(JOINTS)))

    expect_repeated(picture, s.built, s.build(JOINTS))


@check("effect")
def the_columns_it_reads_are_declared_and_change_its_shape(s: Subject) -> None:
    effect = s.built
    if not (reshapes(effect) or effect.conditions):
        return
    arm = replace(planar_arms((ARM,))[ARM], effects={"effect": effect})
    try:
        surroundings({ARM: arm})
    except ValueError as fault:
        raise ContractError(str(fault)) from fault
    given = {name: ca.SX.sym(name) for name in arm.conditions}
    expect_all_used(_shape(effect, given, s.values), given)
    try:
        _shape(effect, {}, s.values)  # known without them, or the missing name is a KeyError
    except KeyError as fault:
        expect(fault.args[0] in given, f"found that it reads {fault.args[0]!r}, expected it among its conditions")


@check("effect", needed=True)
def its_springs_have_a_site_unit_directions_and_one_deflection_a_coordinate(s: Subject) -> None:
    s.springs = check_springs(s.built.springs, s.built.springs(s.values), len(JOINTS))
    s.loads = ca.SX.sym("loads", sum(spring.size for spring in s.springs))
    parts, start = [], 0
    for spring in s.springs:
        part = ca.SX(spring.law(s.loads[start : start + spring.size], _command(spring, s.recorded)))
        start += spring.size
        result = f"the spring at site {spring.site} gives {part.shape}"
        expect(part.shape == (spring.size, 1), f"{result}, expected {spring.size} x 1")
        parts.append(part)
    s.laws = stacked(parts)


@check("effect")
def every_parameter_of_the_effect_has_an_influence(s: Subject) -> None:
    conditions = {name: ca.SX.sym(name) for name in _condition_names(s.built)}
    expect_all_used(stacked([s.moved, s.laws, _shape(s.built, conditions, s.values)]), s.values)


@check("effect")
def its_laws_are_finite_smooth_and_in_rad_at_zero_load_too(s: Subject) -> None:
    expect_only(s.laws, [s.loads, s.recorded, s.given])
    expect_no_choice(s.laws, s.recorded, stacked([s.loads, s.given]))
    states = ([0.0, 0.0], [0.4, 1.0], [-1.2, -1.0])  # command and approach of a joint
    laws = stacked([ca.substitute(s.laws, s.recorded, ca.SX(state * len(JOINTS))) for state in states])
    function, random = ca.Function("laws", [stacked([s.loads, s.given])], [laws]), np.random.default_rng(2)
    entries, count = near_nominal(s.blocks, random), s.loads.numel()
    names = (*(f"load {i}" for i in range(1, count + 1)), *Parameters(s.blocks).entry_names)
    for load in (np.zeros(count), random.uniform(-2, 2, count)):
        at = np.concatenate([load, entries])
        shown = np.asarray(function(at)).ravel()
        expect(bool(np.isfinite(shown).all()), f"found the deflections {shown} under the loads {load}")
        expect_derivatives(function, at, "the deflections", names)
    if not s.springs:
        return
    # What a parameter in rad adds to a deflection; one in rad/(N m), for each N m.
    slope = ca.Function("slope", [s.given, s.loads], [ca.densify(ca.jacobian(laws, s.given))])
    random, gains = np.random.default_rng(3), []
    entries = near_nominal(s.blocks, random)
    for _ in range(3):
        load = random.uniform(0.5, 2, count) * random.choice([-1, 1], count)
        gains.append(np.abs(np.asarray(slope(entries, load))) / np.array([[1.0], [np.abs(load).max()]])[:, :, None])
    per = np.array(gains).max(axis=(0, 2), initial=0.0)
    for row, unit in enumerate(("rad", "rad_per_Nm")):
        for place, block in scalars(s.blocks, unit):
            expect_gain(float(per[row, place]), "a deflection", block.name, "rad")


def _displacements(effect: JointEffect, values: Mapping[str, Expression], recorded: Expression) -> Expression:
    parts = []
    for i, joint in enumerate(JOINTS):
        part = ca.SX(effect.displacement(JointCommand(i, recorded[2 * i], recorded[2 * i + 1]), values))
        expect(part.numel() == 1, f"found {part.numel()} numbers for {joint}, expected one (rad or m)")
        parts.append(part)
    return stacked(parts)


def _shape(effect: JointEffect, conditions: Mapping[str, Expression], values: Mapping[str, Expression]) -> Expression:
    links = [se3.translation_along("x", ca.SX.sym(f"l{i}")) for i in range(len(JOINTS) + 1)]
    joints = tuple(Joint(name, link) for name, link in zip(JOINTS, links, strict=False))
    shaped = effect.shaped(Chain(se3.identity(), joints, Attachment(len(JOINTS), links[-1])), conditions, values)
    moved = [ca.SX(joint.offset) for joint in shaped.joints]
    return stacked([shaped.tool.joint_T_frame.matrix(), *(j.parent_T_joint.matrix() for j in shaped.joints), *moved])


def _condition_names(effect: JointEffect) -> tuple[str, ...]:
    return replace(planar_arms((ARM,))[ARM], effects={"effect": effect}).conditions


def _command(spring: Spring, recorded: Expression) -> JointCommand:
    """What the joint of a spring was commanded, of the commands and approaches of all (6x1)."""
    at = 2 * (spring.site - 1)
    return JointCommand(spring.site - 1, recorded[at], recorded[at + 1]) if spring.site else MOUNT


# --- pose residuals, on joints q1, q2 and q3, of a tool that is off by what joint q2 commands ------------------------

_COUNT, _NOISE_M = 240, 1e-4


@check("residual", needed=True)
def the_residual_learns_an_error_that_its_commands_explain(s: Subject) -> None:
    residual = s.built = s.build(JOINTS)
    expect(isinstance(residual, PoseResidual), f"found {type(residual).__name__}, expected an armcal.PoseResidual")
    expect(not residual.is_learned, "found that it corrects something before it was shown records")
    expect(residual.learned(_errors(2)) is None, "found that it learned from 2 records")
    s.learned, s.unseen = residual.learned(_errors(_COUNT)), _errors(2 * _COUNT).postures.subset(slice(_COUNT, None))
    expect(s.learned is not None and s.learned.is_learned, f"found that it learned nothing from {_COUNT} records")
    corrections, size = s.learned.corrections(s.unseen), len(OF_TOOL) + len(JOINTS)
    shape = f"found corrections of {corrections.shape}, expected {size} x {_COUNT}: tool and joints"
    expect(corrections.shape == (size, _COUNT), shape)
    before = _shift(s.unseen.commands)
    after = (
        before - corrections[:3].T - np.einsum("nij,jn->ni", _levers(s.unseen.commands), corrections[len(OF_TOOL) :])
    )
    smaller = float(np.linalg.norm(after) / np.linalg.norm(before))
    expect(smaller < 0.7, f"found unseen errors {smaller:.2f} times as large, expected them smaller")


@check("residual")
def it_corrects_nothing_beyond_and_is_less_sure_away_from_what_it_learned(s: Subject) -> None:
    turned, away = (Postures(s.unseen.commands + angle, s.unseen.approaches) for angle in (2 * np.pi, np.pi))
    expect(not s.learned.corrections(turned).any(), "found corrections beyond the commands that it learned from")
    near, far = (s.learned.deviations(own) for own in (s.unseen, away))
    expect(bool(np.isfinite(near).all() and np.isfinite(far).all()), "found deviations that are not finite")
    expect(bool((near >= 0).all()), "found deviations below zero")
    expect(float(np.linalg.norm(far)) > float(np.linalg.norm(near)), "found that they do not grow")
    given = [ca.SX.sym(name, len(JOINTS)) for name in ("commands", "approaches")]
    around = {name: ca.SX.sym(name) for name in SURROUNDINGS}
    expect_only(s.learned.correction(given[0], given[1], around), [*given, *around.values()])


@check("residual")
def what_it_learned_is_kept_in_its_settings_and_the_same_each_time(s: Subject) -> None:
    learned, unseen = s.learned, s.unseen
    again = type(learned)(type(learned.settings).model_validate(learned.settings.to_config()), JOINTS)
    expect_repeated(lambda made: made.corrections(unseen), learned, again)
    expect_repeated(lambda made: made.deviations(unseen), learned, again)
    other = s.built.learned(_errors(_COUNT))
    same = other is not None and np.array_equal(other.corrections(unseen), learned.corrections(unseen))
    expect(same, "found other corrections when it learned a second time")


def _errors(count: int) -> ModelErrors:
    random = np.random.default_rng(5)
    commands = random.uniform(-2, 2, (len(JOINTS), count))
    slopes = np.zeros((count, 3, len(OF_TOOL) + len(JOINTS)))
    slopes[:, :, :3], slopes[:, :, len(OF_TOOL) :] = -np.eye(3), -_levers(commands)
    errors = _shift(commands) + random.normal(0, _NOISE_M, (count, 3))
    postures = Postures(commands, np.zeros_like(commands))
    return ModelErrors(postures, ("angle",) * len(JOINTS), errors / _NOISE_M, slopes / _NOISE_M, 3)


def _shift(commands: Array) -> Array:
    """Of the tool (N x 3; m), by joint q2, which turns it further than its command."""
    return np.asarray(_levers(commands)[:, :, 1] * (2e-3 * np.sin(2 * commands[1]))[:, None])


def _levers(commands: Array) -> Array:
    """How a tool moves with each joint (N x 3 x joints; m/rad)."""
    levers = np.zeros((commands.shape[1], 3, len(JOINTS)))
    for joint, command in enumerate(commands):
        levers[:, joint] = 0.3 * np.eye(3)[(joint + 1) % 3]
        levers[:, joint, joint] = 0.1 * np.cos(command)
    return levers


# --- measurements, on planar arms -----------------------------------------------------------------------------------

ARM_NAMES = ((ARM,), ("left", "right"))
"""The arms that a measurement is built for: one, or if it refuses that, two."""
_NOISIEST = {"length": 0.1, "angle": 0.5, "image": 0.05}
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

    @classmethod
    def of(
        cls, measurement: Measurement, arms: Mapping[str, Arm], own: Sequence[ParameterBlock], read: Sequence[Channel]
    ) -> "_Case":
        of_arms = (block for arm in arms.values() for block in arm.parameters())
        parameters = Parameters((*of_arms, *prefixed(f"{_INSTRUMENT}.", own)))
        parameters = parameters.with_free(parameters.names)
        available = frozenset(f"{_INSTRUMENT}.{channel.name}" for channel in read)
        factor = build_factor(_INSTRUMENT, measurement, arms, parameters, GRAVITY, available, unrolled=True)
        rows, columns = factor.residual.shape
        expect(rows > 0 and columns == 1, f"found a residual of {rows} x {columns}, expected n x 1")
        return cls(measurement, own, read, parameters, factor)

    @property
    def arm_blocks(self) -> tuple[ParameterBlock, ...]:
        return self.parameters.blocks[: len(self.parameters.blocks) - len(self.own)]

    @property
    def group_blocks(self) -> tuple[ParameterBlock, ...]:
        """Of one group that is not known beforehand."""
        own = self.measurement
        return tuple(own.group_parameters(_GROUP)) if isinstance(own, GroupedMeasurement) else ()

    @property
    def other_blocks(self) -> tuple[ParameterBlock, ...]:
        return (*self.parameters.blocks[len(self.arm_blocks) :], *self.group_blocks)

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
        return np.asarray(self.function(expression)(np.concatenate(at))).ravel()


@check("measurement", needed=True)
def the_measurement_builds_with_parameters_in_si_units(s: Subject) -> None:
    refused = []
    for names in ARM_NAMES:
        try:
            s.built, s.arms = s.build(names), names
            break
        except PLUGIN_FAULTS as fault:
            refused.append(f"{', '.join(names)}: {fault}")
    else:
        raise ContractError("it refuses every choice of arms; " + "; ".join(refused))
    unknown = [name for name in s.built.arms if name.removesuffix(OTHER) not in s.arms]
    usual = f"found the arms {tuple(s.built.arms)}, expected some of {s.arms}"
    expect(len(s.built.arms) > 0 and not unknown, usual)
    _declare(s)


@check("measurement", needed=True)
def its_channels_have_names_and_dimensions(s: Subject) -> None:
    s.channels = tuple(s.built.channels())
    listed = [channel.name for channel in s.channels]
    expect(len(set(listed)) == len(listed), f"found the channels {', '.join(listed)}, expected every name once")
    for channel in s.channels:
        expect(isinstance(channel, Channel), f"found a channel of type {type(channel).__name__}, expected Channel")
        named = f"found the channel {channel.name!r}, expected letters, digits, underscores"
        expect(channel.name.isidentifier(), named)
        if channel.dimension != "1":
            units_of(channel.dimension)


@check("measurement", needed=True)
def it_makes_a_residual_with_plausible_noise(s: Subject) -> None:
    s.case = _Case.of(s.built, planar_arms(s.arms), s.blocks, s.channels)
    factor = s.case.factor
    for number, dimension in zip(factor.noise, factor.dimensions, strict=False):
        largest, unit = _NOISIEST.get(dimension, math.inf), si_unit(dimension).name
        most = f"expected up to {largest:g} {unit} in an example: is it in {display_unit(dimension).name}?"
        expect(number <= largest, f"found a noise of {number:g} {unit}, {most}")
    expect_only(stacked([factor.residual, factor.outputs]), [factor.values, factor.record])


@check("measurement")
def the_residual_is_zero_where_outputs_are_measured(s: Subject) -> None:
    measured = {f"{_INSTRUMENT}.{channel.name}" for channel in s.channels}
    if s.case.factor.output_channels and set(s.case.factor.output_channels) == measured:
        worst = float(np.abs(s.case.numbers(s.case.factor.residual, s.case.point())).max())
        expect(worst <= 1e-9, f"found a residual of {worst:.1e}, expected zero")


@check("measurement")
def its_jacobian_is_finite_and_agrees_with_differences(s: Subject) -> None:
    case, (values, reading) = s.case, s.case.point()
    disturbed = reading + 0.01 * np.random.default_rng(2).uniform(-1, 1, len(reading))
    of_group = [name for block in case.group_blocks for name in block.entry_names]
    names = (*case.parameters.entry_names, *of_group, *case.factor.channels)
    function = case.function(case.factor.residual)
    expect_derivatives(function, np.concatenate([values, disturbed]), "the residual", names)


@check("measurement")
def the_measurement_is_the_same_each_time(s: Subject) -> None:
    def picture(made: Measurement) -> Array:
        same = tuple(made.parameters()) == tuple(s.case.own)
        expect(same, "found other parameters another time, expected them from its settings alone")
        again = _Case.of(made, planar_arms(s.arms), s.case.own, tuple(made.channels()))
        shown = stacked([again.factor.residual, again.factor.outputs, again.factor.nuisance_starts])
        return np.concatenate([again.numbers(shown, s.case.point()), again.factor.noise])

    expect_repeated(picture, s.built, s.build(s.arms))


@check("measurement")
def its_groups_have_the_same_parameters_which_a_record_fits(s: Subject) -> None:
    measurement, case = s.built, s.case
    if not isinstance(measurement, GroupedMeasurement):
        return
    keys = ("", _GROUP, f"{_GROUP}_2")
    shapes = {tuple((b.name, b.domain, b.unit) for b in measurement.group_parameters(key)) for key in keys[:2]}
    expect(len(shapes) == 1, "found groups with different parameters, expected the same names, domains and units")
    strange = [tie.groups for tie in measurement.ties(keys[1:]) if not set(tie.groups) <= set(keys[1:])]
    expect(not strange, f"found a tie of {strange}, expected only groups it was given")
    expect(measurement.mean_weight >= 1, f"found the mean weight {measurement.mean_weight}, expected at least 1")
    names = case.factor.nuisance_names
    if names and set(names) == {block.name for block in case.group_blocks}:  # one record says all of them
        values, reading = case.point()
        starts = case.numbers(case.factor.nuisance_starts, (values, reading))
        values[len(values) - len(starts) :] = starts
        worst = float(np.abs(case.numbers(case.factor.residual, (values, reading))).max())
        expect(worst <= 1e-9, f"found a residual of {worst:.1e} with what the record itself says, expected zero")


@check("measurement", needed=True)
def it_makes_a_residual_of_any_arm(s: Subject) -> None:  # every point of whose tool moves in a way of its own
    s.general = _Case.of(s.built, skewed_arms(s.arms), s.blocks, s.channels)


@check("measurement")
def every_parameter_of_the_measurement_has_an_influence(s: Subject) -> None:
    case = s.general
    place, values = sum(block.size for block in case.arm_blocks), {}
    for block in case.other_blocks:
        values[block.name.removeprefix(f"{_INSTRUMENT}.")] = case.factor.values[place : place + block.size]
        place += block.size
    expect_all_used(stacked([case.factor.residual, case.factor.outputs]), values)


@check("measurement")
def its_residual_is_in_m_and_rad(s: Subject) -> None:
    """What a length or an angle, of a parameter or as it is read, changes in a residual of the same dimension."""
    case, factor, slopes = s.general, s.general.factor, []
    function = case.function(factor.residual)
    for seed in range(_POINTS):
        at = np.concatenate(case.point(seed))
        at[factor.values.numel() :] += 0.01
        slopes.append(np.abs(np.asarray(function.jacobian()(at, function(at)))))
    slope, gains = np.max(slopes, axis=0), []
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


@check("measurement")
def the_noise_of_every_reading_follows_from_its_residual(s: Subject) -> None:
    """Also that a position's residual is x, y, z, measured minus predicted: a run tells axes apart by them."""
    case, factor = s.general, s.general.factor
    if not factor.output_channels:
        return
    function, at = case.function(factor.residual), np.concatenate(case.point())
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
    if set("xyz") <= set(names):
        of_position = by_reading[:3, [names.index(axis) for axis in "xyz"]]
        expect(
            bool(np.allclose(of_position, np.eye(3), atol=1e-6)),
            f"found a position's residual that changes by {np.round(of_position, 3).tolist()} with x, y and z, "
            "expected measured minus predicted of x, y and z in this order",
        )
